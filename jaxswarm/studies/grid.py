"""Many experiments, a run folder for each: numbers side by side in one program, structure one program after another."""

import csv
import dataclasses
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxswarm import config as configs
from jaxswarm.analysis import run_folders as folders
from jaxswarm.config import Config, ConfigError
from jaxswarm.files import RETURN, Row, replace_text
from jaxswarm.studies.trials import Trial

RANGE = re.compile(r"(?P<low>[^,]+?)\.\.(?P<high>[^,:]+):(?P<count>\d+) ?(?P<log>log)?$")


def expand(overrides: Sequence[str]) -> list[Config]:
    """The config of every combination of the values of words like `key=a,b` or `key=1e-4..1e-3:5 log`."""
    combinations = configs.combinations([_listed(word) for word in overrides])
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
        raise ConfigError(f"two runs of the sweep differ only in {names}; give {accepted}")
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
        raise ConfigError(f"{key}: must be {accepted}, got {value!r}") from None
    numbers = np.geomspace(low, high, count) if found["log"] else np.linspace(low, high, count)
    is_integer = all(float(x).is_integer() for x in (low, high)) and all(abs(x - round(x)) < 1e-9 for x in numbers)
    texts = (str(round(x)) if is_integer and "." not in found["low"] + found["high"] else f"{x:.6g}" for x in numbers)
    return f"{key}={','.join(dict.fromkeys(texts))}"
