"""Plots of lines with bands in one or several panels, and CSV tables of the plotted points.

The colors are those of Okabe and Ito (2008) without yellow, which is hard to see on white paper. Markers distinguish
the lines without color. Series of the same label have the same color and marker in all panels.
"""

import csv
import dataclasses
import io
import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxswarm.analysis import legends
from jaxswarm.analysis.curves import Curve, Line, Points
from jaxswarm.plot_settings import plot_settings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#333333")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
DASHES = ((0, (5, 2)), (0, (2, 1.5)), (0, (6, 1.5, 1, 1.5)), (0, (9, 2)), (0, (1, 1.2)))  # line styles of references
FORMATS: dict[str, dict[str, Any]] = {"png": {}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}  # with metadata
COLUMNS = ("kind", "series", "num_seeds", "x_name", "x", "y_name", "y", "lower", "upper", "panel")
SETTINGS: Any = {  # equal plots give equal files; text is stored as text and is not parsed as math
    "svg.hashsalt": "jaxswarm",
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
    "text.parse_math": False,
}
LEGEND_INSIDE = 4  # series; longer legends are below the axes
LONGEST_INSIDE = 60  # characters of a label in a legend inside of the axes
MIN_PANEL = 3.2  # inches, width of a panel that is not too narrow beside others
SMALL_PANEL = 4.5  # inches, width of a panel below which text is smaller
UNITS = {  # of an axis: (least maximum of the axis for the unit, size of the unit, label)
    "agent_steps": ((1e6, 1e6, "million agent steps"), (1e3, 1e3, "thousand agent steps"), (0, 1, "agent steps")),
    "env_steps": (
        (1e6, 1e6, "million environment steps"),
        (1e3, 1e3, "thousand environment steps"),
        (0, 1, "environment steps"),
    ),
    "wall_seconds": ((7200, 3600, "hours"), (120, 60, "minutes"), (0, 1, "seconds")),
}


@dataclasses.dataclass(frozen=True)
class Series:
    """Line of a plot. The legend shows its name `label`, and its `note` in brackets.

    With `color_by`, series of the same text have the same color, and the legend shows these texts instead.
    """

    label: str
    line: Line
    note: str = ""
    is_reference: bool = False
    censored: Points = dataclasses.field(default_factory=lambda: np.empty(0))  # ends of seeds without the event
    seeds: Sequence[Curve] = ()  # plotted as thin lines
    color_by: str = ""


@dataclasses.dataclass(frozen=True)
class Plot:
    """Specification of a plot, or of one panel of several, in data units.

    `kind` is written into the table. `x_name` and `y_name` are the names of the columns, `y_label` is the label of the
    vertical axis. `log` names the logarithmic axes: `""`, `"x"`, `"y"` or `"xy"`. `is_step` plots lines as steps.
    """

    kind: str
    series: Sequence[Series]
    x_name: str
    y_name: str
    y_label: str
    title: str = ""
    caption: str = ""
    log: str = ""
    is_step: bool = False


@dataclasses.dataclass(frozen=True)
class Layout:
    """Sizes of a figure in inches, and the number of panels per row; `None` chooses them.

    The height is that of a row of panels. A legend below the panels is added to it.
    """

    width: float = 7.0
    height: float | None = None
    columns: int | None = None

    def grid(self, num_panels: int) -> tuple[int, int, float]:
        """Return the numbers of rows and columns, and the height of a row."""
        columns = min(num_panels, self.columns or max(1, int(self.width / MIN_PANEL)))
        height = self.height or max(2.6, 0.63 * self.width / columns)
        return math.ceil(num_panels / columns), columns, height


def draw(path: Path, plot: Plot) -> None:
    """Draw one plot into a file; see `draw_panels`."""
    draw_panels(path, [plot], plot.caption)


