"""What the runs of figures of the thesis show, as Markdown."""

import math
from collections.abc import Mapping, Sequence

from jaxswarm.figures import figure as experiments
from jaxswarm.figures.claims import Measured, Verdict
from jaxswarm.figures.figure import FRACTIONS, Figure
from jaxswarm.studies.trials import Trial

HEAD = """\
# The figures of the thesis, run again

Medians over seeds. The final level is the mean of the last tenth of a curve, with quartiles where there are any. Steps
are millions of agent steps to a share of the way from the start to the final level of the thesis's curve; a dash means
not within what was trained. A verdict takes all seeds that a figure asks for, trained as far as the claim looks, and
that it would be the same for nine of ten redrawings of these seeds (bootstrap); four of five redrawings give numbers
within the brackets.
"""


def page(sections: Sequence[str], origins: Sequence[tuple[str, str]]) -> str:
    """The whole report; `origins` are devices and revisions that the runs were trained with."""
    revisions = {device: sorted({x for other, x in origins if other == device}) for device, _ in sorted(origins)}
    lines = [f"Trained on {device}, revisions of the code: {', '.join(x)}.\n" for device, x in revisions.items()]
    return "\n".join([HEAD, *lines, *sections])


def section(
    figure: Figure, trials: Mapping[str, Sequence[Trial]], measured: Mapping[str, Measured], overrides: Sequence[str]
) -> str:
    """One figure: the picture, a table of its series, and verdicts; or that it was not run."""
    title = f"## {figure.name}: {figure.title}\n\n"
    if not measured:
        return f"{title}Not run.\n"
    pictures = [f"![{figure.title}]({name}.png)" for name in figure.pictures]
    changed = [f"Not as in the thesis: {' '.join(overrides)}."] if overrides else []
    tables = [_table(figure, trials, measured), *([_verdicts(figure, measured)] if figure.claims else [])]
    return title + "\n\n".join([*pictures, *changed, *_cuts(measured), *tables]) + "\n"


def _cuts(measured: Mapping[str, Measured]) -> list[str]:
    cut = [f"{name} at {ours.line.x[-1] / ours.end:.0%}" for name, ours in measured.items() if ours.is_cut]
    return [f"Cut: {'; '.join(cut)} of what the figure shows."] if cut else []


def _table(figure: Figure, trials: Mapping[str, Sequence[Trial]], measured: Mapping[str, Measured]) -> str:
    """A row for each series: final levels and steps, ours and the thesis's."""
    heads = ["series", "seeds", "M agent steps", "final", "in the thesis"]
    rows = [[*heads, *(f"{x:.0%} at (thesis)" for x in FRACTIONS)], ["---"] * (len(heads) + len(FRACTIONS))]
    theirs = experiments.of_thesis(figure)
    for name in trials:
        ours, thesis = measured.get(name), theirs.get(name)
        length = f"{ours.line.x[-1] / 1e6:.1f}" if ours else "not run"
        steps = [f"{_steps(thesis and ours, x)} ({_steps(thesis, x)})" for x in FRACTIONS]
        rows.append([name, str(ours.num_seeds if ours else 0), length, _level(ours), _level(thesis), *steps])
    return _markdown(rows)


def _verdicts(figure: Figure, measured: Mapping[str, Measured]) -> str:
    rows = [["claim", "verdict", "here", "in the thesis", "accepted"], ["---"] * 5]
    for verdict in experiments.verdicts(figure, measured):
        here, thesis, low, high = (_number(verdict, x) for x in (verdict.here, verdict.thesis, *verdict.interval))
        here += "" if "-" in (here, low) else f" [{low}, {high}]"
        rows.append([verdict.claim.says, verdict.outcome, here, thesis, _range(verdict)])
    return _markdown(rows)


def _range(verdict: Verdict) -> str:
    low, high = (_number(verdict, x) for x in (verdict.claim.low, verdict.claim.high))
    if math.isinf(verdict.claim.high):
        return f"from {low}"
    return f"to {high}" if math.isinf(verdict.claim.low) else f"{low} to {high}"


def _number(verdict: Verdict, value: float) -> str:
    if math.isnan(value):
        return "-"
    if math.isinf(value):
        return "never"
    return f"{value / 1e6:.3g} M steps" if verdict.claim.kind == "steps" else f"{value:.3g}"


def _steps(measured: Measured | None, fraction: float) -> str:
    steps = measured.steps_to(fraction) if measured else math.nan
    return "-" if math.isnan(steps) else f"{steps / 1e6:.1f}"


def _level(measured: Measured | None) -> str:
    if measured is None:
        return "-"
    low, high = (measured.final(x) for x in (measured.line.lower, measured.line.upper))
    return f"{measured.final():.2f}" + ("" if math.isnan(low) else f" [{low:.2f}, {high:.2f}]")


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)
