"""Claims about learning curves: a number computed from the curves, and the range in which it must be.

The curves are medians over seeds, measured as in the thesis. The same number is computed from our curves and from those
of the thesis. Bootstrap resamples of the seeds estimate the certainty: a verdict requires that at least 90 % agree.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from jaxswarm.analysis.curves import Line, Points

LAST = 0.1  # share of a curve, at its end, whose mean is the final level
SMOOTHED = 5  # evaluations of the centered mean that smooths a curve
TOLERANCE = 1e-3  # share of a curve that may be missing at its end
CERTAINTY = 0.9  # share of bootstrap resamples that must agree


@dataclasses.dataclass(frozen=True)
class Measured:
    """Curve of a series. `reference` is the curve that it is compared with, whose levels define `steps_to`."""

    line: Line
    reference: Line
    end: float  # agent steps at which the last tenth, the final level, ends
    bootstrapped: tuple[Line, ...] = ()  # the line of each bootstrap resample of the seeds
    finals: Points = dataclasses.field(default_factory=lambda: np.empty(0))  # final level of each seed

    @property
    def is_cut(self) -> bool:
        """Return whether the series ends before `end`."""
        return self.is_cut_before(self.end)

    @property
    def num_seeds(self) -> int:
        """Number of seeds that have reached the end."""
        return self.num_seeds_at(self.end)

    def is_cut_before(self, steps: float) -> bool:
        """Return whether the series ends before `steps` agent steps."""
        return bool(self.line.x[-1] < (1 - TOLERANCE) * steps)

    def num_seeds_at(self, steps: float) -> int:
        """Return the number of seeds that have reached `steps` agent steps."""
        return int(np.interp(steps, self.line.x, self.line.num_seeds))

    def final(self, values: Points | None = None) -> float:
        """Return the final level: the mean over the last tenth of the median, or of `values` such as a quartile."""
        values = self.line.y if values is None else values
        return _final(self.line.x, values, self.end)

    def at(self, steps: float) -> float:
        """Return the smoothed median after `steps` agent steps; NaN beyond its end."""
        return float(np.interp(steps, self.line.x, _smooth(self.line.y), right=math.nan))

    def steps_to(self, fraction: float) -> float:
        """Return the agent steps until the smoothed median reaches a level; NaN if it never does.

        The level is `fraction` of the way from the start to the final level of the reference.
        """
        start, final = self.reference.y[0], _final(self.reference.x, self.reference.y, self.reference.x[-1])
        reached = np.flatnonzero(_smooth(self.line.y) >= start + fraction * (final - start))
        return float(self.line.x[reached[0]]) if reached.size else math.nan


@dataclasses.dataclass(frozen=True)
class Claim:
    """Claim about series: the sentence `says`, which holds if a number of a kind in `KINDS` is in [`low`, `high`]."""

    says: str
    kind: str
    series: tuple[str, ...]
    low: float = -math.inf
    high: float = math.inf
    at: float = math.nan  # agent steps, for the kinds level and lead
    fraction: float = math.nan  # of the way to the final level, for the kinds steps and pace

    def number(self, series: Mapping[str, Measured]) -> float:
        """Return the number of the claim; NaN if it is unknown.

        The number of `pace` is infinite or 0 if one of the two series never reaches the level.
        """
        return KINDS[self.kind](self, [series[name] for name in self.series])

    def needs(self, one: Measured) -> float:
        """Return the agent steps up to which the claim needs a series."""
        if not math.isnan(self.at):
            return self.at
        reached = math.nan if math.isnan(self.fraction) else one.steps_to(self.fraction)
        return one.end if math.isnan(reached) else reached

    def holds(self, number: float) -> bool:
        """Return whether the number is in the range; NaN never is."""
        return bool(self.low <= number <= self.high)


@dataclasses.dataclass(frozen=True)
class Verdict:
    """Outcome of a claim, with its number in our curves and in the thesis; NaN if a number is unknown."""

    claim: Claim
    outcome: str  # reproduced, not reproduced, not enough runs, seeds disagree, run was cut
    here: float
    thesis: float
    num_seeds: int
    interval: tuple[float, float] = (math.nan, math.nan)  # 80 % bootstrap interval of the number here


def judge(claim: Claim, ours: Mapping[str, Measured], theirs: Mapping[str, Measured], enough: int) -> Verdict:
    """Return the verdict on a claim.

    It requires `enough` seeds of every series, trained up to the step that the claim needs, and a share `CERTAINTY` of
    the bootstrap resamples that agree.
    """
    thesis = claim.number(theirs) if theirs.keys() >= set(claim.series) else math.nan
    if not ours.keys() >= set(claim.series):
        return Verdict(claim, "not enough runs", math.nan, thesis, 0)
    series = [ours[name] for name in claim.series]
    here, bootstrapped = claim.number(ours), _bootstrapped_numbers(claim, ours)
    num_seeds = min(one.num_seeds_at(claim.needs(one)) for one in series)
    if any(one.is_cut_before(claim.needs(one)) for one in series):
        outcome = "run was cut"
    elif num_seeds < enough:
        outcome = "not enough runs"
    elif np.mean([claim.holds(x) == claim.holds(here) for x in [here, *bootstrapped]]) < CERTAINTY:
        outcome = "seeds disagree"
    else:
        outcome = "reproduced" if claim.holds(here) else "not reproduced"
    numbers = np.nan_to_num(bootstrapped, nan=math.inf, posinf=math.inf)  # NaN: the level is never reached
    low, high = np.percentile(numbers, [10, 90], method="nearest") if bootstrapped else (math.nan, math.nan)
    return Verdict(claim, outcome, here, thesis, num_seeds, (float(low), float(high)))


def _bootstrapped_numbers(claim: Claim, series: Mapping[str, Measured]) -> list[float]:
    """Return the claim's number for each bootstrap resample of the seeds of all its series."""
    count = min(len(series[name].bootstrapped) for name in claim.series)

    def resample(number: int) -> dict[str, Measured]:
        return {
            name: dataclasses.replace(series[name], line=series[name].bootstrapped[number]) for name in claim.series
        }

    return [claim.number(resample(number)) for number in range(count)]


