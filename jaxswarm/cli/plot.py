"""The program `jaxswarm-plot`."""

import dataclasses
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxswarm.analysis import curves, plots
from jaxswarm.analysis import run_folders as runs
from jaxswarm.analysis.curves import STATISTICS, Curve
from jaxswarm.analysis.plots import Picture, Series
from jaxswarm.analysis.run_folders import RunFolder
from jaxswarm.cli.program import parse_integer, program, split, wants_help
from jaxswarm.config import ConfigError, schema
from jaxswarm.files import replace_text

HELP = """\
jaxswarm-plot PATH... [out=FILE.png] [key=value ...]

Draws learning curves of runs with their spread over seeds, and writes the points as CSV beside the picture. A PATH is
a run folder or a folder that holds some. Runs that differ in nothing but seed, length, checkpoints and times of
evaluation are one group; the groups are named by what they differ in.

  out=plot.png             .png, .svg or .pdf
  kind=curve               curve; profile: how many seeds end above each return; threshold: how many reached one, when
  threshold=VALUE          of kind=threshold
  statistic=median         median with quartiles; iqm: interquartile mean with 95 % stratified bootstrap intervals
  seeds=true               each seed thin behind the line of its group; of kind=curve
  y=eval/return            any column of metrics.csv
  x=agent_steps            agent_steps, wall_seconds or update
  log=                     logarithmic axes: x, y or xy
  smooth=N                 each evaluation averaged with the N-1 before it, seed by seed
  reference=FILE.csv,...   curves to compare with: columns series, agent_steps, median, q25, q75
  series=TEXT              only those series of the references whose names contain the text
  title=TEXT

examples
  jaxswarm-plot runs
  jaxswarm-plot runs/a runs/b out=figure.pdf statistic=iqm log=x
  jaxswarm-plot runs kind=threshold threshold=-30 x=wall_seconds
"""
NAMES = {"eval/return": "return of an episode"}
UNITS = {"agent_steps": "agent steps", "wall_seconds": "seconds", "update": "updates"}


@dataclasses.dataclass(frozen=True)
class Options:
    """What to draw, and where."""

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
            raise ConfigError(f"threshold: must be a number, like threshold=-30, got {self.threshold!r}")
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
    """Draws a picture of runs; returns the exit code."""
    if wants_help(arguments) or not arguments:
        print(HELP)
        return 0 if arguments else 2
    options, paths = _parse(arguments)
    out = _output(options.out)
    files = filter(None, options.reference.split(","))
    references = [series for file in files for series in _references(Path(file), options)]
    groups = _groups([runs.read(path) for path in runs.find(paths)], options)
    title = options.title or (_shared_name(groups) if len(groups) > 1 else "")
    picture = KINDS[options.kind](_seeds(groups, options), options)
    caption = picture.caption + ("; dashed: references, median and quartiles" if references else "")
    series = [*picture.series, *references]
    picture = dataclasses.replace(picture, series=series, title=title, caption=caption, log=options.log)
    _write(out, picture)
    for series in picture.series:
        if not series.is_reference:
            print(f"{series.label}: {series.note}")
    print(f"wrote {out}\nwrote {out.with_suffix('.csv')}")
    return 0


def _parse(arguments: Sequence[str]) -> tuple[Options, list[Path]]:
    """Options, and paths; what exists is a path, whatever is in its name."""
    names = [field.name for field in dataclasses.fields(Options)]
    options, overrides = split(arguments, names)
    for word in overrides:
        name, equals, _ = word.partition("=")
        if equals and not Path(word).exists():
            near = schema.nearest(name, names)
            raise ConfigError(f"unknown key {name!r}{near}; valid keys: {', '.join(names)}")
    if not overrides:
        raise ConfigError("give a run folder, or a folder that holds some: jaxswarm-plot PATH... [key=value ...]")
    return Options(**options), [Path(word) for word in overrides]


def _output(out: str) -> Path:
    """Where the picture goes; a `ConfigError` if that, or the table beside it, would replace something else."""
    path = Path(out or "plot.png")
    table = path.with_suffix(".csv")
    if path.suffix[1:].lower() not in plots.FORMATS:
        raise ConfigError(f"out: must be one of {', '.join(f'FILE.{x}' for x in plots.FORMATS)}, got {out!r}")
    if path.is_dir() or table.is_dir():
        raise ConfigError(f"out: must be a file, got the folder {out!r}")
    is_ours = table.exists() and table.read_bytes().startswith(",".join(plots.COLUMNS).encode())
    if table.exists() and not is_ours:
        raise ConfigError(f"out = {path} would replace {table}, which is no table of this program; choose another name")
    if not out and path.exists() and not is_ours:
        raise ConfigError(f"{path} exists and is no picture of this program; choose a name with out=FILE.png")
    return path


