"""What becomes of one run while it is trained: rows, the files in its folder, checkpoints."""

import contextlib
import dataclasses
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxswarm import config as configs
from jaxswarm import files
from jaxswarm.analysis import training_curve
from jaxswarm.config import ConfigError
from jaxswarm.files import RETURN, Row
from jaxswarm.host import manifest
from jaxswarm.host.checkpoint import Checkpoints, Restored
from jaxswarm.host.loggers import LOGGERS, Logger
from jaxswarm.training import Experiment, TrainState, is_loss

# keys of a config that are not the run's own
MAY_CHANGE = {*configs.LENGTHS, "checkpoint_seconds", "keep_checkpoints", "render_every", "loggers", "imports"}
SECONDS_PER_CURVE = 60.0  # from one picture of the curve during training to the next


@dataclasses.dataclass(frozen=True)
class Run:
    """An experiment and its seeds, which are trained side by side; with a folder, files are written into it."""

    experiment: Experiment
    seeds: tuple[int, ...] = (0,)
    run_dir: Path | None = None
    loggers: tuple[str, ...] = ()  # names in `LOGGERS`, which need a folder
    config: Mapping[str, Any] | None = None  # goes into the folder, and is shown to loggers
    on_evaluation: Callable[[int, Any], None] | None = None  # called with updates done and parameters [seeds, ...]
    init_params: Any = None  # of the network, that all seeds begin with; None: each draws its own


@dataclasses.dataclass
class _Candidate:
    """A state that may be saved, and what else continues the run from there."""

    update: int
    states: TrainState  # leaves [seeds, ...]
    record: dict[str, Any]
    score: float | None


@contextlib.contextmanager
def locked(run_dir: Path) -> Iterator[None]:
    """Keeps other processes from training into a folder; a `ConfigError` if one does. Ends with the process at latest.

    Does nothing where the system has no such locks.
    """
    run_dir.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        try:
            import fcntl  # noqa: PLC0415

            descriptor = os.open(run_dir, os.O_RDONLY)
            stack.callback(os.close, descriptor)
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(f"{run_dir} is being trained by another process; wait for it, or stop it") from None
        except (ImportError, OSError):
            pass
        yield


def has_checkpoint(run_dir: Path) -> bool:
    """Whether there is anything to go on from."""
    return any(run_dir.glob("checkpoints/[0-9]*"))


