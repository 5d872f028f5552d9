"""The same updates as `train`, in chunks; between them the host shows progress, writes files and saves checkpoints.

While the host works on one chunk's results the device computes the next, so that files cost training no time. The
arithmetic does not depend on where chunks end: states and metrics are those of `train`, compiled with the same options,
bit by bit, however often a run was stopped and resumed. Several seeds, and several runs, are trained side by side; see
`ensemble`, which compiles.
"""

import contextlib
import math
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxswarm import config as configs
from jaxswarm import files
from jaxswarm.config import plugins as imports
from jaxswarm.config.schema import ConfigError
from jaxswarm.files import Row, replace_text
from jaxswarm.host import ensemble, loggers
from jaxswarm.host.checkpoint import Restored, restore, set_aside_after
from jaxswarm.host.ensemble import RunBatch
from jaxswarm.host.progress import Progress
from jaxswarm.host.recorder import Recorder, Run, check_folder, draw_curve, locked, started_and_new
from jaxswarm.training import Experiment, TrainState, init
from jaxswarm.types import Metrics

SECONDS_PER_CHUNK = 1.0  # between signs of life, where an update is quicker than that
MAX_CHUNK = 64  # updates


class DivergedError(RuntimeError):
    """A parameter, a loss or an evaluation is not a finite number, in every run; `rows` are the evaluations of each."""

    def __init__(self, message: str, rows: Sequence[list[Row]]):
        super().__init__(message)
        self.rows = list(rows)


class _Chunk(NamedTuple):
    """Updates that the device has been asked for."""

    start: int  # updates done before
    length: int
    metrics: Metrics  # [runs, updates], on the device
    states_before: TrainState | None  # if they may have to be saved
    is_saved: bool


def fit(
    experiment: Experiment,
    num_updates: int,
    *,
    seed: int = 0,
    num_seeds: int | None = None,
    run_dir: str | Path | None = None,
    resume: bool = False,
    progress: bool = True,
    checkpoint_seconds: float = 30.0,
    keep_checkpoints: int = 3,
    log_to: tuple[str, ...] = (),
    config: Mapping[str, Any] | None = None,
    on_evaluation: Callable[[int, Any], None] | None = None,
    init_params: Any = None,
) -> tuple[TrainState, list[Row]]:
    """Trains until `num_updates` updates are done, or until Ctrl-C or SIGTERM, after the current chunk.

    Returns the state and a row per evaluation: `update` is the number of updates that the evaluated policy has behind
    it, `agent_steps` what they took, `eval/...` its evaluation, other metrics are means over the updates since the
    row before. With `num_seeds` the seeds from `seed` on are trained side by side: the state has a leading axis, and
    there is a row for each. A seed whose numbers stop being finite stays as it was before.

    `log_to` are names in `loggers.LOGGERS`; `on_evaluation` is called with the update and the parameters [seeds, ...]
    of each evaluated policy but the last. All seeds begin with `init_params`, where they are given: parameters of a
    network of the same shapes, as `jaxswarm.load` gives them, trained in a swarm of any size.

    With `run_dir` the folder gets `config.yaml` (`config`, by default what `config.describe` says, if anything),
    `manifest.json`, `metrics.csv`, `checkpoints/` (the latest `keep_checkpoints` and the best, at most every
    `checkpoint_seconds`) and `curve.png`; with `resume` the run goes on from its last checkpoint. Raises
    `DivergedError` when no seed is left, `checkpoint.CheckpointError` when there are checkpoints but none can be
    restored, `FileExistsError` for a folder that holds another run, or evaluations without checkpoints, and
    `config.ConfigError` for settings that are not possible.
    """
    given: dict[str, Any] = {
        "seed": seed,
        "num_seeds": 1 if num_seeds is None else num_seeds,
        "num_updates": num_updates,
        "checkpoint_seconds": checkpoint_seconds,
        "keep_checkpoints": keep_checkpoints,
    }
    seeds = configs.RunSettings(**given).seeds
    if config is None and run_dir is not None:
        config = configs.describe(experiment, **given, loggers=log_to)
        if config is None:
            warnings.warn(f"{run_dir} gets no config, so that only `fit` reads it; see `config.describe`", stacklevel=2)
    folder = None if run_dir is None else Path(run_dir)
    run = Run(experiment, seeds, folder, log_to, config, on_evaluation, init_params)
    states, (rows,) = fit_runs(
        [run],
        num_updates,
        resume=resume,
        progress=progress,
        checkpoint_seconds=checkpoint_seconds,
        keep_checkpoints=keep_checkpoints,
    )
    return (jax.tree.map(lambda x: x[0], states) if num_seeds is None else states), rows


