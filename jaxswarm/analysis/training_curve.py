"""Learning curve of a run, `curve.png`: evaluation return against agent steps."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxswarm.analysis import curves, plots
from jaxswarm.files import RETURN, Row


def draw_curve(path: Path, rows: Sequence[Row], title: str) -> None:
    """Draw the evaluation return against agent steps. The suffix of `path` determines the format: png, svg or pdf.

    Several seeds are shown as median with quartiles, and each seed as a thin line. One seed is shown as mean with the
    standard deviation over episodes.
    """
    seeds, _ = curves.from_rows(rows, "agent_steps", RETURN)
    if len(seeds) > 1:
        line = curves.summarize(list(seeds.values()), "median")
        statistic = f"median and quartiles of {len(seeds)} seeds"
        series = plots.Series("", line, seeds=list(seeds.values()))
    else:
        line, statistic = _mean_over_episodes(rows), "mean ± std"
        series = plots.Series("", line)
    label = f"return of an episode ({statistic})"
    caption = "pale where some seeds have no evaluation" if np.unique(line.num_seeds).size > 1 else ""
    plots.draw(path, plots.Plot("curve", [series], "agent_steps", RETURN, label, title=title, caption=caption))


def _mean_over_episodes(rows: Sequence[Row]) -> curves.Line:
    points = [row for row in rows if math.isfinite(row[RETURN])]
    x = np.array([row["agent_steps"] for row in points], float)
    y, spread = (np.array([row.get(name, math.nan) for row in points], float) for name in (RETURN, f"{RETURN}_std"))
    return curves.Line(x, y, y - spread, y + spread, np.ones(len(x), int))
