"""The results of one run while it is trained: rows of metrics.csv, loggers, plots and checkpoints."""

import dataclasses
import math
import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxswarm import config as configs
from jaxswarm import files
from jaxswarm.analysis import training_curve
from jaxswarm.config import plugins
from jaxswarm.files import RETURN, Row
from jaxswarm.host import manifest
from jaxswarm.host.checkpoint import Checkpoints
from jaxswarm.host.identity import Identity, identify
from jaxswarm.host.loggers import LOGGERS, Logger
from jaxswarm.host.metrics_log import MetricsLog
from jaxswarm.host.resume import ResumePoint
from jaxswarm.host.run import Run
from jaxswarm.training import TrainState, is_loss

SECONDS_PER_CURVE = 60.0  # between two plots of the learning curve during training

_warned: set[str] = set()  # warnings about plots, printed once per process


@dataclasses.dataclass
class _Candidate:
    """A state that may be saved, with everything else that resuming from it needs."""

    update: int
    states: TrainState  # leaves [seeds, ...]
    record: dict[str, Any]
    score: float | None


class Recorder:
    """Record the results of updates, in order. Arrays are [seeds, ...], in the order of the run's seeds."""

    def __init__(self, run: Run, point: ResumePoint | None):
        restored = point.restored if point else None
        record: dict[str, Any] = restored.record if restored else {}
        self.run = run
        self.rows: list[Row] = files.parse_rows(point.lines) if point else []
        self.reason: dict[int, str] = {int(seed): x for seed, x in record.get("diverged", {}).items()}
        self._since_evaluation: dict[str, list[list[float]]] = record.get("since_evaluation", {})  # [updates][seeds]
        self._point = point
        self._identity: Identity | None = None
        self._log: MetricsLog | None = None
        self._checkpoints: Checkpoints | None = None
        self._loggers: dict[int, list[Logger]] = {}
        self._last: _Candidate | None = None
        self._best: _Candidate | None = None  # better than every checkpoint on disk, and not saved yet
        self._last_plotted = time.monotonic()
        self.was_described = False  # config.yaml was written
        self.last_saved = restored.update if restored else 0  # update of the latest checkpoint, once this is closed

    def open(self) -> None:
        """Prepare the run folder, once the first chunk has been compiled and dispatched."""
        run, run_dir = self.run, self.run.run_dir
        if run_dir:
            files.remove_temporary_files(run_dir)
            files.wait_for_space(self._write_description, run_dir)
            self._checkpoints = Checkpoints(run_dir / "checkpoints", run.settings.keep_checkpoints, self._identity)
            self._log = MetricsLog(run_dir, self._point.lines if self._point else [])
            for seed in run.seeds:
                self._loggers[seed] = [LOGGERS[name](run_dir, run.config, seed) for name in run.settings.loggers]

    def _write_description(self) -> None:
        """Write everything that describes the run: copies of its imports, config, and manifest."""
        run = self.run
        imports = {}
        if run.config is not None:
            imports = plugins.keep(run.config.get("imports", []), run.folder)
            files.replace_text(run.folder / "config.yaml", configs.dump(dict(run.config)))
        before = self._point.restored.identity if self._point else None
        run_id = self._identity["run_id"] if self._identity else before["run_id"] if before else None
        self._identity = identify(run_id, run.config, run.experiment, imports)
        content = manifest.describe(run.experiment, run.num_updates, run.seeds)
        content |= {"run_id": self._identity["run_id"], "imports": imports}
        content |= {"changes_since_checkpoint": self._point.changes if self._point else []}
        self.was_described = run.config is not None
        manifest.write_manifest(run.folder / "manifest.json", content)

    def close(self) -> None:
        """Save the best states, wait until all files are on disk, and plot the curve.

        Raises an `OSError` if a checkpoint could not be written.
        """
        checkpoints, self._checkpoints = self._checkpoints, None
        if checkpoints:
            try:
                if self._best:
                    _save(checkpoints, self._best)
                checkpoints.close()
            finally:
                self.last_saved = checkpoints.last_written
        for logger in (x for loggers in self._loggers.values() for x in loggers):
            logger.close()
        self._loggers = {}
        if self.run.run_dir and self.rows:
            plot_curve(self.run, self.rows)

    def record(
        self, start: int, wall_seconds: float, metrics: dict[str, np.ndarray], states: TrainState | None
    ) -> None:
        """Record metrics [seeds, updates] of the updates from `start` on; `states` before them may be saved."""
        evaluation = {name: x[:, 0] for name, x in metrics.items() if name.startswith("eval/")}
        training = {name: x for name, x in metrics.items() if name not in evaluation and name != "is_finite"}
        is_evaluated = start % self.run.experiment.eval_every == 0
        record = self._resume_record(wall_seconds)
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
        """Save the final states; `evaluation` holds metrics [seeds] of them if training reached its end."""
        record = self._resume_record(wall_seconds)
        if evaluation is not None:
            self._add_rows(update, wall_seconds, evaluation)
        if self._log:
            record["final_rows"] = self._log.digest
        if self._checkpoints:
            score = None if evaluation is None else self._score(evaluation)
            self._consider(_Candidate(update, states, record, score))
            self.save()

    def save(self) -> None:
        """Write the best states, if they are not on disk yet, and the latest ones."""
        if not self._checkpoints:
            return
        config = self.run.folder / "config.yaml"
        if self.run.config is not None and not config.exists() and self.run.folder.exists():
            self._write_description()
            print(f"warning: {config} was deleted during training; it is restored", file=sys.stderr)
        for candidate in (self._best, self._last):
            if candidate:
                _save(self._checkpoints, candidate)
        self._best = None

    def latest_return(self) -> tuple[int, float] | None:
        """Return the update and the median return over seeds of the latest evaluation, `None` without one."""
        latest = [row[RETURN] for row in self.rows if row["update"] == self.rows[-1]["update"]]
        return (self.rows[-1]["update"], float(np.median(latest))) if latest else None

    @property
    def diverged(self) -> list[int]:
        """Seeds that are frozen because they diverged; `reason` says how each of them did."""
        return list(self.reason)

    def _note_diverged(self, start: int, metrics: dict[str, np.ndarray]) -> None:
        for index, seed in enumerate(self.run.seeds):
            wrong = np.flatnonzero(metrics["is_finite"][index] == 0)
            if wrong.size and seed not in self.reason:
                of_update = {name: x[index, wrong[0]] for name, x in metrics.items()}
                self.reason[seed] = _reason(of_update, start + int(wrong[0]))

    def _score(self, evaluation: dict[str, np.ndarray]) -> float | None:
        """Return the mean return over the seeds that have not diverged."""
        returns = [x for seed, x in zip(self.run.seeds, evaluation[RETURN], strict=True) if seed not in self.reason]
        score = float(np.mean(returns, dtype=float)) if returns else math.nan
        return score if math.isfinite(score) else None

    def _resume_record(self, wall_seconds: float) -> dict[str, Any]:
        """Return what resuming needs besides the training state."""
        return {
            "wall_seconds": wall_seconds,
            "since_evaluation": self._since_evaluation,
            "diverged": {str(seed): reason for seed, reason in self.reason.items()},
            "rows": self._log.digest if self._log else None,
        }

    def _add_rows(self, update: int, wall_seconds: float, evaluation: dict[str, np.ndarray]) -> None:
        """Add a row per seed: its evaluation at `update`, and means over the updates since the previous row."""
        rows = []
        for index, seed in enumerate(self.run.seeds):
            if seed not in self.reason and not np.isfinite(evaluation[RETURN][index]):
                self.reason[seed] = f"{RETURN} is {evaluation[RETURN][index]} at update {update}"
            if seed in self.reason:
                continue
            means = {name: _nanmean([x[index] for x in values]) for name, values in self._since_evaluation.items()}
            row = {
                "update": update,
                "agent_steps": update * self.run.experiment.agent_steps_per_update,
                "env_steps": update * self.run.experiment.env_steps_per_update,
                "wall_seconds": wall_seconds,
                "seed": seed,
            }
            rows.append(row | {name: float(x[index]) for name, x in evaluation.items()} | means)
        self._write_rows(rows)
        self._since_evaluation = {name: [] for name in self._since_evaluation}
        if self.run.run_dir and self.rows and time.monotonic() - self._last_plotted >= SECONDS_PER_CURVE:
            plot_curve(self.run, self.rows)
            self._last_plotted = time.monotonic()

    def _write_rows(self, rows: Sequence[Row]) -> None:
        self.rows.extend(rows)
        if self._log:
            self._log.append(rows)
        for row in rows:
            for logger in self._loggers.get(row["seed"], []):
                logger.log(row)

    def _consider(self, candidate: _Candidate) -> None:
        """Keep the states as the latest ones, and as the best ones if their score is the highest."""
        assert self._checkpoints
        best_score = self._best.score if self._best else self._checkpoints.best_score
        if candidate.score is not None and (best_score is None or candidate.score > best_score):
            self._best = candidate
        self._last = candidate


def _save(checkpoints: Checkpoints, candidate: _Candidate) -> None:
    checkpoints.save(candidate.update, candidate.states, candidate.record, candidate.score)


def plot_curve(run: Run, rows: Sequence[Row]) -> None:
    """Plot the learning curve of a run into its folder; a plot that fails never ends training."""
    assert run.run_dir
    title = f"{type(run.experiment.task).__name__}, {run.experiment.task.num_agents} agents"
    try:
        training_curve.draw_curve(run.run_dir / "curve.png", rows, title)
    except Exception as error:  # plotting depends on the user's fonts, files and libraries
        message = f"no curve.png: {type(error).__name__}: {error}"
        if message not in _warned:
            print(f"warning: {message}", file=sys.stderr)
            _warned.add(message)


def _reason(metrics: dict[str, Any], update: int) -> str:
    """Name the number that is not finite."""
    for name, value in metrics.items():
        if not np.isfinite(value) and is_loss(name):
            return f"{name} is {value} at update {update}"
    return f"a parameter is not finite at update {update}"


def _nanmean(values: list[float]) -> float:
    finite = [x for x in values if not math.isnan(x)]
    return math.fsum(finite) / len(finite) if finite else math.nan