def _references(path: Path, options: Options) -> list[Series]:
    """The curves of a CSV file; the legend says which file they come from and of how many runs they are."""
    try:
        lines = curves.read_lines(path)
    except OSError as error:
        raise ConfigError(f"cannot read reference={path}: {error.strerror}") from error
    except ValueError as error:
        raise ConfigError(f"cannot read reference={path}: {error}") from error
    chosen = {name: line for name, line in lines.items() if options.series.lower() in name.lower()}
    if not chosen:
        raise ConfigError(
            f"series: must be part of one of the names in {path} ({', '.join(lines)}), got {options.series!r}"
        )
    sources = {name: f"{path.stem}, {line.num_seeds[0]} runs" for name, line in chosen.items() if line.num_seeds[0]}
    return [Series(name, line, sources.get(name, path.stem), is_reference=True) for name, line in chosen.items()]


def _groups(folders: Sequence[RunFolder], options: Options) -> dict[str, list[RunFolder]]:
    """The groups of runs, once it is known that there is something to draw of them."""
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
    """Each group's curves, smoothed if asked for; groups without any are left out."""
    found = {label: runs.seeds(members, options.x, options.y, _warn) for label, members in groups.items()}
    size = int(options.smooth)
    found = {label: [curves.trailing_mean(x, size) for x in seeds] for label, seeds in found.items() if seeds}
    if not found:
        raise ConfigError(f"nothing to draw: no run has a finite {options.y}")
    return found


def _curve(groups: Mapping[str, Sequence[Curve]], options: Options) -> Picture:
    statistic = STATISTICS[options.statistic]
    lines = {label: curves.summarize(seeds, options.statistic) for label, seeds in groups.items()}
    series = []
    for label, line in lines.items():
        shown = groups[label] if options.seeds == "true" else ()
        most, last = int(line.num_seeds.max()), int(line.num_seeds[-1])
        note = plots.seed_count(most) + (f", {last} at the end" if last < most else "")
        series.append(Series(label, line, note, seeds=shown))
    caption = f"{statistic.name} and {statistic.band} over seeds".capitalize()
    caption += ", and each seed" if options.seeds == "true" else ""
    if any(np.ptp(line.num_seeds) for line in lines.values()):
        caption += "; pale where not all seeds have values"
    height = f"{options.statistic} of {options.y}"
    return Picture("curve", series, options.x, height, _name(options), caption=_smoothed(caption, options))


def _profile(groups: Mapping[str, Sequence[Curve]], options: Options) -> Picture:
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
    return Picture("profile", series, _name(options), fraction, fraction, caption=caption, is_step=True)


def _threshold(groups: Mapping[str, Sequence[Curve]], options: Options) -> Picture:
    threshold, series = float(options.threshold), []
    for label, seeds in groups.items():
        times, is_reached = curves.times_to(seeds, threshold)
        line = curves.reaching(seeds, threshold)
        half = line.x[line.y >= 0.5]
        when = f"half by {_amount(half[0], options.x)}" if half.size else "fewer than half"
        note = f"{is_reached.sum()} of {plots.seed_count(len(seeds))}, {when}"
        series.append(Series(label, line, note, censored=np.sort(times[~is_reached])))
    fraction = f"fraction of seeds that reached {options.threshold}"
    caption = f"{_name(options)}, first evaluation at or above {options.threshold}".capitalize()
    caption += "; Kaplan-Meier estimate with 95 % intervals; ticks: seeds that ended before"
    caption = _smoothed(caption, options)
    return Picture("threshold", series, options.x, fraction, fraction, caption=caption, is_step=True)


KINDS: dict[str, Callable[[Mapping[str, Sequence[Curve]], Options], Picture]] = {
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


def _write(out: Path, picture: Picture) -> None:
    try:
        plots.check(picture)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    if "x" in picture.log:
        hidden = sum(int((series.line.x <= 0).sum()) for series in picture.series)
        if hidden:
            _warn(f"a logarithmic axis has no place for {picture.x_name} = 0; points left out: {hidden}")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        replace_text(out.with_suffix(".csv"), plots.table(picture))
        plots.draw(out, picture)
    except OSError as error:
        raise ConfigError(f"cannot write to {out.parent}: {error.strerror}") from error


def _warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr)


def _shared_name(groups: Mapping[str, Sequence[RunFolder]]) -> str:
    return runs.common_name([members[0].config for members in groups.values()])


def _name(options: Options) -> str:
    """What `y` is called in words."""
    return NAMES.get(options.y, options.y)


def _smoothed(caption: str, options: Options) -> str:
    return caption + (f"; means of {options.smooth} evaluations" if int(options.smooth) > 1 else "")


def _amount(value: float, name: str) -> str:
    """A number of the horizontal axis in words."""
    size, unit = (1e6, "million ") if value >= 1e6 else (1, "")
    return f"{value / size:,.4g} {unit}{UNITS[name]}"


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
