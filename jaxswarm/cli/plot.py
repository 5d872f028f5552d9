"""The program `jaxswarm-plot`."""

import dataclasses
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxswarm.analysis import curves, plots
from jaxswarm.analysis import run_folders as runs
from jaxswarm.analysis.comparability import compare
from jaxswarm.analysis.curves import STATISTICS, Curve
from jaxswarm.analysis.plots import Plot, Series
from jaxswarm.analysis.run_folders import RunFolder
from jaxswarm.cli.plot_options import HELP, UNITS, Options, output_path, parse
from jaxswarm.cli.program import program, wants_help
from jaxswarm.config import ConfigError, schema
from jaxswarm.files import RETURN, replace_text

NAMES = {RETURN: "return of an episode"}


@dataclasses.dataclass(frozen=True)
class Panel:
    """Runs of one task: the curves of each group by label, and the column that the panel shows."""

    title: str
    column: str
    y_label: str
    curves: dict[str, list[Curve]]
    colors: dict[str, str]  # the setting that colors the group, by label; empty without the option `color`


@program
def main(arguments: Sequence[str]) -> int:
    """Plot runs; return the exit code."""
    if wants_help(arguments) or not arguments:
        print(HELP)
        return 0 if arguments else 2
    options, paths = parse(arguments)
    out = output_path(options.out)
    files = filter(None, options.reference.split(","))
    references = [series for file in files for series in _references(Path(file), options)]
    folders = [runs.read(path) for path in runs.find(paths)]
    panels = _panels(folders, _with_full_keys(options, folders))
    if references and len(panels) > 1:
        raise ConfigError(f"reference: must be used with runs of one task, got {len(panels)} panels")
    kind = KINDS[options.kind]
    drawn = [kind.plot(panel, options) for panel in panels]
    notes = [(plot.title, series.label, series.note) for plot in drawn for series in plot.series]
    if len({note for *_, note in notes}) == 1:  # the caption has the number of seeds
        drawn = [dataclasses.replace(plot, series=_without_notes(plot.series)) for plot in drawn]
    drawn = [dataclasses.replace(plot, series=[*plot.series, *references], log=options.log) for plot in drawn]
    caption = _smoothed(kind.caption(panels, options), options)
    caption += "; dashed: references, median and quartiles" if references else ""
    _write(out, drawn, caption, options)
    for title, label, note in notes:
        print(f"{title}; {label}: {note}" if len(panels) > 1 else f"{label}: {note}")
    print(f"wrote {out}\nwrote {out.with_suffix('.csv')}")
    return 0


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


def _panels(folders: Sequence[RunFolder], options: Options) -> list[Panel]:
    """Return a panel for each task and reward. Raise a `ConfigError` if there is nothing to plot."""
    columns = sorted({name for folder in folders for row in folder.rows[:1] for name in row} - {"seed"})
    if not columns:
        raise ConfigError("the runs have no evaluation yet")
    for key in filter(lambda key: getattr(options, key), ("x", "y")):
        name = getattr(options, key)
        if name not in columns:
            near = schema.nearest(name, columns)
            raise ConfigError(f"{key}: must be one of {', '.join(columns)}, got {name!r}{near}")
    by_task: dict[tuple, list[RunFolder]] = {}
    for folder in folders:
        by_task.setdefault(tuple(folder.config.get(f"task.{name}") for name in ("name", "reward")), []).append(folder)
    names = [name for name, _ in by_task]
    panels = []
    for (name, reward), members in by_task.items():
        subtitle = f"reward={reward}" if names.count(name) > 1 else ""
        panels.append(_panel(members, subtitle, options, is_alone=len(by_task) == 1))
    panels = [panel for panel in panels if panel.curves]
    if not panels:
        raise ConfigError(f"y: must be finite in at least one run, got no finite {options.y or RETURN}")
    return panels


