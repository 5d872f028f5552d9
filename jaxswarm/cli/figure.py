"""The program `jaxswarm-figure`."""

import fnmatch
import itertools
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxswarm import files
from jaxswarm.cli.help import figures_help
from jaxswarm.cli.program import command, parse_integer, program, split, use_compile_cache, wants_help
from jaxswarm.config import ConfigError
from jaxswarm.files import replace_text

HELP = """\
jaxswarm-figure FIGURE [seeds=N] [scale=1.0] [series=PATTERN] [dir=runs/figures] [out=PATH] [key=value ...]
jaxswarm-figure all [dir=runs/figures] [out=PATH] [key=value ...]

The first form trains all series of a figure of the thesis with the published settings. It writes the figure with the
thesis's curves overlaid, a table, and a verdict on each claim of the figure. FIGURE_summary.csv and FIGURE_summary.tex
have medians, interquartile means and probabilities of improvement of the final levels. The same command resumes after
Ctrl-C. Figures share run folders where their series are the same. The second form trains nothing: it reports all
finished runs and copies their evaluations to out/runs, where later reports find the runs that are not in dir. Sections
of an earlier report stay if no run of their figure is found.

options
  seeds=N          Seeds of each series. The default is the number that verdicts need. A larger number later trains
                   only the missing seeds.
  scale=0.1        Train this share of the updates. Verdicts then say that the runs were cut. A larger scale resumes.
  series=PATTERN   Train only series that match the pattern, with * for anything: series='Mean*'.
  dir=PATH         Folder of the run folders (default: runs/figures).
  out=PATH         Folder of plots and reports (default: dir).
  key=value        A key of jaxswarm-train for every series. Runs with other keys have folders of their own.

examples
  jaxswarm-figure fig_6_1
  jaxswarm-figure fig_6_5 seeds=4 scale=0.1
  jaxswarm-figure fig_6_1 series='*(simple)'
  jaxswarm-figure all
"""
OPTIONS = ("seeds", "scale", "series", "dir", "out")


@program
def main(arguments: Sequence[str]) -> int:
    """Train and report a figure, or report all figures; return the exit code."""
    if wants_help(arguments) or not arguments:
        print(HELP + "\n" + _figures_help())
        return 0 if arguments else 2
    name, (options, overrides) = arguments[0], split(arguments[1:], OPTIONS)
    if name == "all" and {"seeds", "scale", "series"} & options.keys():
        raise ConfigError("seeds, scale and series: must be used with one figure; all trains nothing")
    directory = Path(options.get("dir", "runs/figures"))
    out = Path(options.get("out", directory))
    try:
        if name == "all":
            return _report_all(directory, out, overrides)
        return _run(arguments, directory, out, options, overrides)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise ConfigError(f"cannot write to {error.filename}: {error.strerror}") from error


def deprecated_main(arguments: Sequence[str] | None = None) -> int:
    """Run `jaxswarm-figure` under its name of version 0.1, after a deprecation warning."""
    print("warning: jaxswarm-experiment is deprecated and will be removed; use jaxswarm-figure", file=sys.stderr)
    return main(arguments)


def _run(
    arguments: Sequence[str], directory: Path, out: Path, options: dict[str, str], overrides: Sequence[str]
) -> int:
    from jaxswarm.figures import figure as figures  # noqa: PLC0415
    from jaxswarm.host import signals  # noqa: PLC0415

    figure = figures.load_figure(arguments[0])
    if any(word.startswith("num_seeds=") for word in overrides):
        raise ConfigError("num_seeds: write seeds=N")
    num_seeds = parse_integer("seeds", options["seeds"], 1) if "seeds" in options else None
    scale, chosen = _scale(options.get("scale", "1")), _choose(list(figure.series), options.get("series", "*"))
    runs = figures.plan(figure, directory, figures.find_runs(directory), num_seeds, scale, overrides)
    if not _train({series: runs[series] for series in chosen}):
        print(f"stopped; resume with: {command('jaxswarm-figure', *arguments)}")
        return signals.exit_code()
    section = _section(figure, runs, figures.find_runs(directory), out, overrides)
    replace_text(out / f"{figure.name}.md", section)
    print(f"\n{section}\nwrote {out / f'{figure.name}.md'}")
    return 0


