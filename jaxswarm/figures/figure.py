"""The figures of the thesis: their runs, the published curves, and their claims.

A figure is a file in `configs/figure`: its series as overrides for `jaxswarm-train`, and its claims. Series of the same
experiment share a run folder, also across figures.
"""

import dataclasses
import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxswarm import config as configs
from jaxswarm import files
from jaxswarm.analysis import curves, plots, run_folders, summaries
from jaxswarm.analysis.curves import Line
from jaxswarm.analysis.plots import Plot, Series
from jaxswarm.analysis.run_folders import RunFolder
from jaxswarm.config import Config, ConfigError
from jaxswarm.figures import claims
from jaxswarm.figures.claims import Claim, Measured, Verdict
from jaxswarm.files import RETURN, replace_text
from jaxswarm.host.run import Run

CURVES = Path(__file__).resolve().parent.parent / "data" / "curves"  # of the thesis
FRACTIONS = (0.5, 0.9, 0.95)  # of the way to the final level, in tables
KEPT_OF_MANIFEST = ("started", "versions", "platform", "device", "git_revision")
KEPT_OF_ROWS = ("update", "agent_steps", "wall_seconds", "seed", RETURN)
NUM_BOOTSTRAP = 200  # bootstrap resamples of the seeds, for the certainty of a claim


@dataclasses.dataclass(frozen=True)
class Figure:
    """The content of a figure's file, and the curves of the thesis by the names of our series (possibly none).

    Figures of the thesis use its names for the series; other figures map their names to those of the thesis.
    """

    name: str
    title: str
    series: Mapping[str, tuple[str, ...]]  # overrides for `configs.compose`
    claims: tuple[Claim, ...]
    references: Mapping[str, Line]
    thesis: Mapping[str, str]  # name of the reference of each series
    num_updates: int  # length shown; the thesis trained some series for longer
    num_seeds: int  # seeds of each series that a verdict needs
    best_share: float  # share of the seeds that is shown: those with the highest means over their curves
    y: tuple[str, ...]  # scales of the plots: linear, log

    @property
    def num_shown(self) -> int:
        """Number of seeds of a series that are shown, if there are as many as a verdict needs."""
        return curves.num_best(self.num_seeds, self.best_share)

    @property
    def pictures(self) -> dict[str, str]:
        """File names of the plots, each with its logarithmic axes."""
        return {self.name if scale == "linear" else f"{self.name}_{scale}": "y" * (scale == "log") for scale in self.y}


def names() -> list[str]:
    """Return the names of all figures: those of the thesis in its order, then our own."""
    found = (path.stem for path in (configs.config_dir() / configs.FIGURES).glob("*.yaml"))

    def place(name: str) -> tuple:
        parts = [(not part.isdigit(), int(part) if part.isdigit() else 0, part) for part in name.split("_")]
        return name.startswith("best_"), parts

    return sorted(found, key=place)


def load_figure(name: str) -> Figure:
    """Load the figure of this name; a `ConfigError` lists the valid names."""
    if name not in names():
        raise ConfigError(f"figure: must be one of all, {', '.join(names())}, got {name!r}")
    fields: dict[str, Any] = configs.read(configs.config_dir() / configs.FIGURES / f"{name}.yaml")
    del fields["description"]
    overrides, reference = fields.pop("overrides").split(), fields.pop("reference", None)
    thesis = fields.pop("thesis", None) or {series: series for series in fields["series"]}
    fields["series"] = {series: (*overrides, *own.split()) for series, own in fields["series"].items()}
    fields["claims"] = tuple(_claim(**claim) for claim in fields["claims"])
    fields["y"] = tuple(fields.pop("y", ["linear"]))
    fields["best_share"] = float(fields.pop("best_share", 1.0))
    lines = curves.read_lines(CURVES / f"{reference}.csv") if reference else {}
    references = {own: lines[theirs] for own, theirs in thesis.items() if lines}
    return Figure(name=name, references=references, thesis=thesis, **fields)


def find_runs(*directories: Path) -> list[RunFolder]:
    """Find all runs in the directories, of any figure; among folders of the same name, the longest run."""
    found: dict[str, RunFolder] = {}
    for directory in directories:
        for config in sorted(directory.glob("*/config.yaml")):
            folder = run_folders.read(config.parent)
            found[folder.path.name] = max(found.get(folder.path.name, folder), folder, key=lambda one: len(one.rows))
    return list(found.values())


