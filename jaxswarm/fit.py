"""The same updates as `train`, in chunks; between them the host shows progress, writes files and saves checkpoints.

While the host works on one chunk's results the device computes the next, so that files cost training no time. The
arithmetic does not depend on where chunks end: states and metrics are those of `train`, bit by bit, however often a
run was stopped and resumed.
"""

import contextlib
import dataclasses
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxswarm import reporting
from jaxswarm.checkpoint import Checkpoints, Restored, restore, set_aside_after
from jaxswarm.reporting import Row
from jaxswarm.training import Experiment, TrainState, evaluate, init, train_chunk
from jaxswarm.types import Metrics

RETURN = "eval/return"
SECONDS_PER_CHUNK = 1.0  # between signs of life, where an update is quicker than that
MAX_CHUNK = 64  # updates

_run_chunk = jax.jit(train_chunk, static_argnames="size", donate_argnames="train_state")


@jax.jit
def _copy(train_state: TrainState) -> TrainState:
    """The same state in buffers of its own: the next chunk overwrites those it is given."""
    return jax.tree.map(jnp.copy, train_state)


class DivergedError(RuntimeError):
    """A loss or an evaluation is not a finite number."""


@dataclasses.dataclass
class _Chunk:
    """Updates that the device has been asked for."""

    start: int  # updates done before
    length: int
    metrics: Metrics  # on the device
    state_before: TrainState | None  # if it may have to be saved


@dataclasses.dataclass
class _Candidate:
    """A state that may be saved, and what else continues the run from there."""

    update: int
    train_state: TrainState
    record: dict[str, Any]
    score: float | None


def fit(
    experiment: Experiment,
    num_updates: int,
    *,
    seed: int = 0,
    run_dir: str | Path | None = None,
    resume: bool = False,
    progress: bool = True,
    checkpoint_seconds: float = 30.0,
    keep_checkpoints: int = 3,
) -> tuple[TrainState, list[Row]]:
    """Trains from a seed until `num_updates` updates are done, or until Ctrl-C or SIGTERM, after the current chunk.

    Returns the state and a row per evaluation: `update` is the number of updates that the evaluated policy has behind
    it, `agent_steps` what they took, `eval/...` its evaluation, other metrics are means over the updates since the
    row before. With `run_dir` the folder gets `manifest.json`, `metrics.csv`, `checkpoints/` (the latest
    `keep_checkpoints` and the best, at most every `checkpoint_seconds`) and `curve.png`; with `resume` the run goes on
    from its last checkpoint. Raises `DivergedError` when numbers stop being finite, `checkpoint.CheckpointError` when
    there are checkpoints but none can be restored, and `FileExistsError` for a folder with another run in it.
    """
    run_dir = None if run_dir is None else Path(run_dir)
    if run_dir and not resume and (run_dir / "metrics.csv").exists():
        raise FileExistsError(f"{run_dir} holds a run already; resume it or choose another folder")
    restored = _restore(experiment, seed, run_dir) if resume and run_dir else None
    if restored and restored.update >= num_updates:
        if progress:
            print(f"{run_dir} is finished: {restored.update} of {num_updates} updates are done")
        return restored.train_state, _finished_rows(run_dir, experiment)
    start = restored.update if restored else 0
    with (
        reporting.Progress(start, num_updates, experiment.agent_steps_per_update, progress) as shown,
        _stop_requests() as stop,
    ):
        recorder = _Recorder(
            experiment,
            seed=seed,
            run_dir=run_dir,
            restored=restored,
            progress=shown,
            checkpoint_seconds=checkpoint_seconds,
            keep_checkpoints=keep_checkpoints,
        )
        try:
            train_state = restored.train_state if restored else init(experiment, jax.random.key(seed))
            train_state = _train(
                experiment, train_state, update=start, num_updates=num_updates, stop=stop, recorder=recorder
            )
        finally:
            recorder.close()
    return train_state, recorder.rows


