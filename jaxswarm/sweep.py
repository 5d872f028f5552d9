"""Many experiments, a run folder for each: numbers side by side in one program, structure one program after another."""

import csv
import dataclasses
import io
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxswarm import config as configs
from jaxswarm import render
from jaxswarm import runs as folders
from jaxswarm.checkpoint import replace_text
from jaxswarm.config import Config, ConfigError
from jaxswarm.fit import DivergedError, fit_runs
from jaxswarm.recording import Run, begun_and_new
from jaxswarm.reporting import RETURN, Row
from jaxswarm.training import Experiment

RANGE = re.compile(r"(?P<low>[^,]+?)\.\.(?P<high>[^,:]+):(?P<count>\d+) ?(?P<log>log)?$")


@dataclasses.dataclass(frozen=True)
class Trial:
    """One experiment of a sweep."""

    config: Config
    experiment: Experiment
    run_dir: Path

    @property
    def settings(self) -> configs.Run:
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
        return Run(self.experiment, self.settings.seeds, self.run_dir, self.settings.loggers, self.config, show)


def expand(words: Sequence[str]) -> list[Config]:
    """The config of every combination of the values of words like `key=a,b` or `key=1e-4..1e-3:5 log`."""
    combinations = configs.combinations([_listed(word) for word in words])
    return [configs.compose_pairs(pairs) for pairs in combinations]


def trials(wanted: Sequence[Config], sweep_dir: Path) -> list[Trial]:
    """A trial for each config, with a folder that is named by what it does not share with the others."""
    experiments = [configs.build(config) for config in wanted]
    labels = folders.label([folders.fields(config) for config in wanted]) if len(wanted) > 1 else ["run"]
    width = len(str(len(wanted) - 1))
    names = [
        f"{index:0{width}}-{re.sub(r'[^A-Za-z0-9.=_-]+', '-', label).replace('=', '_')}"
        for index, label in enumerate(labels)
    ]
    if len(set(labels)) < len(labels):
        names = ", ".join(sorted(folders.NOT_COMPARED))
        accepted = "other values of other keys, and num_seeds=N for N seeds"
        raise ConfigError(f"two runs of the sweep are the same but for {names}; accepted: {accepted}")
    return [
        Trial(config, experiment, sweep_dir / name)
        for config, experiment, name in zip(wanted, experiments, names, strict=True)
    ]


def programs(sweep: Sequence[Trial]) -> list[list[Trial]]:
    """Trials that share a program: those that differ in nothing that fixes a shape, or how they are trained."""

    def program(trial: Trial) -> tuple:
        settings = dataclasses.replace(trial.settings, seed=0)
        return jax.tree.structure(trial.experiment), trial.num_updates, settings

    grouped: dict[Any, list[Trial]] = {}
    for trial in sweep:
        grouped.setdefault(program(trial), []).append(trial)
    return list(grouped.values())


def train(together: Sequence[Trial], progress: bool = True) -> tuple[bool, list[list[Row]]]:
    """Trains trials that share a program, from where their folders stand.

    Returns whether they are finished, which they are not after Ctrl-C, and their rows. Trials of which all seeds
    diverge are finished. Those whose folders are new, where others have begun, are trained after these.
    """
    rows: dict[Path, list[Row]] = {}
    for run_dirs in filter(None, begun_and_new([trial.run_dir for trial in together])):
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


def summary(sweep: Sequence[Trial], rows: Sequence[Sequence[Row]]) -> list[dict[str, Any]]:
    """Of each trial the return at its end: median and quartiles over the seeds that reached it; those without a seed
    that diverged first, of these the best.
    """
    table = []
    for trial, of_trial in zip(sweep, rows, strict=True):
        final = [row[RETURN] for row in of_trial if row["update"] == trial.num_updates]
        low, median, high = np.percentile(final, [25, 50, 75]) if final else [np.nan] * 3
        numbers = {"median": float(median), "q25": float(low), "q75": float(high)}
        counts = {"seeds": len(final), "diverged": trial.settings.num_seeds - len(final)}
        table.append({"run": trial.run_dir.name} | numbers | counts)
    return sorted(table, key=lambda line: (line["diverged"], -np.nan_to_num(line["median"], nan=-np.inf)))


def write_summary(path: Path, table: Sequence[dict[str, Any]]) -> None:
    """The table as CSV."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    replace_text(path, buffer.getvalue())


def _listed(word: str) -> str:
    """A range as the list of its numbers."""
    key, equals, value = word.partition("=")
    found = RANGE.fullmatch(value)
    if not (equals and found):
        return word
    try:
        low, high, count = float(found["low"]), float(found["high"]), int(found["count"])
        if count < 2 or (found["log"] and min(low, high) <= 0):
            raise ValueError
    except ValueError:
        accepted = "low..high:count or low..high:count log, with count from 2 and, for log, numbers above 0"
        raise ConfigError(f"{word} is not possible; accepted: {key}={accepted}") from None
    numbers = np.geomspace(low, high, count) if found["log"] else np.linspace(low, high, count)
    is_whole = all(float(x).is_integer() for x in (low, high)) and all(abs(x - round(x)) < 1e-9 for x in numbers)
    texts = (str(round(x)) if is_whole and "." not in found["low"] + found["high"] else f"{x:.6g}" for x in numbers)
    return f"{key}={','.join(dict.fromkeys(texts))}"
