"""Claims about learning curves: a number that follows from them, and the range in which it has to be.

Curves are medians over seeds, measured as the thesis measured its own, and the same number is computed of both. How
certain a number is follows from redrawing the seeds (bootstrap): a verdict takes that nine of ten redrawings agree.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from jaxswarm.analysis.curves import Line, Points

LAST = 0.1  # share of a curve that makes up its final level
SMOOTHED = 5  # evaluations, centered, before it is asked when a curve reaches a level
TOLERANCE = 1e-3  # share of a curve that may be missing at its end
CERTAINTY = 0.9  # share of redrawings that have to agree


@dataclasses.dataclass(frozen=True)
class Measured:
    """A series; `reference` is the curve to compare with, which says where it ends and what its levels are."""

    line: Line
    reference: Line
    end: float  # agent steps where the last tenth is over
    bootstrapped: tuple[Line, ...] = ()  # the same of seeds drawn from these, with replacement

    @property
    def is_cut(self) -> bool:
        """Whether the series ends before it should."""
        return self.is_cut_before(self.end)

    @property
    def num_seeds(self) -> int:
        """Those that have reached the end."""
        return self.num_seeds_at(self.end)

    def is_cut_before(self, steps: float) -> bool:
        """Whether the series ends before so many agent steps."""
        return bool(self.line.x[-1] < (1 - TOLERANCE) * steps)

    def num_seeds_at(self, steps: float) -> int:
        """Those that have come so far."""
        return int(np.interp(steps, self.line.x, self.line.num_seeds))

    def final(self, values: Points | None = None) -> float:
        """Mean over the last tenth: of the median, or of a quartile."""
        values = self.line.y if values is None else values
        return _final(self.line.x, values, self.end)

    def at(self, steps: float) -> float:
        """The smoothed median after so many agent steps, NaN beyond its end."""
        return float(np.interp(steps, self.line.x, _smooth(self.line.y), right=math.nan))

    def steps_to(self, fraction: float) -> float:
        """Agent steps to this share of the reference's way from its start to its final level; NaN if never."""
        start, final = self.reference.y[0], _final(self.reference.x, self.reference.y, self.reference.x[-1])
        reached = np.flatnonzero(_smooth(self.line.y) >= start + fraction * (final - start))
        return float(self.line.x[reached[0]]) if reached.size else math.nan


@dataclasses.dataclass(frozen=True)
class Claim:
    """A sentence, and the number that decides it: of a kind of `KINDS`, for these series, from `low` to `high`."""

    says: str
    kind: str
    series: tuple[str, ...]
    low: float = -math.inf
    high: float = math.inf
    at: float = math.nan  # agent steps, of the kinds that ask for a point
    fraction: float = math.nan  # of the way to the final level, of the kinds that ask when

    def number(self, series: Mapping[str, Measured]) -> float:
        """What the claim is about; NaN if not known, of `pace` infinite or 0 where one series never gets there."""
        return KINDS[self.kind](self, [series[name] for name in self.series])

    def needs(self, one: Measured) -> float:
        """Up to how many agent steps the claim looks at a series."""
        if not math.isnan(self.at):
            return self.at
        reached = math.nan if math.isnan(self.fraction) else one.steps_to(self.fraction)
        return one.end if math.isnan(reached) else reached

    def holds(self, number: float) -> bool:
        """Whether it is in the range; NaN never is."""
        return bool(self.low <= number <= self.high)


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What became of a claim, with the number here and in the thesis; NaN where there is none."""

    claim: Claim
    outcome: str  # reproduced, not reproduced, not enough runs, run was cut
    here: float
    thesis: float
    num_seeds: int
    interval: tuple[float, float] = (math.nan, math.nan)  # of the number here, in four of five redrawings


def judge(claim: Claim, ours: Mapping[str, Measured], theirs: Mapping[str, Measured], enough: int) -> Verdict:
    """The verdict, which takes `enough` seeds of every series, trained as far as the claim looks, that agree."""
    thesis = claim.number(theirs) if theirs.keys() >= set(claim.series) else math.nan
    if not ours.keys() >= set(claim.series):
        return Verdict(claim, "not enough runs", math.nan, thesis, 0)
    series = [ours[name] for name in claim.series]
    here, bootstrapped = claim.number(ours), _redrawn(claim, ours)
    num_seeds = min(one.num_seeds_at(claim.needs(one)) for one in series)
    if any(one.is_cut_before(claim.needs(one)) for one in series):
        outcome = "run was cut"
    elif (
        num_seeds < enough or np.mean([claim.holds(x) == claim.holds(here) for x in [here, *bootstrapped]]) < CERTAINTY
    ):
        outcome = "not enough runs"
    else:
        outcome = "reproduced" if claim.holds(here) else "not reproduced"
    numbers = np.nan_to_num(bootstrapped, nan=math.inf, posinf=math.inf)  # steps to where it never gets
    low, high = np.percentile(numbers, [10, 90], method="nearest") if bootstrapped else (math.nan, math.nan)
    return Verdict(claim, outcome, here, thesis, num_seeds, (float(low), float(high)))


def _redrawn(claim: Claim, series: Mapping[str, Measured]) -> list[float]:
    """The claim's number in every redrawing of the seeds of all its series."""
    count = min(len(series[name].bootstrapped) for name in claim.series)

    def draw(number: int) -> dict[str, Measured]:
        return {
            name: dataclasses.replace(series[name], line=series[name].bootstrapped[number]) for name in claim.series
        }

    return [claim.number(draw(number)) for number in range(count)]


def _final(x: Points, values: Points, end: float) -> float:
    end = min(end, x[-1])
    return float(np.interp(np.linspace((1 - LAST) * end, end, 50), x, values).mean())


def _smooth(values: Points) -> Points:
    """Centered means; at the ends the first and the last value count for those that would be beyond."""
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
    is_never = [math.isnan(x) and not one.is_cut for x, one in zip(steps, series, strict=True)]
    first, second = np.where(is_never, math.inf, steps).tolist()
    return first / second  # NaN if both are infinite


KINDS: dict[str, Callable[[Claim, Sequence[Measured]], float]] = {
    "final": lambda _, series: series[0].final(),  # the final level
    "lower_quartile": lambda _, series: series[0].final(series[0].line.lower),  # of the final level
    "difference": lambda _, series: series[0].final() - series[1].final(),  # of two final levels
    "spread": _spread,  # between the highest and the lowest final level
    "overlap": _overlap,  # of what lies between the quartiles of the final levels
    "level": lambda claim, series: min(one.at(claim.at) for one in series),  # the lowest of the series, at a point
    "lead": _lead,  # at a point, of the first series over the best of the others
    "steps": lambda claim, series: series[0].steps_to(claim.fraction),  # to a fraction of the way
    "pace": _pace,  # the steps of the first series over those of the second
}