def _train(
    experiment: Experiment,
    train_state: TrainState,
    *,
    update: int,
    num_updates: int,
    stop: threading.Event,
    recorder: "_Recorder",
) -> TrainState:
    """Updates until the last one or a stop; the device always has the next chunk before the host turns to the last."""
    in_flight: _Chunk | None = None
    size = min(experiment.eval_every, MAX_CHUNK)
    while update < num_updates and not stop.is_set():
        to_evaluation = experiment.eval_every - update % experiment.eval_every
        length = min(to_evaluation, num_updates - update, size, recorder.chunk_length())
        is_wanted = update % experiment.eval_every == 0 or recorder.is_checkpoint_due()
        before = _copy(train_state) if is_wanted and recorder.run_dir else None
        train_state, metrics = _run_chunk(experiment, train_state, jnp.int32(length), size=size)
        if in_flight:
            recorder.record(in_flight)
        else:
            recorder.open(num_updates)
        in_flight = _Chunk(update, length, metrics, before)
        update += length
    if in_flight:
        recorder.record(in_flight)
    recorder.finish(update, train_state, is_complete=update == num_updates)
    return train_state


class _Recorder:
    """Turns the chunks' metrics into rows, files and checkpoints, in order."""

    def __init__(
        self,
        experiment: Experiment,
        *,
        seed: int,
        run_dir: Path | None,
        restored: Restored | None,
        progress: reporting.Progress,
        checkpoint_seconds: float,
        keep_checkpoints: int,
    ):
        record = restored.record if restored else {"wall_seconds": 0.0, "since_evaluation": {}}
        self.run_dir = run_dir
        self.rows: list[Row] = []
        self._experiment = experiment
        self._seed = seed
        self._progress = progress
        self._checkpoint_seconds = checkpoint_seconds
        self._keep_checkpoints = keep_checkpoints
        self._start = restored.update if restored else 0
        self._since_evaluation: dict[str, list[float]] = record["since_evaluation"]
        self._started = time.monotonic() - record["wall_seconds"]
        self._wall_seconds = record["wall_seconds"]  # when the last recorded chunk was done
        self._seconds_per_update: float | None = None
        self._last_save = time.monotonic()
        self._checkpoints: Checkpoints | None = None
        self._best: _Candidate | None = None  # better than all on disk, and not yet there

    def open(self, num_updates: int) -> None:
        """Prepares the run folder; called once the device is at work."""
        if self.run_dir:
            self.run_dir.mkdir(parents=True, exist_ok=True)
            manifest = reporting.manifest(self._experiment, num_updates, self._seed)
            reporting.write_manifest(self.run_dir / "manifest.json", manifest)
            self.rows = reporting.keep_rows_before(self.run_dir / "metrics.csv", self._start)
            self._checkpoints = Checkpoints(self.run_dir / "checkpoints", self._keep_checkpoints)

    def close(self) -> None:
        """Waits for what is being written."""
        if self._checkpoints:
            if self._best:
                self._save(self._best)
            self._checkpoints.close()
            self._checkpoints = None
        if self.run_dir and self.rows:
            draw_curve(self.run_dir, self._experiment, self.rows)

    def chunk_length(self) -> int:
        """Number of updates that take about `SECONDS_PER_CHUNK`, 1 as long as that is unknown."""
        if not self._seconds_per_update:
            return 1
        return max(1, int(SECONDS_PER_CHUNK / self._seconds_per_update))

    def is_checkpoint_due(self) -> bool:
        """Whether the last one was long enough ago."""
        return time.monotonic() - self._last_save >= self._checkpoint_seconds

    def record(self, chunk: _Chunk) -> None:
        """Waits for a chunk and takes down what came out of it."""
        metrics = {name: x[: chunk.length] for name, x in jax.device_get(chunk.metrics).items()}
        is_evaluated = chunk.start % self._experiment.eval_every == 0
        _check_finite(metrics, chunk.start, is_evaluated)
        record = {"wall_seconds": self._wall_seconds, "since_evaluation": self._since_evaluation}
        training = {name: x for name, x in metrics.items() if not name.startswith("eval/")}
        self._since_evaluation = {name: self._since_evaluation.get(name, []) for name in training}
        score = None
        if is_evaluated:
            score = float(metrics[RETURN][0])
            self._add_row(chunk.start, {name: float(x[0]) for name, x in metrics.items() if name not in training})
        if chunk.state_before is not None:
            self._consider(_Candidate(chunk.start, chunk.state_before, record, score))
        self._since_evaluation = {
            name: self._since_evaluation[name] + x.astype(float).tolist() for name, x in training.items()
        }
        self._measure(chunk)
        self._progress.advance(chunk.start + chunk.length, self.rows[-1][RETURN] if self.rows else None)

    def finish(self, update: int, train_state: TrainState, is_complete: bool) -> None:
        """Evaluates and saves the state in which training ends."""
        record = {"wall_seconds": self._wall_seconds, "since_evaluation": self._since_evaluation}
        score = None
        if is_complete:
            evaluation = {name: float(x) for name, x in evaluate(self._experiment, train_state).items()}
            _check_finite({name: np.array([x]) for name, x in evaluation.items()}, update, is_evaluated=True)
            score = evaluation[RETURN]
            self._add_row(update, evaluation)
        if self._checkpoints:
            self._last_save = -math.inf
            self._consider(_Candidate(update, train_state, record, score))

    def _add_row(self, update: int, evaluation: dict[str, float]) -> None:
        """Evaluation of the policy at `update`, and means over the updates since the row before."""
        means = {name: _nanmean(values) for name, values in self._since_evaluation.items()}
        row = {
            "update": update,
            "agent_steps": update * self._experiment.agent_steps_per_update,
            "wall_seconds": self._wall_seconds,
            "seed": self._seed,
        }
        self.rows.append(row | evaluation | means)
        self._since_evaluation = {name: [] for name in self._since_evaluation}
        if self.run_dir:
            reporting.append_row(self.run_dir / "metrics.csv", self.rows[-1])

    def _consider(self, candidate: _Candidate) -> None:
        """Saves the state if a checkpoint is due, after the best state so far; else remembers it if it is the best."""
        assert self._checkpoints
        best_score = self._best.score if self._best else self._checkpoints.best_score
        if candidate.score is not None and (best_score is None or candidate.score > best_score):
            self._best = candidate
        if self.is_checkpoint_due():
            if self._best:
                self._save(self._best)
            self._save(candidate)
            self._best = None
            self._last_save = time.monotonic()

    def _save(self, candidate: _Candidate) -> None:
        assert self._checkpoints
        self._checkpoints.save(candidate.update, candidate.train_state, candidate.record, candidate.score)

    def _measure(self, chunk: _Chunk) -> None:
        now = time.monotonic() - self._started
        if chunk.start > self._start:  # the first chunk includes compiling
            self._seconds_per_update = (now - self._wall_seconds) / chunk.length
        self._wall_seconds = now


