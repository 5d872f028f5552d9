"""The program `jaxswarm-plot`."""

import dataclasses
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxswarm.analysis import curves, plots
from jaxswarm.analysis import run_folders as runs
from jaxswarm.analysis.curves import STATISTICS, Curve
from jaxswarm.analysis.plots import Plot, Series
from jaxswarm.analysis.run_folders import RunFolder
from jaxswarm.cli.program import parse_integer, program, split, wants_help
from jaxswarm.config import ConfigError, schema
from jaxswarm.files import replace_text

HELP = """\
jaxswarm-plot PATH... [key=value ...]

Plots learning curves of runs with their spread over seeds, and writes the points as CSV next to the plot. Runs form a
group if they differ only in seed, length, checkpoints and times of evaluation. Groups are labeled by the settings that
differ.

options
  PATH...                  Run folders, or folders that contain run folders. Required.
  out=FILE                 Path of the plot: .png, .svg or .pdf, default: plot.png.
  kind=KIND                Kind of plot, default: curve.
                           curve: a statistic over seeds against x.
                           profile: the fraction of seeds that end above each value of y.
                           threshold: the fraction of seeds that have reached a value of y, against x.
  threshold=VALUE          Value of kind=threshold. Number, required there.
  statistic=NAME           Statistic of kind=curve, default: median.
                           median: median with quartiles.
                           iqm: interquartile mean with 95 % stratified bootstrap intervals.
  seeds=BOOL               Also plot each seed of kind=curve as a thin line: true or false, default: false.
  y=COLUMN                 Column of metrics.csv for the vertical axis, default: eval/return.
  x=COLUMN                 Horizontal axis: agent_steps, wall_seconds or update, default: agent_steps.
  log=AXES                 Logarithmic axes: x, y or xy, default: none.
  smooth=N                 Replace each evaluation of a seed by the mean of the last N. Integer >= 1, default: 1.
  reference=FILE.csv,...   Overlay the curves of CSV files with the columns series, agent_steps, median, q25 and q75,
                           default: none.
  series=TEXT              Overlay only references whose names contain the text, default: all.
  title=TEXT               Title of the plot, default: the parts that all groups share, if there are several groups.

examples
  jaxswarm-plot runs
  jaxswarm-plot runs/a runs/b out=figure.pdf statistic=iqm log=x
  jaxswarm-plot runs kind=threshold threshold=-30 x=wall_seconds
"""
NAMES = {"eval/return": "return of an episode"}
UNITS = {"agent_steps": "agent steps", "wall_seconds": "seconds", "update": "updates"}


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the program, as text from the command line."""

    out: str = ""
    kind: str = "curve"
    threshold: str = ""
    statistic: str = "median"
    seeds: str = "false"
    y: str = "eval/return"
    x: str = "agent_steps"
    log: str = ""
    smooth: str = "1"
    reference: str = ""
    series: str = ""
    title: str = ""

    def __post_init__(self) -> None:
        for name, accepted in CHOICES.items():
            if getattr(self, name) not in accepted:
                choices = ", ".join(filter(None, accepted))
                raise ConfigError(f"{name}: must be one of {choices}, got {getattr(self, name)!r}")
        parse_integer("smooth", self.smooth, 1)
        if self.kind == "threshold" and not _is_number(self.threshold):
            raise ConfigError(f"threshold: must be a number such as threshold=-30, got {self.threshold!r}")
        if self.threshold and self.kind != "threshold":
            raise ConfigError(f"threshold: must be used with kind=threshold, got kind={self.kind}")
        if self.statistic != Options.statistic and self.kind != "curve":
            raise ConfigError(f"statistic: must be used with kind=curve, got kind={self.kind}")
        if self.seeds == "true" and self.kind != "curve":
            raise ConfigError(f"seeds: must be used with kind=curve, got kind={self.kind}")
        if self.reference and (self.kind, self.x) != ("curve", "agent_steps"):
            raise ConfigError(
                f"reference: must be used with kind=curve and x=agent_steps, got {self.kind} and {self.x}"
            )
        if self.series and not self.reference:
            raise ConfigError("series: must be used with reference=FILE.csv")
        if self.log and self.kind != "curve" and (self.log, self.kind) != ("x", "threshold"):
            raise ConfigError(f"log: must be used with kind=curve, got kind={self.kind}")


@program
def main(arguments: Sequence[str]) -> int:
    """Plot runs; return the exit code."""
    if wants_help(arguments) or not arguments:
        print(HELP)
        return 0 if arguments else 2
    options, paths = _parse(arguments)
    out = _output(options.out)
    files = filter(None, options.reference.split(","))
    references = [series for file in files for series in _references(Path(file), options)]
    groups = _groups([runs.read(path) for path in runs.find(paths)], options)
    title = options.title or (_shared_name(groups) if len(groups) > 1 else "")
    plot = KINDS[options.kind](_seeds(groups, options), options)
    caption = plot.caption + ("; dashed: references, median and quartiles" if references else "")
    series = [*plot.series, *references]
    plot = dataclasses.replace(plot, series=series, title=title, caption=caption, log=options.log)
    _write(out, plot)
    for series in plot.series:
        if not series.is_reference:
            print(f"{series.label}: {series.note}")
    print(f"wrote {out}\nwrote {out.with_suffix('.csv')}")
    return 0


def _parse(arguments: Sequence[str]) -> tuple[Options, list[Path]]:
    """Return options and paths. An argument that exists as a file or folder is a path, even if it contains "="."""
    names = [field.name for field in dataclasses.fields(Options)]
    options, overrides = split(arguments, names)
    for word in overrides:
        name, equals, _ = word.partition("=")
        if equals and not os.path.exists(word):
            near = schema.nearest(name, names)
            raise ConfigError(f"unknown key {name!r}{near}; valid keys: {', '.join(names)}")
    if not overrides:
        raise ConfigError("give a run folder, or a folder that contains some: jaxswarm-plot PATH... [key=value ...]")
    return Options(**options), [Path(word) for word in overrides]


def _output(out: str) -> Path:
    """Return the path of the plot.

    Raises a `ConfigError` if the plot or its table would replace a file that this program did not write.
    """
    path = Path(out or "plot.png")
    if path.suffix[1:].lower() not in plots.FORMATS:
        raise ConfigError(f"out: must be one of {', '.join(f'FILE.{x}' for x in plots.FORMATS)}, got {out!r}")
    table = path.with_suffix(".csv")
    if path.is_dir() or table.is_dir():
        raise ConfigError(f"out: must be a file, got the folder {out!r}")
    is_ours = table.exists() and table.read_bytes().startswith(",".join(plots.COLUMNS).encode())
    if table.exists() and not is_ours:
        raise ConfigError(f"out={path} would replace {table}, which jaxswarm-plot did not write; choose another name")
    if not out and path.exists() and not is_ours:
        raise ConfigError(f"{path} exists, and jaxswarm-plot did not write it; choose a name with out=FILE.png")
    return path


def _references(path: Path, options: Options) -> list[Series]:
    """Read the curves of a CSV file. Their notes in the legend are the name of the file and the number of runs."""
    try:
        lines = curves.read_lines(path)
    except OSError as error:
        raise ConfigError(f"reference: cannot read {path}: {error.strerror}") from error
    except ValueError as error:
        raise ConfigError(f"reference: cannot read {path}: {error}") from error
    chosen = {name: line for name, line in lines.items() if options.series.lower() in name.lower()}
    if not chosen:
        raise ConfigError(
            f"series: must be part of one of the names in {path} ({', '.join(lines)}), got {options.series!r}"
        )
    sources = {name: f"{path.stem}, {line.num_seeds[0]} runs" for name, line in chosen.items() if line.num_seeds[0]}
    return [Series(name, line, sources.get(name, path.stem), is_reference=True) for name, line in chosen.items()]


def _groups(folders: Sequence[RunFolder], options: Options) -> dict[str, list[RunFolder]]:
    """Group the runs. Raise a `ConfigError` if there are no evaluations, or no such columns."""
    columns = sorted({name for folder in folders for row in folder.rows[:1] for name in row} - {"seed"})
    if not columns:
        raise ConfigError("the runs have no evaluation yet")
    for key in ("x", "y"):
        name = getattr(options, key)
        if name not in columns:
            near = schema.nearest(name, columns)
            raise ConfigError(f"{key}: must be one of {', '.join(columns)}, got {name!r}{near}")
    return runs.group(folders)


def _seeds(groups: Mapping[str, Sequence[RunFolder]], options: Options) -> dict[str, list[Curve]]:
    """Return the curves of each group, smoothed by the option `smooth`. Groups without curves are left out."""
    found = {label: runs.seeds(members, options.x, options.y, _warn) for label, members in groups.items()}
    size = int(options.smooth)
    found = {label: [curves.trailing_mean(x, size) for x in seeds] for label, seeds in found.items() if seeds}
    if not found:
        raise ConfigError(f"y: must be finite in at least one run, got no finite {options.y}")
    return found


def _curve(groups: Mapping[str, Sequence[Curve]], options: Options) -> Plot:
    statistic = STATISTICS[options.statistic]
    lines = {label: curves.summarize(seeds, options.statistic) for label, seeds in groups.items()}
    series = []
    for label, line in lines.items():
        thin_lines = groups[label] if options.seeds == "true" else ()
        most, last = int(line.num_seeds.max()), int(line.num_seeds[-1])
        note = plots.seed_count(most) + (f", {last} at the end" if last < most else "")
        series.append(Series(label, line, note, seeds=thin_lines))
    caption = f"{statistic.name} and {statistic.band} over seeds".capitalize()
    caption += ", and each seed" if options.seeds == "true" else ""
    if any(np.ptp(line.num_seeds) for line in lines.values()):
        caption += "; pale where not all seeds have values"
    y_name = f"{options.statistic} of {options.y}"
    return Plot("curve", series, options.x, y_name, _name(options), caption=_smoothed(caption, options))


def _profile(groups: Mapping[str, Sequence[Curve]], options: Options) -> Plot:
    finals = {label: np.array([curve.y[-1] for curve in seeds]) for label, seeds in groups.items()}
    at = np.unique(np.concatenate(list(finals.values())))
    margin = 0.05 * (np.ptp(at) or abs(at[0]) or 1.0)
    at = np.concatenate([[at[0] - margin], at, [at[-1] + margin]])
    series = [Series(label, curves.profile(x, at), plots.seed_count(len(x))) for label, x in finals.items()]
    ends = [curve.x[-1] for seeds in groups.values() for curve in seeds]
    caption = f"Last evaluation of each seed, at {_amount(max(ends), options.x)}"
    caption += f" (the first to end: {_amount(min(ends), options.x)})" if min(ends) < max(ends) else ""
    caption = _smoothed(f"{caption}; 95 % stratified bootstrap intervals", options)
    fraction = "fraction of seeds that end above"
    return Plot("profile", series, _name(options), fraction, fraction, caption=caption, is_step=True)


def _threshold(groups: Mapping[str, Sequence[Curve]], options: Options) -> Plot:
    threshold, series = float(options.threshold), []
    for label, seeds in groups.items():
        times, is_reached = curves.times_to(seeds, threshold)
        line = curves.reaching(seeds, threshold)
        half = line.x[line.y >= 0.5]
        half_text = f"half by {_amount(half[0], options.x)}" if half.size else "fewer than half"
        note = f"{is_reached.sum()} of {plots.seed_count(len(seeds))}, {half_text}"
        series.append(Series(label, line, note, censored=np.sort(times[~is_reached])))
    fraction = f"fraction of seeds that reached {options.threshold}"
    caption = f"{_name(options)}, first evaluation at or above {options.threshold}".capitalize()
    caption += "; Kaplan-Meier estimate with 95 % intervals; ticks: seeds that ended before"
    caption = _smoothed(caption, options)
    return Plot("threshold", series, options.x, fraction, fraction, caption=caption, is_step=True)


KINDS: dict[str, Callable[[Mapping[str, Sequence[Curve]], Options], Plot]] = {
    "curve": _curve,
    "profile": _profile,
    "threshold": _threshold,
}


CHOICES = {
    "kind": tuple(KINDS),
    "statistic": tuple(STATISTICS),
    "seeds": ("false", "true"),
    "x": ("agent_steps", "wall_seconds", "update"),
    "log": ("", "x", "y", "xy"),
}


def _write(out: Path, plot: Plot) -> None:
    try:
        plots.check(plot)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    if "x" in plot.log:
        hidden = sum(int((series.line.x <= 0).sum()) for series in plot.series)
        if hidden:
            _warn(f"a logarithmic axis cannot show {plot.x_name} = 0; number of points left out: {hidden}")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        replace_text(out.with_suffix(".csv"), plots.table(plot))
        plots.draw(out, plot)
    except OSError as error:
        raise ConfigError(f"out: cannot write to {out.parent}: {error.strerror}") from error


def _warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr)


def _shared_name(groups: Mapping[str, Sequence[RunFolder]]) -> str:
    return runs.common_name([members[0].config for members in groups.values()])


def _name(options: Options) -> str:
    """Return the label of the column `y`."""
    return NAMES.get(options.y, options.y)


def _smoothed(caption: str, options: Options) -> str:
    return caption + (f"; means of {options.smooth} evaluations" if int(options.smooth) > 1 else "")


def _amount(value: float, name: str) -> str:
    """Format a value of the horizontal axis with its unit, such as "2.5 million agent steps"."""
    size, unit = (1e6, "million ") if value >= 1e6 else (1, "")
    return f"{value / size:,.4g} {unit}{UNITS[name]}"


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
