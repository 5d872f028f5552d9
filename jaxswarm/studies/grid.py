"""Grids of experiments, each with its own run folder.

Runs that differ only in numeric hyperparameters are vectorized in one program; other programs run one after another.
"""

import dataclasses
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxswarm import config as configs
from jaxswarm.analysis import run_folders as folders
from jaxswarm.analysis import summaries
from jaxswarm.analysis.comparability import Comparison, compare
from jaxswarm.config import Config, ConfigError
from jaxswarm.config.overrides import MAX_COMBINATIONS
from jaxswarm.files import Row
from jaxswarm.host.run import Run

RANGE = re.compile(r"(?P<low>[^,]+?)\.\.(?P<high>[^,:]+):(?P<count>\d+) ?(?P<log>log)?$")


def expand(overrides: Sequence[str]) -> list[Config]:
    """Return the config of every combination of values in overrides such as `key=a,b` or `key=1e-4..1e-3:5 log`."""
    overrides = [_listed(word) for word in overrides]
    for word in overrides:
        key = word.partition("=")[0]
        if key in folders.NOT_COMPARED and len(configs.combinations([word])) > 1:
            hint = "train several seeds with num_seeds=N" if "seed" in key else "sweep other keys"
            raise ConfigError(f"{key}: must have one value in a sweep, got {word.partition('=')[2]}; {hint}")
    return [configs.compose_pairs(pairs) for pairs in configs.combinations(overrides)]


def runs(wanted: Sequence[Config], sweep_dir: Path) -> list[Run]:
    """Return a run for each config. Its folder is named by the settings that differ between the configs.

    Raises a `ConfigError` if two configs differ only in settings that are not compared, such as the seed.
    """
    experiments = [configs.build(config) for config in wanted]
    labels = folders.label([folders.fields(config) for config in wanted]) if len(wanted) > 1 else ["run"]
    width = len(str(len(wanted) - 1))
    names = [
        f"{index:0{width}}-{re.sub(r'[^A-Za-z0-9.=_-]+', '-', label).replace('=', '_')}"
        for index, label in enumerate(labels)
    ]
    if len(set(labels)) < len(labels):
        names = ", ".join(sorted(folders.NOT_COMPARED))
        accepted = "values of other keys, or num_seeds=N to train N seeds"
        raise ConfigError(f"two runs of the sweep differ only in {names}; give {accepted}")
    return [
        Run(experiment, configs.run_settings(config), sweep_dir / name, config)
        for config, experiment, name in zip(wanted, experiments, names, strict=True)
    ]


def programs(sweep: Sequence[Run]) -> list[list[Run]]:
    """Group runs that share a compiled program: they differ only in numeric hyperparameters and seeds."""

    def program(run: Run) -> tuple:
        settings = dataclasses.replace(run.settings, seed=0)
        return jax.tree.structure(run.experiment), run.num_updates, settings

    grouped: dict[Any, list[Run]] = {}
    for run in sweep:
        grouped.setdefault(program(run), []).append(run)
    return list(grouped.values())


@dataclasses.dataclass(frozen=True)
class Summary:
    """Final values of the runs of a sweep: a line per run, and a line per pair of runs."""

    comparison: Comparison
    lines: list[summaries.Line]
    improvements: list[summaries.Line]


def summary(sweep: Sequence[Run], rows: Sequence[Sequence[Row]]) -> Summary:
    """Return statistics of the final return of each run over the seeds that reached the end.

    If a setting differs on which the scale of the return depends, they are those of a metric that does not depend on
    it. Runs are sorted by the number of seeds that diverged, lowest first, and then by the median, best first.
    """
    comparison = compare([run.config["task"] for run in sweep if run.config])
    column, lines, finals = f"eval/{comparison.metric}", [], {}
    for run, of_run in zip(sweep, rows, strict=True):
        at_end = [row for row in of_run if row["update"] == run.num_updates]
        values = np.array([row.get(column, np.nan) for row in at_end], float)
        finals[run.folder.name] = values[np.isfinite(values)]
        counts = {"seeds": len(at_end), "diverged": run.settings.num_seeds - len(at_end)}
        lines.append({"run": run.folder.name, "metric": column} | summaries.summarize(finals[run.folder.name]) | counts)

    def place(line: summaries.Line) -> tuple[int, float]:
        return line["diverged"], -np.nan_to_num(comparison.better(line["median"]), nan=-np.inf)

    lines.sort(key=place)
    ordered = {line["run"]: finals[line["run"]] for line in lines}
    lines = [line | summaries.versus_first(ordered, line["run"], comparison.is_higher_better) for line in lines]
    return Summary(comparison, lines, summaries.pairs(ordered, comparison.is_higher_better))


def _listed(word: str) -> str:
    """Return an override with its range, if any, replaced by the list of the numbers."""
    key, equals, value = word.partition("=")
    found = RANGE.fullmatch(value)
    if not (equals and found):
        return word
    try:
        low, high, count = float(found["low"]), float(found["high"]), int(found["count"])
        is_valid = count >= 2 and math.isfinite(high - low) and not (found["log"] and min(low, high) <= 0)
        if not is_valid or count > MAX_COMBINATIONS:
            raise ValueError
    except ValueError:
        counts = f"2 <= count <= {MAX_COMBINATIONS}"
        accepted = f"low..high:count or 'low..high:count log' with {counts} and, for log, positive numbers"
        raise ConfigError(f"{key}: must be {accepted}, got {value!r}") from None
    numbers = np.geomspace(low, high, count) if found["log"] else np.linspace(low, high, count)
    is_integer = all(float(x).is_integer() for x in (low, high)) and all(abs(x - round(x)) < 1e-9 for x in numbers)
    texts = (str(round(x)) if is_integer and "." not in found["low"] + found["high"] else f"{x:.6g}" for x in numbers)
    return f"{key}={','.join(dict.fromkeys(texts))}"