def draw_curve(run_dir: Path, experiment: Experiment, rows: list[Row]) -> None:
    """Draws the learning curve of a run into its folder."""
    title = f"{type(experiment.task).__name__}, {experiment.task.num_agents} agents"
    reporting.draw_curve(run_dir / "curve.png", rows, title)


def abstract_state(experiment: Experiment) -> TrainState:
    """Shapes and types of a state, without computing one."""
    return jax.eval_shape(init, experiment, jax.random.key(0))


def _restore(experiment: Experiment, seed: int, run_dir: Path) -> Restored | None:
    directory = run_dir / "checkpoints"
    restored = restore(directory, abstract_state(experiment))
    if restored:
        set_aside_after(directory, restored.update)
    return restored


def _finished_rows(run_dir: Path | None, experiment: Experiment) -> list[Row]:
    assert run_dir
    rows = reporting.read_rows(run_dir / "metrics.csv")
    if rows and not (run_dir / "curve.png").exists():
        draw_curve(run_dir, experiment, rows)
    return rows


def _check_finite(metrics: dict[str, np.ndarray], start: int, is_evaluated: bool) -> None:
    """Raises `DivergedError` for the first loss or return that is not a finite number."""
    for name, values in metrics.items():
        is_loss = name.startswith("learner/") and "loss" in name
        checked = values if is_loss else values[: int(name == RETURN and is_evaluated)]
        wrong = np.flatnonzero(~np.isfinite(checked))
        if wrong.size:
            raise DivergedError(f"{name} is {values[wrong[0]]} at update {start + wrong[0]}; training stopped")


def _nanmean(values: list[float]) -> float:
    finite = [x for x in values if not math.isnan(x)]
    return math.fsum(finite) / len(finite) if finite else math.nan


@contextlib.contextmanager
def _stop_requests() -> Iterator[threading.Event]:
    """An event that SIGTERM and the first Ctrl-C set; the second Ctrl-C interrupts as usual."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop  # only the main thread may handle signals
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def request(number: int, _: Any) -> None:
        stop.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        text = f"\n{signal.Signals(number).name}: finishing the current updates (Ctrl-C to abort)\n"
        os.write(sys.stderr.fileno(), text.encode())  # print may be what was interrupted

    for number in before:
        signal.signal(number, request)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
