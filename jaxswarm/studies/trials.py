"""Configs that are trained, each in a run folder of its own."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

from jaxswarm import config as configs
from jaxswarm import render
from jaxswarm.config import Config
from jaxswarm.files import Row
from jaxswarm.host import trained as policies
from jaxswarm.host.fit import DivergedError, fit_runs
from jaxswarm.host.recorder import Run, started_and_new
from jaxswarm.training import Experiment


@dataclasses.dataclass(frozen=True)
class Trial:
    """A config with its experiment, and the folder that it is trained in."""

    config: Config
    experiment: Experiment
    run_dir: Path

    @property
    def settings(self) -> configs.RunSettings:
        """What the config says beyond the experiment."""
        return configs.run_settings(self.config)

    @property
    def num_updates(self) -> int:
        """How long it is trained."""
        return self.settings.length(self.experiment.agent_steps_per_update)

    @property
    def num_evaluations(self) -> int:
        """How often its policies are evaluated, the last ones included."""
        return math.ceil(self.num_updates / self.experiment.eval_every) + 1

    def run(self) -> Run:
        """What `fit_runs` takes."""
        render_every = self.settings.render_every
        show = render.hook(self.run_dir, self.experiment, render_every) if render_every else None
        params = policies.warm_start(self.settings, self.run_dir)
        loggers = self.settings.loggers
        return Run(self.experiment, self.settings.seeds, self.run_dir, loggers, self.config, show, params)


def train(together: Sequence[Trial], progress: bool = True) -> tuple[bool, list[list[Row]]]:
    """Trains trials that share a program, from where their folders stand.

    Returns whether they are finished, which they are not after Ctrl-C, and their rows. Trials of which all seeds
    diverge are finished. Those whose folders are new, where others have begun, are trained after these.
    """
    rows: dict[Path, list[Row]] = {}
    for run_dirs in filter(None, started_and_new([trial.run_dir for trial in together])):
        is_finished, of_part = _train([trial for trial in together if trial.run_dir in run_dirs], progress)
        rows |= dict(zip(run_dirs, of_part, strict=True))
        if not is_finished:
            return False, [[]] * len(together)
    return True, [rows[trial.run_dir] for trial in together]


def _train(together: Sequence[Trial], progress: bool) -> tuple[bool, list[list[Row]]]:
    settings, num_updates = together[0].settings, together[0].num_updates
    try:
        states, rows = fit_runs(
            [trial.run() for trial in together],
            num_updates,
            resume=True,
            progress=progress,
            checkpoint_seconds=settings.checkpoint_seconds,
            keep_checkpoints=settings.keep_checkpoints,
        )
    except DivergedError as error:
        return True, error.rows
    return bool(states.update.max() == num_updates or not states.is_finite.any()), rows