def keep_results(folder: RunFolder, directory: Path) -> None:
    """Copy what reports need of a run: config, evaluations, and the versions and the device of its training."""
    kept = directory / folder.path.name
    if kept.resolve() == folder.path.resolve():
        return
    kept.mkdir(parents=True, exist_ok=True)
    replace_text(kept / "config.yaml", (folder.path / "config.yaml").read_text())
    manifest = {name: x for name, x in _manifest(folder).items() if name in KEPT_OF_MANIFEST}
    replace_text(kept / "manifest.json", json.dumps(manifest, indent=2) + "\n")
    of_evaluations = [{name: x for name, x in row.items() if name in KEPT_OF_ROWS} for row in folder.rows]
    files.write_rows(kept / "metrics.csv", of_evaluations)


def plan(
    figure: Figure,
    directory: Path,
    found: Sequence[RunFolder] = (),
    num_seeds: int | None = None,
    scale: float = 1.0,
    overrides: Sequence[str] = (),
) -> dict[str, list[Run]]:
    """Return the runs of each series: folders that already hold some of its seeds, and new folders for the rest.

    Runs have `scale` times the length that the figure shows; `overrides` apply to all series.
    """
    wanted = {
        series: _cut(figure, [*own, *overrides], num_seeds or figure.num_seeds, scale)
        for series, own in figure.series.items()
    }
    return {series: _runs(config, directory, found) for series, config in wanted.items()}


def is_finished(run: Run) -> bool:
    """Return whether the run's folder has been trained for at least the run's length."""
    rows = files.read_rows(run.folder / "metrics.csv")
    return any(row["update"] >= run.num_updates for row in rows)


def measure(
    figure: Figure, runs: Mapping[str, Sequence[Run]], found: Sequence[RunFolder], warn: Callable[[str], object]
) -> dict[str, Measured]:
    """Measure each series of the figure over all seeds found in any run; series without seeds are left out.

    As in the thesis, an evaluation is placed after the update that follows it, so the untrained policy is not at 0.
    """
    measured, generator = {}, np.random.default_rng(0)
    for series, (run, *_) in runs.items():
        per_update = run.experiment.agent_steps_per_update
        end = float(figure.num_updates * per_update)
        same = [folder for folder in found if matches(folder, run.config)]
        seeds = (
            run_folders.seeds(same, "agent_steps", RETURN, warn, once=True)
            if any(folder.rows for folder in same)
            else []
        )
        if seeds:
            shifted = [dataclasses.replace(seed, x=seed.x + per_update) for seed in seeds]
            line = _cut_line(curves.summarize(shifted, "median", figure.best_share), end)
            bootstrapped = curves.bootstrapped(shifted, "median", NUM_BOOTSTRAP, generator, figure.best_share)
            bootstrapped = tuple(_cut_line(one, end) for one in bootstrapped)
            reference = figure.references.get(series)
            end = min(end, float(reference.x[-1])) if reference else end
            last = min(end, line.x[-1])
            finals = curves.final_levels(shifted, (1 - claims.LAST) * last, last, figure.best_share)
            measured[series] = Measured(line, reference or line, end, bootstrapped, finals)
    return measured


def matches(folder: RunFolder, config: Mapping[str, Any] | None) -> bool:
    """Return whether a folder holds the config's experiment, whatever its seeds and length."""
    if config is None or folder.config != run_folders.fields(dict(config)):
        return False
    return configs.read(folder.path / "config.yaml").get("eval_every") == config["eval_every"]


def origin(folder: RunFolder) -> tuple[str, str]:
    """Return the device and the revision of the code of a run's last session."""
    manifest = _manifest(folder)
    device = manifest.get("device", {}).get("backend", "unknown devices")
    return device, (manifest.get("git_revision") or "unknown")[:12]


def thesis_measured(figure: Figure) -> dict[str, Measured]:
    """Return the curves of the thesis, measured in the same way as ours."""
    return {name: Measured(line, line, float(line.x[-1])) for name, line in figure.references.items()}


def verdicts(figure: Figure, measured: Mapping[str, Measured]) -> list[Verdict]:
    """Return the verdict on each claim of the figure."""
    theirs = thesis_measured(figure)
    return [claims.judge(claim, measured, theirs, figure.num_shown) for claim in figure.claims]