def started_and_new(run_dirs: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Folders of runs that go on together; and those that are empty where others have checkpoints."""
    has_none = [path for path in run_dirs if not has_checkpoint(path)]
    is_empty = {path: path in has_none and not files.read_rows(path / "metrics.csv") for path in run_dirs}
    new = [path for path in run_dirs if is_empty[path] and len(has_none) < len(run_dirs)]
    return [path for path in run_dirs if path not in new], new


def check_folder(run: Run, resume: bool) -> None:
    """Raises `FileExistsError` if training would replace what is in the run's folder, or mix it with another run."""
    if run.run_dir is None:
        return
    if not resume:
        if (run.run_dir / "metrics.csv").exists():
            raise FileExistsError(f"{run.run_dir} holds a run already; resume it or choose another folder")
        return
    rows = files.read_rows(run.run_dir / "metrics.csv")
    if rows and not (run.run_dir / "checkpoints").exists():
        raise FileExistsError(
            f"{run.run_dir} holds evaluations but no checkpoints, so it cannot be resumed; "
            "choose another folder to train it again"
        )
    seeds = sorted({int(row["seed"]) for row in rows})
    changed = _changes(run) if set(seeds) <= set(run.seeds) else {"seeds": (seeds, list(run.seeds))}
    if changed:
        name, (before, now) = next(iter(changed.items()))
        raise FileExistsError(f"{run.run_dir} holds another run: {name} is {before} there, and {now} here")


def _changes(run: Run) -> dict[str, tuple]:
    """Keys of the config that resuming may not change, with the value in the folder and that of the run."""
    path = (run.run_dir or Path()) / "config.yaml"
    if run.config is None or not path.exists():
        return {}
    before = configs.read(path)
    with contextlib.suppress(ConfigError):  # the config of another version stays as it is
        before = configs.validate(before)
    one, other = (configs.flat(config) for config in (before, run.config))
    names = [name for name in other if name not in MAY_CHANGE and one.get(name) != other[name]]
    return {name: (one.get(name), other[name]) for name in names}


class Recorder:
    """Takes down what came out of updates, in order. Arrays are [seeds, ...], in the order of the run's seeds."""

    def __init__(self, run: Run, restored: Restored | None, keep_checkpoints: int):
        record: dict[str, Any] = restored.record if restored else {}
        self.run = run
        self.rows: list[Row] = []
        self.reason: dict[int, str] = {int(seed): x for seed, x in record.get("diverged", {}).items()}
        self._since_evaluation: dict[str, list[list[float]]] = record.get("since_evaluation", {})  # [updates][seeds]
        self._start = restored.update if restored else 0
        self._keep_checkpoints = keep_checkpoints
        self._checkpoints: Checkpoints | None = None
        self._loggers: dict[int, list[Logger]] = {}
        self._last: _Candidate | None = None
        self._best: _Candidate | None = None  # better than all on disk, and not yet there
        self._last_drawn = time.monotonic()

    def open(self, num_updates: int) -> None:
        """Prepares the run folder; called once the device is at work."""
        run_dir = self.run.run_dir
        if run_dir:
            run_dir.mkdir(parents=True, exist_ok=True)
            content = manifest.describe(self.run.experiment, num_updates, self.run.seeds)
            manifest.write_manifest(run_dir / "manifest.json", content)
            self.rows = files.keep_rows_before(run_dir / "metrics.csv", self._start)
            self._checkpoints = Checkpoints(run_dir / "checkpoints", self._keep_checkpoints)
            for seed in self.run.seeds:
                self._loggers[seed] = [LOGGERS[name](run_dir, self.run.config, seed) for name in self.run.loggers]

    def close(self) -> None:
        """Waits for what is being written."""
        if self._checkpoints:
            if self._best:
                self._save(self._best)
            self._checkpoints.close()
            self._checkpoints = None
        for logger in (x for loggers in self._loggers.values() for x in loggers):
            logger.close()
        self._loggers = {}
        if self.run.run_dir and self.rows:
            draw_curve(self.run, self.rows)

    def record(
        self, start: int, wall_seconds: float, metrics: dict[str, np.ndarray], states: TrainState | None
    ) -> None:
        """Metrics [seeds, updates] of the updates from `start` on; `states` before them, if they may be saved."""
        evaluation = {name: x[:, 0] for name, x in metrics.items() if name.startswith("eval/")}
        training = {name: x for name, x in metrics.items() if name not in evaluation and name != "is_finite"}
        is_evaluated = start % self.run.experiment.eval_every == 0
        record = self._to_continue(wall_seconds)
        self._since_evaluation = {name: self._since_evaluation.get(name, []) for name in training}
        if is_evaluated:
            self._add_rows(start, wall_seconds, evaluation)
        if is_evaluated and states is not None and self.run.on_evaluation:
            self.run.on_evaluation(start, states.learner.params)
        if states is not None and self._checkpoints:
            self._consider(_Candidate(start, states, record, self._score(evaluation) if is_evaluated else None))
        for name, x in training.items():
            self._since_evaluation[name] = self._since_evaluation[name] + x.T.astype(float).tolist()
        self._note_diverged(start, metrics)

    def finish(
        self, update: int, wall_seconds: float, states: TrainState, evaluation: dict[str, np.ndarray] | None
    ) -> None:
        """Saves the states in which training ends; metrics [seeds] of their evaluation, if it has reached its end."""
        record = self._to_continue(wall_seconds)
        if evaluation is not None:
            self._add_rows(update, wall_seconds, evaluation)
        if self._checkpoints:
            score = None if evaluation is None else self._score(evaluation)
            self._consider(_Candidate(update, states, record, score))
            self.save()

    def save(self) -> None:
        """Writes the best states, if they are not on disk, and the last ones."""
        for candidate in (self._best, self._last):
            if candidate:
                self._save(candidate)
        self._best = None

    def latest_return(self) -> float | None:
        """Median over the seeds of the last evaluation."""
        latest = [row[RETURN] for row in self.rows if row["update"] == self.rows[-1]["update"]]
        return float(np.median(latest)) if latest else None

    def _note_diverged(self, start: int, metrics: dict[str, np.ndarray]) -> None:
        for index, seed in enumerate(self.run.seeds):
            wrong = np.flatnonzero(metrics["is_finite"][index] == 0)
            if wrong.size and seed not in self.reason:
                of_update = {name: x[index, wrong[0]] for name, x in metrics.items()}
                self.reason[seed] = _reason(of_update, start + int(wrong[0]))

    @property
    def diverged(self) -> list[int]:
        """Seeds that stay as they were before their numbers stopped being finite, for a `reason` each."""
        return list(self.reason)

    def _score(self, evaluation: dict[str, np.ndarray]) -> float | None:
        """Mean return over the seeds that have not diverged."""
        returns = [x for seed, x in zip(self.run.seeds, evaluation[RETURN], strict=True) if seed not in self.reason]
        score = float(np.mean(returns, dtype=float)) if returns else math.nan
        return score if math.isfinite(score) else None

    def _to_continue(self, wall_seconds: float) -> dict[str, Any]:
        diverged = {str(seed): reason for seed, reason in self.reason.items()}
        return {"wall_seconds": wall_seconds, "since_evaluation": self._since_evaluation, "diverged": diverged}

    def _add_rows(self, update: int, wall_seconds: float, evaluation: dict[str, np.ndarray]) -> None:
        """Evaluations of the policies at `update`, and means over the updates since the rows before."""
        for index, seed in enumerate(self.run.seeds):
            if seed not in self.reason and not np.isfinite(evaluation[RETURN][index]):
                self.reason[seed] = f"{RETURN} is {evaluation[RETURN][index]} at update {update}"
            if seed in self.reason:
                continue
            means = {name: _nanmean([x[index] for x in values]) for name, values in self._since_evaluation.items()}
            row = {
                "update": update,
                "agent_steps": update * self.run.experiment.agent_steps_per_update,
                "wall_seconds": wall_seconds,
                "seed": seed,
            }
            self.rows.append(row | {name: float(x[index]) for name, x in evaluation.items()} | means)
            if self.run.run_dir:
                files.append_row(self.run.run_dir / "metrics.csv", self.rows[-1])
            for logger in self._loggers.get(seed, []):
                logger.log(self.rows[-1])
        self._since_evaluation = {name: [] for name in self._since_evaluation}
        if self.run.run_dir and self.rows and time.monotonic() - self._last_drawn >= SECONDS_PER_CURVE:
            draw_curve(self.run, self.rows)
            self._last_drawn = time.monotonic()

    def _consider(self, candidate: _Candidate) -> None:
        """Remembers the states as the last ones, and as the best ones if they are."""
        assert self._checkpoints
        best_score = self._best.score if self._best else self._checkpoints.best_score
        if candidate.score is not None and (best_score is None or candidate.score > best_score):
            self._best = candidate
        self._last = candidate

    def _save(self, candidate: _Candidate) -> None:
        assert self._checkpoints
        self._checkpoints.save(candidate.update, candidate.states, candidate.record, candidate.score)


def draw_curve(run: Run, rows: Sequence[Row]) -> None:
    """Draws the learning curve of a run into its folder."""
    assert run.run_dir
    title = f"{type(run.experiment.task).__name__}, {run.experiment.task.num_agents} agents"
    training_curve.draw_curve(run.run_dir / "curve.png", rows, title)


def _reason(metrics: dict[str, Any], update: int) -> str:
    """Which number stopped being finite."""
    for name, value in metrics.items():
        if not np.isfinite(value) and is_loss(name):
            return f"{name} is {value} at update {update}"
    return f"a parameter is not finite at update {update}"


def _nanmean(values: list[float]) -> float:
    finite = [x for x in values if not math.isnan(x)]
    return math.fsum(finite) / len(finite) if finite else math.nan