def _final(x: Points, values: Points, end: float) -> float:
    end = min(end, x[-1])
    return float(np.interp(np.linspace((1 - LAST) * end, end, 50), x, values).mean())


def _smooth(values: Points) -> Points:
    """Return centered means over `SMOOTHED` values; beyond the ends, the first and the last value are repeated."""
    padded = np.pad(values, SMOOTHED // 2, mode="edge")
    return np.convolve(padded, np.full(SMOOTHED, 1 / SMOOTHED), mode="valid")


def _finals(series: Sequence[Measured]) -> np.ndarray:
    return np.array([one.final() for one in series])


def _spread(_: Claim, series: Sequence[Measured]) -> float:
    return float(np.ptp(_finals(series)))


def _overlap(_: Claim, series: Sequence[Measured]) -> float:
    lower, upper = ([one.final(getattr(one.line, name)) for one in series] for name in ("lower", "upper"))
    return min(upper) - max(lower)


def _lead(claim: Claim, series: Sequence[Measured]) -> float:
    first, *others = (one.at(claim.at) for one in series)
    return first - max(others)


def _pace(claim: Claim, series: Sequence[Measured]) -> float:
    steps = [one.steps_to(claim.fraction) for one in series]
    is_never_reached = [math.isnan(x) and not one.is_cut for x, one in zip(steps, series, strict=True)]
    first, second = np.where(is_never_reached, math.inf, steps).tolist()
    return first / second  # NaN if both are infinite


KINDS: dict[str, Callable[[Claim, Sequence[Measured]], float]] = {
    "final": lambda _, series: series[0].final(),  # final level
    "lower_quartile": lambda _, series: series[0].final(series[0].line.lower),  # lower quartile of the final level
    "difference": lambda _, series: series[0].final() - series[1].final(),  # first minus second final level
    "spread": _spread,  # highest minus lowest final level
    "overlap": _overlap,  # width of the overlap of the interquartile ranges of the final levels
    "level": lambda claim, series: min(one.at(claim.at) for one in series),  # lowest of the series at a step
    "lead": _lead,  # first series minus the best of the others at a step
    "steps": lambda claim, series: series[0].steps_to(claim.fraction),  # agent steps to a fraction of the way
    "pace": _pace,  # agent steps of the first series divided by those of the second
}