def fit_runs(
    runs: Sequence[Run],
    num_updates: int,
    *,
    resume: bool = False,
    progress: bool = True,
    checkpoint_seconds: float = 30.0,
    keep_checkpoints: int = 3,
) -> tuple[TrainState, list[list[Row]]]:
    """`fit` for several runs in one program; they differ in numbers, seeds and folders.

    Returns states with a leading axis, the seeds of the first run first, and the rows of each run. Resumes all from
    the last update of which each has a checkpoint; runs that have begun and new ones are not resumed together.
    """
    for run in runs:
        check_folder(run, resume)
        _check_params(run)
        for name in run.loggers:
            loggers.load(name)
    begun, new = started_and_new([run.run_dir for run in runs if run.run_dir])
    if begun and new:
        raise FileExistsError(
            f"{begun[0]} holds a run and {new[0]} does not; runs of one program are all new or all resumed"
        )
    with contextlib.ExitStack() as locks:
        for run in runs:
            if run.run_dir and jax.process_index() == 0:
                locks.enter_context(locked(run.run_dir))
        return _fit(runs, num_updates, resume, progress, checkpoint_seconds, keep_checkpoints)


def _fit(
    runs: Sequence[Run],
    num_updates: int,
    resume: bool,
    progress: bool,
    checkpoint_seconds: float,
    keep_checkpoints: int,
) -> tuple[TrainState, list[list[Row]]]:
    """`fit_runs` in folders that nobody else writes into."""
    is_first = jax.process_index() == 0  # of several processes, only the first one writes and talks
    restored = _restore(runs) if resume else None
    if restored and restored[0].update >= num_updates:
        if progress and is_first:
            print(f"{runs[0].run_dir} is finished: {restored[0].update} of {num_updates} updates are done")
        return _concatenate(restored), [_finished_rows(run) for run in runs]
    batch = ensemble.make_batch([run.experiment for run in runs], len(runs[0].seeds))
    runs = runs if is_first else [Run(run.experiment, run.seeds) for run in runs]
    for run in runs:
        if run.run_dir and run.config is not None:
            replace_text(run.run_dir / "config.yaml", configs.dump(dict(run.config)))
            imports.keep(run.config.get("imports", []), run.run_dir)
    start = restored[0].update if restored else 0
    agent_steps = runs[0].experiment.agent_steps_per_update * batch.num_runs
    with (
        Progress(start, num_updates, agent_steps, progress and is_first) as shown,
        _stop_requests() as stop,
    ):
        recorders = [Recorder(run, restored[i] if restored else None, keep_checkpoints) for i, run in enumerate(runs)]
        wall_seconds = restored[0].record["wall_seconds"] if restored else 0.0
        chunk_recorder = _ChunkRecorder(batch, recorders, shown, start, wall_seconds, checkpoint_seconds)
        try:
            states = ensemble.place(batch, _concatenate(restored)) if restored else _initial(batch, runs)
            states = _train(states, num_updates, chunk_recorder, stop)
        finally:
            for recorder in recorders:
                recorder.close()
    return states, [recorder.rows for recorder in recorders]


