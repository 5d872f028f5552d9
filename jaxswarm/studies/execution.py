"""Training of the runs of a study, from whatever state their folders are in."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jaxswarm.files import Row
from jaxswarm.host.fit import DivergedError, fit_runs
from jaxswarm.host.run import Run, split_started


class Outcome(NamedTuple):
    """Result of a training session: whether the runs are finished (not after Ctrl-C), and the rows of each run."""

    is_finished: bool
    rows: list[list[Row]]


def train(runs: Sequence[Run], progress: bool = True) -> Outcome:
    """Train runs that share a program; each resumes from its folder.

    A run of which all seeds diverge is finished. Runs with new folders are trained after those that have started.
    """
    rows: dict[Path | None, list[Row]] = {}
    for run_dirs in filter(None, split_started([run.run_dir for run in runs if run.run_dir])):
        outcome = _train_together([run for run in runs if run.run_dir in run_dirs], progress)
        rows |= dict(zip(run_dirs, outcome.rows, strict=True))
        if not outcome.is_finished:
            return Outcome(False, [[]] * len(runs))
    return Outcome(True, [rows[run.run_dir] for run in runs])


def _train_together(runs: Sequence[Run], progress: bool) -> Outcome:
    try:
        states, rows = fit_runs(runs, resume=True, progress=progress)
    except DivergedError as error:
        return Outcome(True, error.rows)
    return Outcome(bool(states.update.max() == runs[0].num_updates or not states.is_finite.any()), rows)
