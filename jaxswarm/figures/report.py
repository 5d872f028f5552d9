"""Report on the reproduced figures of the thesis, as Markdown."""

import math
from collections.abc import Mapping, Sequence

from jaxswarm.figures.claims import Measured, Verdict
from jaxswarm.figures.figure import FRACTIONS, Figure, thesis_measured, verdicts
from jaxswarm.host.run import Run

NOT_RUN = "This figure was not run."
HEAD = """\
# Reproduced figures of the thesis

All curves are medians over seeds. The final level is the mean over the last tenth of a curve, with its quartiles in
brackets. The columns "50% at", "90% at" and "95% at" contain millions of agent steps. They are the steps to this share
of the way from the start to the final level of the thesis's curve. A dash means that the curve does not reach the level
or does not exist.

A verdict requires all seeds of a figure, trained as far as the claim needs. It also requires that at least nine of ten
bootstrap resamples of the seeds give the same result. Brackets in the column "here" are 80 % bootstrap intervals.
"""


def page(sections: Sequence[str], origins: Sequence[tuple[str, str]]) -> str:
    """Return the whole report. `origins` are pairs of the device and the code revision of each run."""
    revisions = {device: sorted({x for other, x in origins if other == device}) for device, _ in sorted(origins)}
    lines = [
        f"The runs on {device} used these revisions of the code: {', '.join(x)}.\n" for device, x in revisions.items()
    ]
    return "\n".join([HEAD, *lines, *sections])


def finished_sections(page: str) -> dict[str, str]:
    """Return the sections of a report by figure name, without those of figures that were not run."""
    parts = [f"## {part}" for part in page.split("\n## ")[1:]]
    return {part[3 : part.index(":")]: part.rstrip("\n") + "\n" for part in parts if NOT_RUN not in part}


def section(
    figure: Figure, runs: Mapping[str, Sequence[Run]], measured: Mapping[str, Measured], overrides: Sequence[str]
) -> str:
    """Return the section of one figure: its plots, a table of its series, and the verdicts."""
    title = f"## {figure.name}: {figure.title}\n\n"
    if not measured:
        return f"{title}{NOT_RUN}\n"
    images = [f"![{figure.title}]({name}.png)" for name in figure.pictures]
    changed = [f"These overrides differ from the thesis: {' '.join(overrides)}."] if overrides else []
    tables = [_table(figure, runs, measured), *([_verdicts(figure, measured)] if figure.claims else [])]
    return title + "\n\n".join([*images, *changed, *_cuts(measured), *tables]) + "\n"


def _cuts(measured: Mapping[str, Measured]) -> list[str]:
    cut = [f"{name} ({ours.line.x[-1] / ours.end:.0%})" for name, ours in measured.items() if ours.is_cut]
    return [f"These series are shorter than the figure shows: {'; '.join(cut)}."] if cut else []


def _table(figure: Figure, runs: Mapping[str, Sequence[Run]], measured: Mapping[str, Measured]) -> str:
    """Return a table with a row for each series: final levels and steps, ours and those of the thesis."""
    heads = ["series", "seeds", "M agent steps", "final", "in the thesis"]
    rows = [[*heads, *(f"{x:.0%} at (thesis)" for x in FRACTIONS)], ["---"] * (len(heads) + len(FRACTIONS))]
    theirs = thesis_measured(figure)
    for name in runs:
        ours, thesis = measured.get(name), theirs.get(name)
        length = f"{ours.line.x[-1] / 1e6:.1f}" if ours else "not run"
        steps = [f"{_steps(thesis and ours, x)} ({_steps(thesis, x)})" for x in FRACTIONS]
        rows.append([name, str(ours.num_seeds if ours else 0), length, _level(ours), _level(thesis), *steps])
    return _markdown(rows)


def _verdicts(figure: Figure, measured: Mapping[str, Measured]) -> str:
    rows = [["claim", "verdict", "here", "in the thesis", "accepted"], ["---"] * 5]
    for verdict in verdicts(figure, measured):
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
