"""Statistics of learning curves over seeds: common grids, medians, interquartile means, profiles, times to a threshold.

Seeds are evaluated at points of their own, and some end before others. Between its evaluations a seed is interpolated
linearly, outside of them it is not counted, so that the number of seeds behind a point may differ along a line.
"""

import csv
import dataclasses
import math
import warnings
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

MAX_POINTS = 1000  # of a line; more are thinned out evenly
NUM_RESAMPLES = 2000
CONFIDENCE = 0.95
COLUMNS = ("series", "agent_steps", "median", "q25", "q75")  # of files with lines to compare with

Values = Float[np.ndarray, "seeds points"]
Points = Float[np.ndarray, " points"]


@dataclasses.dataclass(frozen=True)
class Curve:
    """Evaluations of one seed, finite and in ascending order of `x`."""

    x: Float[np.ndarray, " evaluations"]
    y: Float[np.ndarray, " evaluations"]


@dataclasses.dataclass(frozen=True)
class Line:
    """A statistic over seeds with its band; the band is NaN where there is none, as for a single seed."""

    x: Points
    y: Points
    lower: Points
    upper: Points
    num_seeds: Int[np.ndarray, " points"]  # behind each point


@dataclasses.dataclass(frozen=True)
class Statistic:
    """A way to make a line and its band of seeds' values, which are NaN where a seed has none."""

    name: str
    band: str
    compute: Callable[[Values], tuple[Points, Points, Points]]


def from_rows(rows: Sequence[Mapping[str, Any]], x: str, y: str) -> tuple[dict[int, Curve], int]:
    """Each seed's curve through two columns, and how many evaluations were left out because they are not finite.

    A seed without a finite evaluation has no curve. What is measured in training has no value in a seed's first row,
    before the first update: that is not counted.
    """
    points = defaultdict(list)
    for row in rows:
        points[row["seed"]].append((row.get(x, math.nan), row.get(y, math.nan)))
    curves, num_left_out = {}, 0
    for seed in sorted(points):
        mine = np.array(points[seed], float)
        is_finite = np.all(np.isfinite(mine), axis=1)
        num_left_out += np.count_nonzero(~is_finite[0 if y.startswith("eval/") else 1 :])
        if is_finite.any():
            at, last = np.unique(mine[is_finite, 0][::-1], return_index=True)
            curves[seed] = Curve(at, mine[is_finite, 1][::-1][last])
    return curves, int(num_left_out)


