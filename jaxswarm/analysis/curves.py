"""Statistics of learning curves over seeds: common grids, medians, interquartile means, profiles, times to a threshold.

Seeds may be evaluated at different points, and some may end before others. A seed is interpolated linearly between its
evaluations and not counted outside of them. The number of seeds may therefore differ between the points of a line.
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

MAX_POINTS = 1000  # per line; longer grids are thinned out evenly
NUM_RESAMPLES = 2000  # bootstrap resamples per interval
CONFIDENCE = 0.95
MAX_VALUE = float(np.finfo(np.float32).max)  # metrics are in single precision, so larger cells count as infinite
COLUMNS = ("series", "agent_steps", "median", "q25", "q75")  # of CSV files with reference lines

Values = Float[np.ndarray, "seeds points"]
Points = Float[np.ndarray, " points"]


@dataclasses.dataclass(frozen=True)
class Curve:
    """Evaluations of one seed, finite and in ascending order of `x`."""

    x: Float[np.ndarray, " evaluations"]
    y: Float[np.ndarray, " evaluations"]


@dataclasses.dataclass(frozen=True)
class Line:
    """Statistic over seeds with its band. The band is NaN where it is undefined, such as for a single seed."""

    x: Points
    y: Points
    lower: Points
    upper: Points
    num_seeds: Int[np.ndarray, " points"]  # that have a value at each point


@dataclasses.dataclass(frozen=True)
class Statistic:
    """Function that computes a line, its lower and its upper bound from the values of seeds.

    The values are NaN where a seed has none. `name` and `band` describe the line and its band in captions.
    """

    name: str
    band: str
    compute: Callable[[Values], tuple[Points, Points, Points]]


def from_rows(rows: Sequence[Mapping[str, Any]], x: str, y: str) -> tuple[dict[int, Curve], int]:
    """Return the curve of each seed through the columns `x` and `y`, and the number of evaluations left out.

    Evaluations are left out if they are not finite. A seed without a finite evaluation has no curve. Training metrics
    have no value in the first row of a seed, which is written before the first update; this row is not counted. If a
    seed has several rows at the same `x`, the last one is used.
    """
    points_by_seed = defaultdict(list)
    for row in rows:
        points_by_seed[row["seed"]].append((row.get(x, math.nan), row.get(y, math.nan)))
    curves, num_left_out = {}, 0
    for seed in sorted(points_by_seed):
        points = np.array(points_by_seed[seed], float)
        is_finite = np.all(np.abs(points) <= MAX_VALUE, axis=1)
        num_left_out += np.count_nonzero(~is_finite[0 if y.startswith("eval/") else 1 :])
        if is_finite.any():
            distinct_x, last = np.unique(points[is_finite, 0][::-1], return_index=True)
            curves[seed] = Curve(distinct_x, points[is_finite, 1][::-1][last])
    return curves, int(num_left_out)


def read_lines(path: Path) -> dict[str, Line]:
    """Return the lines of a CSV file with `COLUMNS` by their names (column `series`).

    An optional column `n_runs` holds the number of runs; without it the number is 0, that is unknown. Raises a
    `ValueError` that names the fault of an invalid file.
    """
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            rows = list(csv.DictReader(file))
    except csv.Error as error:
        raise ValueError(str(error)) from error
    missing = [name for name in COLUMNS if not rows or name not in rows[0]]
    if missing:
        raise ValueError(f"the file has no column {missing[0]}; required columns: {', '.join(COLUMNS)}")
    lines = {}
    for name in dict.fromkeys(row["series"] for row in rows):
        points = [row for row in rows if row["series"] == name]
        x, middle, lower, upper = np.array([[float(row[key] or "nan") for key in COLUMNS[1:]] for row in points]).T
        if not np.isfinite(x).all():
            raise ValueError(f"agent_steps: must be finite numbers, got others in series {name!r}")
        lines[name] = Line(x, middle, lower, upper, np.array([int(row.get("n_runs") or 0) for row in points]))
    return lines


def trailing_mean(curve: Curve, size: int) -> Curve:
    """Return the mean of each evaluation and up to `size - 1` evaluations before it."""
    sums = np.concatenate([[0.0], np.cumsum(curve.y)])
    end = np.arange(1, len(curve.y) + 1)
    start = np.maximum(end - size, 0)
    return Curve(curve.x, (sums[end] - sums[start]) / (end - start))


def on_common_grid(curves: Sequence[Curve]) -> tuple[Points, Values]:
    """Return all points at which any seed was evaluated, and the interpolated values of the seeds there.

    Values are NaN outside of the range of a seed. At most `MAX_POINTS` points are kept, spread evenly.
    """
    grid = np.unique(np.concatenate([curve.x for curve in curves]))
    if len(grid) > MAX_POINTS:
        grid = grid[np.linspace(0, len(grid) - 1, MAX_POINTS).round().astype(int)]
    values = [np.interp(grid, curve.x, curve.y, left=math.nan, right=math.nan) for curve in curves]
    return grid, np.array(values)


def summarize(curves: Sequence[Curve], statistic: str, best_share: float = 1.0) -> Line:
    """Return one of `STATISTICS` along the common grid of the seeds.

    Only the best `best_share` of the seeds are used (a share in (0, 1], at least one seed).
    """
    grid, values = on_common_grid(curves)
    values = _best(values, best_share)
    y, lower, upper = STATISTICS[statistic].compute(values)
    return Line(grid, y, lower, upper, np.count_nonzero(~np.isnan(values), axis=0))


def bootstrapped(
    curves: Sequence[Curve], statistic: str, count: int, generator: np.random.Generator, best_share: float = 1.0
) -> list[Line]:
    """Return `summarize` of `count` bootstrap resamples, each of as many seeds as there are, with replacement.

    At points where no seed of a resample has a value, its line has the statistic of all seeds.
    """
    grid, values = on_common_grid(curves)
    full_sample = STATISTICS[statistic].compute(_best(values, best_share))
    lines = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # NumPy warns at points without any seed
        for _ in range(count):
            resample = _best(values[generator.integers(len(values), size=len(values))], best_share)
            points = STATISTICS[statistic].compute(resample)
            has_value = ~np.isnan(resample).all(axis=0)
            y, lower, upper = (np.where(has_value, x, other) for x, other in zip(points, full_sample, strict=True))
            lines.append(Line(grid, y, lower, upper, np.count_nonzero(~np.isnan(resample), axis=0)))
    return lines


def final_levels(
    curves: Sequence[Curve], start: float, end: float, best_share: float = 1.0
) -> Float[np.ndarray, " seeds"]:
    """Return the mean of each seed between two points. Seeds that end before `end` have no value and are left out."""
    grid, values = on_common_grid(curves)
    at = np.linspace(start, end, 50)
    levels = np.array([np.interp(at, grid, seed).mean() for seed in _best(values, best_share)])
    return levels[np.isfinite(levels)]


def num_best(num_seeds: int, share: float) -> int:
    """Return the number of seeds in the best `share` of `num_seeds`: rounded, and at least 1."""
    return max(1, round(share * num_seeds))


def _best(values: Values, share: float) -> Float[np.ndarray, "best points"]:
    """Return the seeds with the highest means over the points at which all seeds have a value."""
    if share == 1.0:
        return values
    means = values[:, ~np.isnan(values).any(axis=0)].mean(axis=1)
    return values[np.argsort(-means, kind="stable")[: num_best(len(values), share)]]


def profile(finals: Float[np.ndarray, " seeds"], at: Points) -> Line:
    """Return the performance profile: the fraction of seeds that end above each value (Agarwal et al., 2021, eq. 1).

    The band is a 95 % bootstrap interval of the fraction, computed as in `interquartile_mean`.
    """
    is_above = (finals[:, None] > at).astype(float)
    lower, upper = _bootstrap(is_above, np.mean)
    return Line(at, is_above.mean(axis=0), lower, upper, np.full(len(at), len(finals)))


def times_to(
    curves: Sequence[Curve], threshold: float
) -> tuple[Float[np.ndarray, " seeds"], Bool[np.ndarray, " seeds"]]:
    """Return the `x` at which each seed first reaches the threshold, and whether it reaches it at all.

    A seed reaches the threshold with its first evaluation at or above it. Otherwise its `x` is that of its last
    evaluation.
    """
    above = [np.flatnonzero(curve.y >= threshold) for curve in curves]
    times = [curve.x[indices[0] if indices.size else -1] for curve, indices in zip(curves, above, strict=True)]
    return np.array(times), np.array([indices.size > 0 for indices in above])


def reaching(curves: Sequence[Curve], threshold: float) -> Line:
    """Return the fraction of seeds that have reached a threshold, estimated by Kaplan and Meier (1958).

    A seed that ends below the threshold is censored: it counts as at risk until its end, and not after it. The band is
    the 95 % interval by the exponential Greenwood formula. It is NaN where no seed or every seed has reached the
    threshold. `num_seeds` counts the seeds at risk, which have neither reached the threshold nor ended before a point.
    """
    from scipy import stats  # noqa: PLC0415

    times, is_reached = times_to(curves, threshold)
    estimate = stats.ecdf(stats.CensoredData(uncensored=times[is_reached], right=times[~is_reached])).cdf
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # SciPy warns at points without an interval
        interval = estimate.confidence_interval(CONFIDENCE, method="log-log")
    start = min(curve.x[0] for curve in curves)
    x = np.concatenate([[start], estimate.quantiles])
    y = np.concatenate([[0.0], estimate.probabilities])
    lower, upper = (np.concatenate([[math.nan], bound.probabilities]) for bound in (interval.low, interval.high))
    return Line(x, y, lower, upper, np.count_nonzero(times[:, None] >= x, axis=0))


def median(values: Values) -> tuple[Points, Points, Points]:
    """Return median, lower and upper quartile over seeds, interpolated linearly between seeds.

    The quartiles are NaN where fewer than two seeds have a value.
    """
    lower, middle, upper = np.nanpercentile(values, (25, 50, 75), axis=0)
    is_single = np.count_nonzero(~np.isnan(values), axis=0) < 2
    return middle, np.where(is_single, math.nan, lower), np.where(is_single, math.nan, upper)


def interquartile_mean(values: Values) -> tuple[Points, Points, Points]:
    """Return the mean without the lowest and the highest quarter of seeds, and its 95 % bootstrap interval.

    Source: Agarwal et al. (2021). A quarter is rounded down, so nothing is cut from fewer than four seeds. Their
    bootstrap is stratified by task. All seeds here have one task and form a single stratum, and each resample has as
    many seeds as there are. The bounds are percentiles of the means of the resamples; they are NaN for a single seed.
    """
    has_value = ~np.isnan(values)
    patterns, pattern_of_point = np.unique(has_value, axis=1, return_inverse=True)  # of seeds that have a value
    result = np.empty((3, values.shape[1]))
    for number, seeds in enumerate(patterns.T):
        points = pattern_of_point.ravel() == number
        present = values[np.ix_(seeds, points)]
        result[:, points] = _trimmed_mean(present, axis=0), *_bootstrap(present, _trimmed_mean)
    return result[0], result[1], result[2]


STATISTICS = {
    "median": Statistic("median", "quartiles", median),
    "iqm": Statistic("interquartile mean", "95 % stratified bootstrap interval", interquartile_mean),
}


def _trimmed_mean(values: np.ndarray, axis: int) -> np.ndarray:
    from scipy import stats  # noqa: PLC0415

    return stats.trim_mean(values, 0.25, axis=axis)


def _bootstrap(values: Values, statistic: Callable[..., np.ndarray]) -> tuple[Points, Points]:
    """Return the bootstrap percentile interval of a statistic over seeds; all points share the resamples of seeds."""
    if len(values) < 2:
        undefined = np.full(values.shape[1], math.nan)
        return undefined, undefined
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
