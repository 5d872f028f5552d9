"""Summaries of final values over seeds, as text, CSV and LaTeX.

A summary has the median with quartiles, the interquartile mean with its bootstrap interval, and the probability of
improvement (Agarwal et al., 2021).
"""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxswarm.analysis import curves
from jaxswarm.files import replace_text

Seeds = Float[np.ndarray, " seeds"]
Line = dict[str, Any]  # of a summary, by column

PERCENTILES = (50 - 50 * curves.CONFIDENCE, 50 + 50 * curves.CONFIDENCE)
HEADS = {  # of text and LaTeX tables: the columns with the value and its interval
    "median [quartiles]": ("median", "q25", "q75"),
    "IQM [95 % interval]": ("iqm", "iqm_low", "iqm_high"),
    "P(first is better) [95 % interval]": ("p_first", "p_first_low", "p_first_high"),
}
LATEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
LATEX |= {character: f"\\{character}" for character in "&%$#_{}"}
COMMENT = """\
% Requires \\usepackage{booktabs}. Brackets contain quartiles for medians, and 95 % bootstrap intervals otherwise.
% P is the probability that a seed of the first line is better than a seed of this line; ties count half.
"""


class Improvement(NamedTuple):
    """Probability that one seed has a higher value than another, with its 95 % bootstrap interval."""

    probability: float
    low: float
    high: float


def summarize(values: Seeds) -> Line:
    """Return the statistics of the final values of seeds by column; NaN if they are undefined."""
    if not len(values):
        return dict.fromkeys(("median", "q25", "q75", "iqm", "iqm_low", "iqm_high"), math.nan)
    medians, means = curves.median(values[:, None]), curves.interquartile_mean(values[:, None])
    statistics = zip(("median", "q25", "q75", "iqm", "iqm_low", "iqm_high"), [*medians, *means], strict=True)
    return {name: float(x[0]) for name, x in statistics}


def improvement(ours: Seeds, others: Float[np.ndarray, " others"]) -> Improvement:
    """Return the probability that a seed of `ours` has a higher value than a seed of `others`; ties count half.

    It is the statistic U of Mann and Whitney divided by the number of pairs. The seeds of both are resampled for the
    interval, which is undefined if either has fewer than two.
    """
    if not (len(ours) and len(others)):
        return Improvement(math.nan, math.nan, math.nan)
    wins = (ours[:, None] > others) + 0.5 * (ours[:, None] == others)
    low = high = math.nan
    if min(wins.shape) > 1:
        generator = np.random.default_rng(0)
        first, second = (
            generator.multinomial(size, np.full(size, 1 / size), curves.NUM_RESAMPLES) / size for size in wins.shape
        )
        low, high = np.percentile(np.einsum("rm,mn,rn->r", first, wins, second), PERCENTILES)
    return Improvement(float(wins.mean()), float(low), float(high))


def versus_first(finals: Mapping[str, Seeds], label: str, is_higher_better: bool = True) -> Line:
    """Return the probability that a seed of the first label is better than a seed of this label, by column.

    It is NaN for the first label itself.
    """
    sign, first = 1 if is_higher_better else -1, next(iter(finals))
    undefined = Improvement(math.nan, math.nan, math.nan)
    found = undefined if label == first else improvement(sign * finals[first], sign * finals[label])
    return dict(zip(("p_first", "p_first_low", "p_first_high"), found, strict=True))


def pairs(finals: Mapping[str, Seeds], is_higher_better: bool = True) -> list[Line]:
    """Return the probability of improvement for each pair of labels: that a seed of the former is better."""
    sign, labels = 1 if is_higher_better else -1, list(finals)
    return [
        {"better": label, "than": other} | improvement(sign * finals[label], sign * finals[other])._asdict()
        for number, label in enumerate(labels)
        for other in labels[number + 1 :]
    ]


def write(path: Path, lines: Sequence[Line], improvements: Sequence[Line]) -> list[Path]:
    """Write lines as CSV and LaTeX, and the pairs as CSV; return the files.

    `path` is the name without its suffix; the pairs are in a file with `_improvement` appended to it.
    """
    contents = {".csv": _csv(lines), ".tex": latex(lines)}
    contents |= {"_improvement.csv": _csv(improvements)} if improvements else {}
    written = []
    for suffix, content in contents.items():
        written.append(path.with_name(path.name + suffix))
        replace_text(written[-1], content)
    return written


def text(lines: Sequence[Line]) -> str:
    """Return lines as a table with a header, in columns of equal width."""
    return aligned(_cells(lines))


def latex(lines: Sequence[Line]) -> str:
    """Return lines as a LaTeX table."""
    heads, *rows = _cells(lines)
    begin, end = rf"\begin{{tabular}}{{l{'r' * (len(heads) - 1)}}}", r"\end{tabular}"
    rows = [[_escaped(label), *map(_latex_number, cells)] for label, *cells in rows]
    head, *body = (" & ".join(row) + r" \\" for row in [[_escaped(cell) for cell in heads], *rows])
    return COMMENT + "\n".join([begin, r"\toprule", head, r"\midrule", *body, r"\bottomrule", end]) + "\n"


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Return rows of cells as text, with the first column aligned to the left and the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join([row[0].ljust(widths[0]), *[x.rjust(width) for x, width in zip(row[1:], widths[1:], strict=True)]])
        for row in rows
    )


def _cells(lines: Sequence[Line]) -> list[list[str]]:
    """Return the header and a row of cells per line: label, values with intervals, then the counts of seeds."""
    label, *others = lines[0]
    counts = [name for name in others if name in ("seeds", "diverged")]
    rows = [[label, *HEADS, *counts]]
    for line in lines:
        cells = [_interval([line[name] for name in names], "p_" in names[0]) for names in HEADS.values()]
        rows.append([str(line[label]), *cells, *[str(line[name]) for name in counts]])
    return rows


def _interval(numbers: Sequence[float], is_probability: bool) -> str:
    """Format a value with its interval: a probability with two decimals, other values with at least three digits."""
    value, low, high = numbers
    if math.isnan(value):
        return "-"
    decimals = 2 if is_probability else _decimals(value)
    bounds = "" if math.isnan(low) else f" [{low:.{decimals}f}, {high:.{decimals}f}]"
    return f"{value:.{decimals}f}{bounds}"


def _decimals(value: float) -> int:
    is_small = 0 < abs(value) < 1
    return 2 - math.floor(math.log10(abs(value))) if is_small else 2


def _csv(lines: Sequence[Line]) -> str:
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, list(lines[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows([{name: "" if x != x else x for name, x in line.items()} for line in lines])  # noqa: PLR0124
    return buffer.getvalue()


def _latex_number(cell: str) -> str:
    return "--" if cell == "-" else cell.replace("-", "$-$")


def _escaped(label: str) -> str:
    return "".join(LATEX.get(character, character) for character in label)