def _panel(folders: Sequence[RunFolder], subtitle: str, options: Options, is_alone: bool) -> Panel:
    if options.labels == "run":
        groups = runs.each_run(folders)
    else:
        groups = runs.group(folders, list(filter(None, options.labels.split(","))))
    column, y_label = _column(folders, options)
    found = {label: runs.seeds(members, options.x, column, _warn) for label, members in groups.items()}
    size = int(options.smooth)
    smooth = {label: [curves.trailing_mean(x, size) for x in seeds] for label, seeds in found.items() if seeds}
    colors = _colors(groups, options)
    smooth = {label: smooth[label] for label in colors or groups if label in smooth}
    title = ", ".join(filter(None, [runs.common_name([folder.config for folder in folders]), subtitle]))
    if is_alone:
        title = options.title or (title if len(groups) > 1 else "")
    return Panel(title, column, y_label, smooth, colors)


def _with_full_keys(options: Options, folders: Sequence[RunFolder]) -> Options:
    """Return the options with the full keys of settings; raise a `ConfigError` for a key that no run has."""
    all_fields = [folder.config for folder in folders]
    keys = [] if options.labels == "run" else list(filter(None, options.labels.split(",")))
    labels = ",".join(runs.resolve("labels", key, all_fields) for key in keys) or options.labels
    color = runs.resolve("color", options.color, all_fields) if options.color else ""
    return dataclasses.replace(options, labels=labels, color=color)


def _column(folders: Sequence[RunFolder], options: Options) -> tuple[str, str]:
    """Return the column that the panel shows, and its label."""
    if options.y:
        return options.y, NAMES.get(options.y, options.y)
    tasks = [
        {key.removeprefix("task."): x for key, x in folder.config.items() if key.startswith("task.")}
        for folder in folders
    ]
    comparison = compare(tasks)
    column = f"eval/{comparison.metric}"
    if comparison.settings and not any(column in row for folder in folders for row in folder.rows[:1]):
        settings = ", ".join(comparison.settings)
        _warn(f"returns with different values of {settings} are not comparable, but the runs have no column {column}")
        return RETURN, NAMES[RETURN]
    if comparison.settings:
        print(comparison.explain())
    return column, NAMES.get(column, f"{column} ({'higher' if comparison.is_higher_better else 'lower'} is better)")


def _colors(groups: Mapping[str, Sequence[RunFolder]], options: Options) -> dict[str, str]:
    if not options.color:
        return {}
    texts = runs.settings(options.color, [members[0].config for members in groups.values()])
    return dict(sorted(zip(groups, texts, strict=True), key=lambda pair: runs.by_number(pair[1])))


def _curve(panel: Panel, options: Options) -> Plot:
    series = []
    for label, seeds in panel.curves.items():
        line = curves.summarize(seeds, options.statistic)
        most, last = int(line.num_seeds.max()), int(line.num_seeds[-1])
        note = plots.seed_count(most) + (f", {last} at the end" if last < most else "")
        thin_lines = seeds if options.seeds == "true" else ()
        series.append(Series(label, line, note, seeds=thin_lines, color_by=panel.colors.get(label, "")))
    y_name = f"{options.statistic} of {panel.column}"
    return Plot("curve", series, options.x, y_name, panel.y_label, panel.title)


def _curve_caption(panels: Sequence[Panel], options: Options) -> str:
    statistic = STATISTICS[options.statistic]
    groups = [seeds for panel in panels for seeds in panel.curves.values()]
    counts = {len(seeds) for seeds in groups}
    if counts == {1}:
        return "One seed per line" if len(groups) > 1 else "One seed"
    over = f"{counts.pop()} seeds" if len(counts) == 1 else "seeds"
    caption = f"{statistic.name} and {statistic.band} over {over}".capitalize()
    caption += "; lines of one seed have no band" if 1 in counts else ""
    caption += "; thin: each seed" if options.seeds == "true" else ""
    if any(_has_gaps(seeds) for seeds in groups):
        caption += "; pale where not all seeds have values"
    return caption


def _has_gaps(seeds: Sequence[Curve]) -> bool:
    """Return whether some seeds begin later or end earlier than others."""
    return len({(curve.x[0], curve.x[-1]) for curve in seeds}) > 1