def plot_figure(figure: Figure, measured: Mapping[str, Measured], out: Path) -> list[Path]:
    """Plot the figure with the curves of the thesis overlaid, write its points as CSV, and return all files."""
    counts = {name: plots.seed_count(int(ours.line.num_seeds.max())) for name, ours in measured.items()}
    series = [Series(name, ours.line, counts[name]) for name, ours in measured.items()]
    for name, line in figure.references.items():
        source = "thesis" if figure.thesis[name] == name else f"thesis: {figure.thesis[name]}"
        series.append(Series(name, line, f"{source}, {line.num_seeds[0]} runs", is_reference=True))
    seeds = "seeds" if figure.best_share == 1 else f"the best {figure.best_share:.0%} of the seeds"
    caption = f"Median and quartiles over {seeds}" + ("; dashed: the thesis" if figure.references else "")
    out.mkdir(parents=True, exist_ok=True)
    written = []
    for name, log in figure.pictures.items():
        label = "return of an episode"
        plot = Plot("curve", series, "agent_steps", f"median of {RETURN}", label, figure.title, caption, log)
        plots.draw(out / f"{name}.png", plot)
        replace_text(out / f"{figure.name}.csv", plots.table([plot]))
        written.append(out / f"{name}.png")
    return [*written, out / f"{figure.name}.csv"]


def write_summary(figure: Figure, measured: Mapping[str, Measured], out: Path) -> list[Path]:
    """Write statistics of the final levels of the seeds as CSV and LaTeX, and return the files.

    Seeds that end before their series are left out. The first series is compared with the others.
    """
    finals = {name: ours.finals for name, ours in measured.items()}
    lines = [
        {"series": name, "seeds": len(values), "agent_steps": min(measured[name].end, measured[name].line.x[-1])}
        | summaries.summarize(values)
        | summaries.versus_first(finals, name)
        for name, values in finals.items()
    ]
    return summaries.write(out / f"{figure.name}_summary", lines, summaries.pairs(finals))


def _manifest(folder: RunFolder) -> dict[str, Any]:
    try:
        return json.loads((folder.path / "manifest.json").read_text())
    except (OSError, ValueError):
        return {}


def _claim(says: str, kind: str, series: Sequence[str], **numbers: int | float) -> Claim:
    return Claim(says, kind, tuple(series), **{name: float(x) for name, x in numbers.items()})


def _cut(figure: Figure, overrides: Sequence[str], num_seeds: int, scale: float) -> Config:
    config = configs.compose(overrides)
    total = configs.run_settings(config).length(configs.build(config).agent_steps_per_update)
    num_updates = min(max(1, math.ceil(scale * figure.num_updates - 1e-9)), total)
    return configs.override(config, [("num_updates", num_updates), ("num_seeds", num_seeds)])


def _runs(config: Config, directory: Path, found: Sequence[RunFolder]) -> list[Run]:
    """Return runs for all seeds: folders that hold seeds which no larger folder holds, then new folders."""
    experiment, missing = configs.build(config), set(configs.run_settings(config).seeds)
    held = {
        folder.path: configs.run_settings(configs.load(folder.path / "config.yaml")).seeds
        for folder in found
        if matches(folder, config)
    }
    parts = "-".join(config[part]["name"] for part in configs.REGISTERED)
    digest = hashlib.sha256(json.dumps(run_folders.fields(config), sort_keys=True).encode()).hexdigest()[:8]
    runs = []

    def add(path: Path, seeds: Sequence[int]) -> None:
        own = configs.override(config, [("seed", seeds[0]), ("num_seeds", len(seeds))])
        runs.append(Run(experiment, configs.run_settings(own), path, own))
        missing.difference_update(seeds)

    for path, seeds in sorted(held.items(), key=lambda item: -len(item[1])):
        if missing.intersection(seeds):
            add(path, seeds)
    while missing:
        first = last = min(missing)
        while last + 1 in missing:
            last += 1
        add(directory / f"{parts}-{digest}-seeds-{first}-{last}", range(first, last + 1))
    return runs


def _cut_line(line: Line, end: float) -> Line:
    """Return the part of a line up to `end`, and at least its first point."""
    size = max(1, int(np.searchsorted(line.x, end * (1 + 1e-9), side="right")))
    return Line(line.x[:size], line.y[:size], line.lower[:size], line.upper[:size], line.num_seeds[:size])