def _check_params(run: Run) -> None:
    """Raises a `ConfigError` for parameters that are not those of the run's network."""
    if run.init_params is None:
        return
    needed = abstract_state(run.experiment).learner.params
    if jax.tree.map(np.shape, run.init_params) != jax.tree.map(lambda x: x.shape[1:], needed):
        raise ConfigError(
            "init_params: must have the parameter shapes of this network; "
            "train the warm start with the same network, observation features and actions"
        )


def _initial(batch: RunBatch, runs: Sequence[Run]) -> TrainState:
    """The states before the first update."""
    states = ensemble.init_batch(batch, [seed for run in runs for seed in run.seeds])
    given = [run.init_params for run in runs for _ in run.seeds]
    if all(params is None for params in given):
        return states
    own = states.learner.params
    drawn = (jax.tree.map(lambda x, i=i: x[i], own) if x is None else x for i, x in enumerate(given))
    return ensemble.with_params(states, list(drawn))


def _train(states: TrainState, num_updates: int, chunk_recorder: "_ChunkRecorder", stop: threading.Event) -> TrainState:
    """Updates until the last one or a stop; the device always has the next chunk before the host turns to the last."""
    update, in_flight = chunk_recorder.start, None
    eval_every = chunk_recorder.recorders[0].run.experiment.eval_every
    size = min(eval_every, MAX_CHUNK)
    program = ensemble.compile_batch(chunk_recorder.batch, states, size, chunk_recorder.progress.warn)
    while update < num_updates:
        length = min(eval_every - update % eval_every, num_updates - update, size, chunk_recorder.chunk_length())
        length, is_due, is_stopped = _broadcast_from_first(length, chunk_recorder.is_checkpoint_due(), stop.is_set())
        if is_stopped:
            break
        is_wanted = chunk_recorder.needs_states and (update % eval_every == 0 or is_due)
        before = _copy(states) if is_wanted else None
        states, metrics = program(chunk_recorder.batch.experiments, states, np.int32(length))
        if in_flight:
            chunk_recorder.record(in_flight)
        else:
            chunk_recorder.progress.begin()
            chunk_recorder.open(num_updates)
        in_flight = _Chunk(update, length, metrics, before, bool(is_due))
        update += length
    if in_flight:
        chunk_recorder.record(in_flight)
    chunk_recorder.finish(update, states, is_complete=update == num_updates)
    return states


@jax.jit
def _copy(states: TrainState) -> TrainState:
    """The same states in buffers of their own: the next chunk overwrites those it is given."""
    return jax.tree.map(jnp.copy, states)


def _broadcast_from_first(*values: int) -> list[int]:
    """What the first process says; the same everywhere, so that all do the same."""
    if jax.process_count() == 1:
        return list(values)
    from jax.experimental import multihost_utils  # noqa: PLC0415

    return [int(x) for x in multihost_utils.broadcast_one_to_all(np.array(values))]