def _profile(panel: Panel, options: Options) -> Plot:
    finals = {label: np.array([curve.y[-1] for curve in seeds]) for label, seeds in panel.curves.items()}
    at = np.unique(np.concatenate(list(finals.values())))
    margin = 0.05 * (np.ptp(at) or abs(at[0]) or 1.0)
    at = np.concatenate([[at[0] - margin], at, [at[-1] + margin]])
    series = [
        Series(label, curves.profile(x, at), plots.seed_count(len(x)), color_by=panel.colors.get(label, ""))
        for label, x in finals.items()
    ]
    fraction = "fraction of seeds that end above"
    return Plot("profile", series, panel.y_label, fraction, fraction, panel.title, is_step=True)


def _profile_caption(panels: Sequence[Panel], options: Options) -> str:
    groups = [seeds for panel in panels for seeds in panel.curves.values()]
    ends, counts = [curve.x[-1] for seeds in groups for curve in seeds], {len(seeds) for seeds in groups}
    each = "the one seed of each line" if counts == {1} else "each seed"
    each = f"each of {counts.pop()} seeds" if len(counts) == 1 and counts != {1} else each
    caption = f"Last evaluation of {each}, at {_amount(max(ends), options.x)}"
    caption += f" (the first to end: {_amount(min(ends), options.x)})" if min(ends) < max(ends) else ""
    return caption + ("; 95 % stratified bootstrap intervals" if max(map(len, groups)) > 1 else "")


def _threshold(panel: Panel, options: Options) -> Plot:
    threshold, series = float(options.threshold), []
    for label, seeds in panel.curves.items():
        times, is_reached = curves.times_to(seeds, threshold)
        line = curves.reaching(seeds, threshold)
        half = line.x[line.y >= 0.5]
        half_text = f"half by {_amount(half[0], options.x)}" if half.size else "fewer than half"
        note = f"{is_reached.sum()} of {plots.seed_count(len(seeds))}, {half_text}"
        ends, color = np.sort(times[~is_reached]), panel.colors.get(label, "")
        series.append(Series(label, line, note, censored=ends, color_by=color))
    fraction = f"fraction of seeds that reached {options.threshold}"
    return Plot("threshold", series, options.x, fraction, fraction, panel.title, is_step=True)


def _threshold_caption(panels: Sequence[Panel], options: Options) -> str:
    names = " or ".join(dict.fromkeys(panel.y_label for panel in panels))
    caption = f"{names}, first evaluation at or above {options.threshold}".capitalize()
    return caption + "; Kaplan-Meier estimate with 95 % intervals; ticks: seeds that ended before"


class Kind(NamedTuple):
    """Kind of plot: the plot of a panel, and the caption of all panels."""

    plot: Callable[[Panel, Options], Plot]
    caption: Callable[[Sequence[Panel], Options], str]


KINDS = {
    "curve": Kind(_curve, _curve_caption),
    "profile": Kind(_profile, _profile_caption),
    "threshold": Kind(_threshold, _threshold_caption),
}


def _write(out: Path, panels: Sequence[Plot], caption: str, options: Options) -> None:
    try:
        for plot in panels:
            plots.check(plot)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    if "x" in options.log:
        hidden = sum(int((series.line.x <= 0).sum()) for plot in panels for series in plot.series)
        if hidden:
            _warn(f"a logarithmic axis cannot show {options.x} = 0; number of points left out: {hidden}")
    title = options.title if len(panels) > 1 else ""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        replace_text(out.with_suffix(".csv"), plots.table(panels))
        plots.draw_panels(out, panels, caption, title, options.layout)
    except OSError as error:
        raise ConfigError(f"out: cannot write to {out.parent}: {error.strerror}") from error


def _without_notes(series: Sequence[Series]) -> list[Series]:
    return [dataclasses.replace(one, note="") for one in series]


def _warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr)


def _smoothed(caption: str, options: Options) -> str:
    return caption + (f"; means of {options.smooth} evaluations" if int(options.smooth) > 1 else "")


def _amount(value: float, name: str) -> str:
    """Format a value of the horizontal axis with its unit, such as "2.5 million agent steps"."""
    size, unit = (1e6, "million ") if value >= 1e6 else (1, "")
    return f"{value / size:,.4g} {unit}{UNITS[name]}"