def _report_all(directory: Path, out: Path, overrides: Sequence[str]) -> int:
    from jaxswarm.figures import figure as figures  # noqa: PLC0415
    from jaxswarm.figures import report  # noqa: PLC0415

    kept = out / "runs"
    found, sections, used = figures.find_runs(directory, kept), [], set()
    if not found:
        raise ConfigError(f"dir: {directory} holds no run folder; train a figure first, or give the folder of its runs")
    earlier = report.finished_sections(files.read_text(out / "report.md"))
    for figure in map(figures.load_figure, figures.names()):
        runs = figures.plan(figure, directory, found, overrides=overrides)
        section = _section(figure, runs, found, out, overrides)
        if figure.name in earlier and report.NOT_RUN in section:
            section = earlier[figure.name]
            print(f"{figure.name}: no run found, its section of the earlier report stays", file=sys.stderr)
        sections.append(section)
        configs_of_series = [run.config for run, *_ in runs.values()]
        used |= {folder.path for folder in found if any(figures.matches(folder, x) for x in configs_of_series)}
    for folder in found:
        if folder.path not in used:
            print(f"warning: {folder.path} belongs to no figure", file=sys.stderr)
    of_figures = [folder for folder in found if folder.path in used]
    for folder in of_figures:
        figures.keep_results(folder, kept)
    replace_text(out / "report.md", report.page(sections, [figures.origin(folder) for folder in of_figures]))
    print(f"wrote {out / 'report.md'}")
    return 0


def _section(figure: Any, runs: dict, found: Sequence[Any], out: Path, overrides: Sequence[str]) -> str:
    """Plot the figure and return its section of the report."""
    from jaxswarm.figures import figure as figures  # noqa: PLC0415
    from jaxswarm.figures import report  # noqa: PLC0415

    out.mkdir(parents=True, exist_ok=True)
    measured = figures.measure(figure, runs, found, lambda text: print(f"warning: {text}", file=sys.stderr))
    if measured:
        figures.plot_figure(figure, measured, out)
        figures.write_summary(figure, measured, out)
    return report.section(figure, runs, measured, overrides)


def _train(runs: Mapping[str, Sequence[Any]]) -> bool:
    """Train one series after another, resuming from their folders; return whether all are finished."""
    from jaxswarm.figures import figure as figures  # noqa: PLC0415
    from jaxswarm.host import ensemble, estimate, signals, trained  # noqa: PLC0415
    from jaxswarm.studies import execution  # noqa: PLC0415

    use_compile_cache()
    ensemble.use_cores(math.gcd(*[run.settings.num_seeds for of_series in runs.values() for run in of_series]))
    for run in itertools.chain(*runs.values()):
        estimate.check_training(run.experiment, run.settings.num_seeds)
        trained.require_warm_start(run.settings)
    for number, (series, of_series) in enumerate(runs.items()):
        for run in of_series:
            seeds, steps = run.settings.seeds, run.num_updates * run.experiment.agent_steps_per_update
            length = f"seeds {seeds[0]} to {seeds[-1]}, {steps:,} agent steps"
            print(f"series {number + 1} of {len(runs)}: {series}, {length}")
            print(f"  {run.run_dir}", flush=True)
            if figures.is_finished(run):
                continue
            if not execution.train([run]).is_finished or signals.exit_code():
                return False
    return True


def _choose(series: Sequence[str], pattern: str) -> list[str]:
    """Return the series that match the pattern."""
    chosen = fnmatch.filter(series, pattern)
    if not chosen:
        raise ConfigError(f"series: must match one of {', '.join(map(repr, series))}, got {pattern!r}")
    return chosen


def _scale(text: str) -> float:
    try:
        scale = float(text)
    except ValueError:
        scale = 0.0
    if not 0 < scale <= 1:
        raise ConfigError(f"scale: must be a number above 0, up to 1, got {text!r}")
    return scale


def _figures_help() -> str:
    """Return the figures with their descriptions."""
    from jaxswarm.figures import figure as figures  # noqa: PLC0415

    return figures_help(figures.names())
