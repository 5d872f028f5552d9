"""Legends and captions that fit the width of a figure. A legend below the axes is never taller than the plot."""

import math
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIZES = (8.5, 7.0, 6.0)  # points of the text of legends, in order of preference
CAPTION_SIZE = 8.0  # points
SYMBOL = 10  # characters that the symbol of an entry and the space between columns take
MAX_COLUMNS = 4
MAX_SHARE = 0.8  # of the height of the plot, for the legend
REST = "... and {} more in the CSV file"  # last entry of a legend that does not fit
STYLE: dict[str, Any] = {"frameon": False, "labelspacing": 0.35}


def fit_text(text: str, inches: float, size: float) -> str:
    """Break text into lines of this width, for a size in points."""
    return textwrap.fill(text, num_characters(inches, size))


def num_characters(inches: float, size: float) -> int:
    """Return the number of characters of average text of this size in points that fit into a width."""
    return max(12, int(120 * inches / size))


def draw_inside(figure: "Figure", axes: "Axes", handles: Sequence, labels: Sequence[str], caption: str) -> None:
    """Draw the legend in the axes, and the caption below them."""
    if labels:
        axes.legend(handles, labels, fontsize=SIZES[0], **STYLE)
    if caption:
        text = fit_text(caption, figure.get_figwidth(), CAPTION_SIZE)
        figure.supxlabel(text, x=0.01, ha="left", fontsize=CAPTION_SIZE, color="0.35")


def draw_below(figure: "Figure", handles: Sequence, labels: Sequence[str], caption: str) -> None:
    """Enlarge the figure, and draw caption and legend below its axes, in as many columns as fit.

    If the entries do not fit even in small text, they are cut to one line each, and a last entry counts the others.
    """
    from matplotlib.lines import Line2D  # noqa: PLC0415

    width, height = figure.get_size_inches()
    size = next((size for size in SIZES if _height(labels, width, size) <= MAX_SHARE * height), 0.0)
    if not size:
        size, labels = SIZES[-1], _cut(labels, width, MAX_SHARE * height)
        handles = [*handles[: len(labels) - 1], Line2D([], [], linestyle="none")]
    texts, columns = _arrange(labels, width, size)
    caption = fit_text(caption, width, CAPTION_SIZE)
    title_height = _line_height(CAPTION_SIZE) * (2 + caption.count("\n"))
    figure.set_figheight(height + title_height + _height(labels, width, size))
    style = STYLE | {"fontsize": size, "title": caption, "title_fontsize": CAPTION_SIZE, "alignment": "left"}
    legend = figure.legend(handles, texts, loc="outside lower left", ncols=columns, **style)
    legend.get_title().set_color("0.35")


def _arrange(labels: Sequence[str], width: float, size: float) -> tuple[list[str], int]:
    """Return the labels, broken into lines if they do not fit into one column, and the number of columns."""
    room, longest = num_characters(width, size), max(map(len, labels))
    columns = min(MAX_COLUMNS, len(labels), room // (longest + SYMBOL))
    return [textwrap.fill(label, room - SYMBOL) for label in labels], max(1, columns)


def _height(labels: Sequence[str], width: float, size: float) -> float:
    texts, columns = _arrange(labels, width, size)
    return _line_height(size) * math.ceil(sum(1 + text.count("\n") for text in texts) / columns)


def _cut(labels: Sequence[str], width: float, height: float) -> list[str]:
    """Return labels of one line each that fit into the height, and a last one that counts the others."""
    size = SIZES[-1]
    room = num_characters(width, size) - SYMBOL
    short = [label if len(label) <= room else f"{label[: room - 3]}..." for label in labels]
    _, columns = _arrange([*short, REST.format(len(short))], width, size)
    kept = max(1, int(height / _line_height(size)) * columns - 1)
    return [*short[:kept], REST.format(len(short) - kept)]


def _line_height(size: float) -> float:
    return 1.52 * size / 72  # inches