class _ChunkRecorder:
    """Hands results of all runs to the recorder of each, and measures time."""

    def __init__(
        self,
        batch: RunBatch,
        recorders: Sequence[Recorder],
        progress: Progress,
        start: int,
        wall_seconds: float,
        checkpoint_seconds: float,
    ):
        self.batch = batch
        self.recorders = recorders
        self.progress = progress
        self.start = start
        runs = [recorder.run for recorder in recorders]
        self.needs_states = any(_broadcast_from_first(*[bool(run.run_dir or run.on_evaluation) for run in runs]))
        self._checkpoint_seconds = checkpoint_seconds
        self._started = time.monotonic() - wall_seconds
        self._wall_seconds = wall_seconds  # when the last recorded chunk was done
        self._seconds_per_update: float | None = None
        self._last_save = time.monotonic()
        self._num_reported = 0

    def open(self, num_updates: int) -> None:
        """Prepares the folders."""
        for recorder in self.recorders:
            recorder.open(num_updates)

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
        metrics = jax.device_get(ensemble.fetch(self.batch, chunk.metrics))
        metrics = {name: x[:, : chunk.length] for name, x in metrics.items()}
        states = ensemble.fetch(self.batch, chunk.states_before)
        for recorder, part in self._parts():
            own = {name: x[part] for name, x in metrics.items()}
            recorder.record(chunk.start, self._wall_seconds, own, _slice(states, part))
            if chunk.is_saved:
                recorder.save()
        if chunk.is_saved:
            self._last_save = time.monotonic()
        self._report_diverged()
        now = time.monotonic() - self._started
        if chunk.start > self.start:  # the first chunk includes compiling
            self._seconds_per_update = (now - self._wall_seconds) / chunk.length
        self._wall_seconds = now
        returns = [x for recorder in self.recorders if (x := recorder.latest_return()) is not None]
        self.progress.advance(chunk.start + chunk.length, float(np.median(returns)) if returns else None)

    def finish(self, update: int, states: TrainState, is_complete: bool) -> None:
        """Evaluates and saves the states in which training ends."""
        evaluation = None
        if is_complete:
            evaluation = ensemble.fetch(self.batch, ensemble.evaluate_batch(self.batch, states))
            evaluation = jax.device_get(evaluation)
        states = ensemble.fetch(self.batch, states)
        for recorder, part in self._parts():
            own = None if evaluation is None else {name: x[part] for name, x in evaluation.items()}
            recorder.finish(update, self._wall_seconds, _slice(states, part), own)
        self._report_diverged()

    def _parts(self) -> Iterator[tuple[Recorder, slice]]:
        """Each recorder with its part of the axis of runs."""
        size = self.batch.num_runs // len(self.recorders)
        for index, recorder in enumerate(self.recorders):
            yield recorder, slice(index * size, (index + 1) * size)

    def _report_diverged(self) -> None:
        """Says which seeds have diverged since the last time; raises if no other is left."""
        diverged = [(recorder, seed) for recorder in self.recorders for seed in recorder.diverged]
        if len(diverged) == self.batch.num_runs:
            reason = diverged[-1][0].reason[diverged[-1][1]]
            raise DivergedError(f"{reason}; training stopped", [recorder.rows for recorder in self.recorders])
        for recorder, seed in diverged[self._num_reported :]:
            where = f" of {recorder.run.run_dir}" if recorder.run.run_dir else ""
            self.progress.warn(f"seed {seed}{where} stays as it was: {recorder.reason[seed]}")
        self._num_reported = len(diverged)


def abstract_state(experiment: Experiment, num_seeds: int = 1) -> TrainState:
    """Shapes and types of the states of so many seeds, without computing any."""
    state = jax.eval_shape(init, experiment, jax.random.key(0))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((num_seeds, *x.shape), x.dtype), state)


def _restore(runs: Sequence[Run]) -> list[Restored] | None:
    """Of each run the last checkpoint that all of them have; `None` if one of them has none."""
    up_to = math.inf
    while True:
        found = []
        for run in runs:
            assert run.run_dir
            template = abstract_state(run.experiment, len(run.seeds))
            found.append(restore(run.run_dir / "checkpoints", template, up_to=up_to))
        updates = [x.update if x else -1 for x in found]
        if min(updates) == max(updates) or min(updates) < 0:
            break
        up_to = min(updates)
    _broadcast_from_first(0)  # nobody still reads
    if jax.process_index() == 0:
        for run in runs:
            assert run.run_dir
            set_aside_after(run.run_dir / "checkpoints", min(updates))
    return None if min(updates) < 0 else found


def _slice(states: Any, part: slice) -> Any:
    return jax.tree.map(lambda x: x[part], states)


def _concatenate(restored: Sequence[Restored]) -> TrainState:
    return jax.tree.map(lambda *x: jnp.concatenate(x), *[x.train_state for x in restored])


def _finished_rows(run: Run) -> list[Row]:
    assert run.run_dir
    rows = files.read_rows(run.run_dir / "metrics.csv")
    if rows and not (run.run_dir / "curve.png").exists():
        draw_curve(run, rows)
    return rows


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