def draw_panels(
    path: Path, panels: Sequence[Plot], caption: str, title: str = "", layout: Layout | None = None
) -> None:
    """Draw plots with a shared legend into a file, whose suffix is one of `FORMATS`.

    The file is written completely or not at all.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415

    layout = layout or Layout()
    num_rows, num_columns, height = layout.grid(len(panels))
    is_small = layout.width / num_columns < SMALL_PANEL
    with plot_settings(SETTINGS | {"font.size": 8 if is_small else 10}):
        figure = Figure(figsize=(layout.width, num_rows * height), layout="constrained")
        all_axes = figure.subplots(num_rows, num_columns, squeeze=False).ravel().tolist()
        for axes in all_axes[len(panels) :]:
            axes.remove()
        styles = _styles(panels)
        for axes, plot in zip(all_axes, map(_in_units, panels), strict=False):
            _draw_lines(axes, plot, styles)
            _draw_frame(axes, plot, layout.width / num_columns, height)
        if title:
            figure.suptitle(legends.fit_text(title, layout.width, 12.0), x=0.01, ha="left", fontsize=12)
        _draw_legend(figure, all_axes[: len(panels)], panels, caption)
        temporary = path.with_name(f".{path.name}.tmp")
        try:
            suffix = path.suffix[1:].lower()
            figure.savefig(temporary, dpi=180, format=suffix, metadata=FORMATS[suffix])
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


def table(panels: Sequence[Plot]) -> str:
    """Return the points of plots as CSV, one row per point. The column `panel` has the title of the plot.

    Cells are empty where there is no band or where the number of seeds is unknown.
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(COLUMNS)
    for plot in panels:
        for series in plot.series:
            writer.writerows([*row, plot.title] for row in _rows(plot, series))
    return buffer.getvalue()


def seed_count(number: int) -> str:
    """Return the text "1 seed" or "N seeds"."""
    return "1 seed" if number == 1 else f"{number} seeds"


def check(plot: Plot) -> None:
    """Raise a `ValueError` if a logarithmic axis cannot show the values."""
    x, y = _x_values(plot), _y_values(plot)
    if "x" in plot.log and not (x > 0).any():
        raise ValueError(f"log: {plot.x_name} must have positive values, got none")
    if "y" in plot.log and y.min() <= 0 <= y.max():
        between = f"{y.min():g} to {y.max():g}"
        raise ValueError(f"log: values of {plot.y_name} must have one sign, got {between}")


def _rows(plot: Plot, series: Series) -> Iterator[list[Any]]:
    """Yield the cells of the points of a series, without the panel."""
    kind, line = ("reference" if series.is_reference else plot.kind), series.line
    for n, x, y, lower, upper in zip(line.num_seeds, line.x, line.y, line.lower, line.upper, strict=True):
        cells = map(_cell, (y, lower, upper))
        yield [kind, series.label, n or "", plot.x_name, _cell(x), plot.y_name, *cells]
    for x, y in zip(series.censored, _heights(line, series.censored), strict=True):
        yield ["censored", series.label, 1, plot.x_name, _cell(x), plot.y_name, _cell(y), "", ""]


def _in_units(plot: Plot) -> Plot:
    """Return the plot with its horizontal axis scaled to a readable unit, whose label becomes `x_name`."""
    most = _x_values(plot).max(initial=0)
    units = UNITS.get(plot.x_name, ((-math.inf, 1, plot.x_name),))
    size, label = next((size, label) for least, size, label in units if most >= least)
    scaled = [
        dataclasses.replace(
            series,
            line=dataclasses.replace(series.line, x=series.line.x / size),
            censored=series.censored / size,
            seeds=[dataclasses.replace(seed, x=seed.x / size) for seed in series.seeds],
        )
        for series in plot.series
    ]
    return dataclasses.replace(plot, series=scaled, x_name=label)