def read_lines(path: Path) -> dict[str, Line]:
    """The lines of a CSV file by their names; numbers of runs are in a column `n_runs`, or not known: 0.

    A `ValueError` says what is wrong in the file.
    """
    try:
        with open(path, encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
    except csv.Error as error:
        raise ValueError(str(error)) from error
    missing = [name for name in COLUMNS if not rows or name not in rows[0]]
    if missing:
        raise ValueError(f"it has no column {missing[0]}; it needs {', '.join(COLUMNS)}")
    lines = {}
    for name in dict.fromkeys(row["series"] for row in rows):
        mine = [row for row in rows if row["series"] == name]
        x, middle, lower, upper = np.array([[float(row[column] or "nan") for column in COLUMNS[1:]] for row in mine]).T
        if not np.isfinite(x).all():
            raise ValueError(f"agent_steps of {name!r} are not all numbers")
        lines[name] = Line(x, middle, lower, upper, np.array([int(row.get("n_runs") or 0) for row in mine]))
    return lines


def trailing_mean(curve: Curve, size: int) -> Curve:
    """Each evaluation averaged with up to `size - 1` before it, never with later ones."""
    sums = np.concatenate([[0.0], np.cumsum(curve.y)])
    end = np.arange(1, len(curve.y) + 1)
    start = np.maximum(end - size, 0)
    return Curve(curve.x, (sums[end] - sums[start]) / (end - start))


def on_common_grid(curves: Sequence[Curve]) -> tuple[Points, Values]:
    """All points at which any seed was evaluated, and the seeds' values there; NaN outside of a seed's own range."""
    grid = np.unique(np.concatenate([curve.x for curve in curves]))
    if len(grid) > MAX_POINTS:
        grid = grid[np.linspace(0, len(grid) - 1, MAX_POINTS).round().astype(int)]
    values = [np.interp(grid, curve.x, curve.y, left=math.nan, right=math.nan) for curve in curves]
    return grid, np.array(values)


def summarize(curves: Sequence[Curve], statistic: str, best_share: float = 1.0) -> Line:
    """One of `STATISTICS` along the common grid of at least one seed; of the best `best_share` of the seeds."""
    grid, values = on_common_grid(curves)
    values = _best(values, best_share)
    y, lower, upper = STATISTICS[statistic].compute(values)
    return Line(grid, y, lower, upper, np.count_nonzero(~np.isnan(values), axis=0))


def bootstrapped(
    curves: Sequence[Curve], statistic: str, count: int, generator: np.random.Generator, best_share: float = 1.0
) -> list[Line]:
    """`summarize` of as many seeds drawn with replacement, `count` times; where none of them is, of all seeds."""
    grid, values = on_common_grid(curves)
    of_all = STATISTICS[statistic].compute(_best(values, best_share))
    lines = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of points without any seed
        for _ in range(count):
            drawn = _best(values[generator.integers(len(values), size=len(values))], best_share)
            points = STATISTICS[statistic].compute(drawn)
            is_there = ~np.isnan(drawn).all(axis=0)
            y, lower, upper = (np.where(is_there, x, other) for x, other in zip(points, of_all, strict=True))
            lines.append(Line(grid, y, lower, upper, np.count_nonzero(~np.isnan(drawn), axis=0)))
    return lines


def num_best(num_seeds: int, share: float) -> int:
    """How many seeds are the best `share` of so many."""
    return max(1, round(share * num_seeds))


def _best(values: Values, share: float) -> Float[np.ndarray, "best points"]:
    """The seeds with the highest means over the points that all have."""
    if share == 1.0:
        return values
    means = values[:, ~np.isnan(values).any(axis=0)].mean(axis=1)
    return values[np.argsort(-means, kind="stable")[: num_best(len(values), share)]]


def profile(finals: Float[np.ndarray, " seeds"], at: Points) -> Line:
    """Performance profile: the fraction of seeds that end above each value (Agarwal et al., 2021, eq. 1).

    The band is that of `interquartile_mean`, for the fraction.
    """
    is_above = (finals[:, None] > at).astype(float)
    lower, upper = _bootstrap(is_above, np.mean)
    return Line(at, is_above.mean(axis=0), lower, upper, np.full(len(at), len(finals)))


def times_to(
    curves: Sequence[Curve], threshold: float
) -> tuple[Float[np.ndarray, " seeds"], Bool[np.ndarray, " seeds"]]:
    """Where each seed's evaluation is first at or above the threshold, and whether it ever is; else where it ends."""
    first = [np.flatnonzero(curve.y >= threshold) for curve in curves]
    times = [curve.x[found[0] if found.size else -1] for curve, found in zip(curves, first, strict=True)]
    return np.array(times), np.array([found.size > 0 for found in first])


def reaching(curves: Sequence[Curve], threshold: float) -> Line:
    """Fraction of seeds that have reached a threshold, as estimated by Kaplan and Meier (1958).

    A seed that ended below the threshold is one of those that may reach it until its end, and says nothing of what is
    later. The band is the 95 % interval by the exponential Greenwood formula, NaN where no seed or every seed is
    there. `num_seeds` are the seeds that have neither reached the threshold nor ended before a point.
    """
    from scipy import stats  # noqa: PLC0415

    times, is_reached = times_to(curves, threshold)
    estimate = stats.ecdf(stats.CensoredData(uncensored=times[is_reached], right=times[~is_reached])).cdf
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of the points without an interval
        interval = estimate.confidence_interval(CONFIDENCE, method="log-log")
    start = min(curve.x[0] for curve in curves)
    x = np.concatenate([[start], estimate.quantiles])
    y = np.concatenate([[0.0], estimate.probabilities])
    lower, upper = (np.concatenate([[math.nan], bound.probabilities]) for bound in (interval.low, interval.high))
    return Line(x, y, lower, upper, np.count_nonzero(times[:, None] >= x, axis=0))


def median(values: Values) -> tuple[Points, Points, Points]:
    """Median with the quartiles, interpolated linearly between seeds."""
    lower, middle, upper = np.nanpercentile(values, (25, 50, 75), axis=0)
    is_single = np.count_nonzero(~np.isnan(values), axis=0) < 2
    return middle, np.where(is_single, math.nan, lower), np.where(is_single, math.nan, upper)


def interquartile_mean(values: Values) -> tuple[Points, Points, Points]:
    """Mean without the lowest and the highest quarter of seeds, with a 95 % bootstrap interval (Agarwal et al., 2021).

    A quarter is rounded down, so nothing is cut from fewer than four seeds. Their bootstrap is stratified by task; all
    seeds here have one task, so they are the only stratum, of which as many are redrawn as there are. The interval is
    made of percentiles of the redrawn means; it is NaN for a single seed.
    """
    is_there = ~np.isnan(values)
    patterns, which = np.unique(is_there, axis=1, return_inverse=True)
    result = np.empty((3, values.shape[1]))
    for number, seeds in enumerate(patterns.T):
        points = which.ravel() == number
        there = values[np.ix_(seeds, points)]
        result[:, points] = _trimmed_mean(there, axis=0), *_bootstrap(there, _trimmed_mean)
    return result[0], result[1], result[2]


STATISTICS = {
    "median": Statistic("median", "quartiles", median),
    "iqm": Statistic("interquartile mean", "95 % stratified bootstrap interval", interquartile_mean),
}


def _trimmed_mean(values: np.ndarray, axis: int) -> np.ndarray:
    from scipy import stats  # noqa: PLC0415

    return stats.trim_mean(values, 0.25, axis=axis)


def _bootstrap(values: Values, statistic: Callable[..., np.ndarray]) -> tuple[Points, Points]:
    """Percentile interval of a statistic over seeds; the same seeds are redrawn at all points."""
    if len(values) < 2:
        nothing = np.full(values.shape[1], math.nan)
        return nothing, nothing
    from scipy import stats  # noqa: PLC0415

    interval = stats.bootstrap(
        (values,),
        statistic,
        axis=0,
        n_resamples=NUM_RESAMPLES,
        batch=max(1, 1_000_000 // values.size),
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return interval.low, interval.high