def _styles(panels: Sequence[Plot]) -> dict[str, dict[str, Any]]:
    """Return color, marker and legend entry of our series of all panels by label.

    Series with `color_by` have no marker.
    """
    ours = [series for plot in panels for series in plot.series if not series.is_reference]
    values = list(dict.fromkeys(series.color_by for series in ours if series.color_by))
    palette = dict(zip(values, _palette(len(values)), strict=True))
    styles, by_label = {}, {series.label: series for series in ours}
    linewidth, size = (1.8, 4) if len(by_label) <= len(COLORS) else (1.2, 3)
    for number, series in enumerate(by_label.values()):
        if series.color_by:
            styles[series.label] = {"color": palette[series.color_by], "linewidth": linewidth}
        else:
            marker = MARKERS[(number + number // len(COLORS)) % len(MARKERS)]  # differs when colors repeat
            style = {"color": COLORS[number % len(COLORS)], "marker": marker, "markersize": size}
            styles[series.label] = style | {"linewidth": linewidth}
        styles[series.label]["label"] = series.color_by or _entry(series, panels)
    return styles


def _palette(size: int) -> Sequence[str]:
    """Return this number of colors; many colors are a gradient from dark to light."""
    if size <= len(COLORS):
        return COLORS[:size]
    from matplotlib import colormaps  # noqa: PLC0415
    from matplotlib.colors import to_hex  # noqa: PLC0415

    return [to_hex(color) for color in colormaps["viridis"](np.linspace(0, 0.92, size))]


def _draw_lines(axes: "Axes", plot: Plot, styles: dict[str, dict[str, Any]]) -> None:
    """Draw our series in order, and the references below them.

    A reference has a tint of the color of our series with the same label. The other references have tints of the
    remaining colors. A single series of ours without references is annotated with its last value.
    """
    ours = [series for series in plot.series if not series.is_reference]
    references = [series for series in plot.series if series.is_reference]
    for number, series in enumerate(ours):
        every = max(1, len(series.line.x) // 12)
        style = styles[series.label] | {"zorder": 4, "markevery": (number % every, every)}
        style |= {"drawstyle": "steps-post"} if plot.is_step else {}
        _draw_line(axes, series, plot.is_step, 0.2 if len(ours) <= LEGEND_INSIDE else 0.1, style)
    labels = list(dict.fromkeys(series.label for series in [*ours, *references]))
    for number, series in enumerate(references):
        color = _tint(COLORS[labels.index(series.label) % len(COLORS)])
        style = {"color": color, "linewidth": 1.4, "linestyle": DASHES[number % len(DASHES)], "zorder": 2}
        _draw_line(axes, series, plot.is_step, 0.12, style | {"label": _entry(series, [plot])})
    if len(ours) == 1 and not references and len(ours[0].line.x) and not plot.is_step:
        end, text = (ours[0].line.x[-1], ours[0].line.y[-1]), _signed(ours[0].line.y[-1])
        box = {"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
        axes.annotate(text, end, (6, 0), textcoords="offset points", va="center", annotation_clip=False, bbox=box)


def _draw_line(axes: "Axes", series: Series, is_step: bool, band_alpha: float, style: dict[str, Any]) -> None:
    """Draw line, band, seeds and marks of censored seeds. The line is pale where some seeds have no value."""
    line = series.line
    for seed in series.seeds:
        axes.plot(seed.x, seed.y, color=style["color"], alpha=0.4, linewidth=0.6, zorder=3)
    band = {"color": style["color"], "alpha": band_alpha, "linewidth": 0, "zorder": 1}
    axes.fill_between(line.x, line.lower, line.upper, step="post" if is_step else None, **band)
    is_shared_by_all = (line.num_seeds == line.num_seeds.max(initial=0)) | is_step
    if not is_shared_by_all.all():
        axes.plot(line.x, line.y, **style | {"alpha": 0.45, "label": None})
    axes.plot(line.x, np.where(is_shared_by_all, line.y, math.nan), **style)
    ticks = {"color": style["color"], "markersize": 10, "markeredgewidth": 1.8, "zorder": 5}
    axes.plot(series.censored, _heights(line, series.censored), "|", **ticks)


def _draw_frame(axes: "Axes", plot: Plot, width: float, height: float) -> None:
    axes.set_title(legends.fit_text(plot.title, width, 11.0), loc="left", fontsize="large")
    axes.set_xlabel(plot.x_name)
    axes.set_ylabel(legends.fit_text(plot.y_label, height, 7.0))
    if "x" in plot.log:
        _set_logarithmic(axes, "x", _x_values(plot))
    if "y" in plot.log:
        _set_logarithmic(axes, "y", _y_values(plot))
    axes.grid(color="0.92", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _set_logarithmic(axes: "Axes", name: str, values: np.ndarray) -> None:
    """Make an axis logarithmic, with ticks at 1, 2, 5, 10, .... Negative values have a mirrored logarithmic axis."""
    from matplotlib import ticker  # noqa: PLC0415

    axis, subs = getattr(axes, f"{name}axis"), (1.0, 2.0, 5.0)
    if values.max() > 0:
        getattr(axes, f"set_{name}scale")("log", nonpositive="mask")
        axis.set_major_locator(ticker.LogLocator(subs=subs))
    else:
        nearest = -values.max() / 1.15
        axes.set_yscale("symlog", linthresh=nearest)
        axes.set_ylim(1.15 * values.min(), -nearest)
        axis.set_major_locator(ticker.SymmetricalLogLocator(base=10, linthresh=nearest, subs=subs))
    axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: _signed(value)))
    axis.set_minor_formatter(ticker.NullFormatter())


def _draw_legend(figure: "Figure", all_axes: Sequence["Axes"], panels: Sequence[Plot], caption: str) -> None:
    """Draw the entries of all panels, each once.

    A short legend of one wide panel is inside of the axes. Others are below them, and so are legends of step lines,
    which fill the axes.
    """
    handles: dict[str, Any] = {}
    for axes in all_axes:
        handles = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True)) | handles
    labels = list(handles)
    is_wide = figure.get_figwidth() >= SMALL_PANEL and all(len(label) <= LONGEST_INSIDE for label in labels)
    is_short = len(panels) == 1 and len(labels) <= LEGEND_INSIDE and is_wide and not panels[0].is_step
    if is_short or not labels:
        legends.draw_inside(figure, all_axes[0], list(handles.values()), labels, caption)
    else:
        legends.draw_below(figure, list(handles.values()), labels, caption)


def _entry(series: Series, panels: Sequence[Plot]) -> str:
    """Return the legend entry of a series: its label, with the notes of the series of this label in brackets."""
    others = [x for plot in panels for x in plot.series if x.is_reference == series.is_reference]
    notes = "; ".join(dict.fromkeys(x.note for x in others if x.note and x.label == series.label))
    return f"{series.label} ({notes})" if series.label and notes else series.label or notes


def _x_values(plot: Plot) -> np.ndarray:
    return np.concatenate([np.empty(0), *(series.line.x for series in plot.series)])


def _y_values(plot: Plot) -> np.ndarray:
    """Return all finite `y` values, including those of bands and seeds."""
    lines = [series.line for series in plot.series]
    seeds = [seed.y for series in plot.series for seed in series.seeds]
    values = np.concatenate([np.empty(0), *seeds, *(x for line in lines for x in (line.y, line.lower, line.upper))])
    return values[np.isfinite(values)]


def _heights(line: Line, at: Points) -> Points:
    """Return the values of a step line at these points."""
    return line.y[np.searchsorted(line.x, at, side="right") - 1]


def _tint(color: str) -> str:
    """Return the color mixed with two fifths of white."""
    channels = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return "#" + "".join(f"{(3 * channel + 2 * 255) // 5:02x}" for channel in channels)


def _signed(value: float) -> str:
    return f"{value:.4g}".replace("-", "\N{MINUS SIGN}")


def _cell(value: float) -> str:
    return "" if math.isnan(value) else repr(float(value))
