"""The program `jaxswarm-experiment`."""

import fnmatch
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxswarm import config as configs
from jaxswarm.cli.program import command, program, split, use_compile_cache, wants_help, whole
from jaxswarm.config import ConfigError
from jaxswarm.files import replace_text

HELP = """\
jaxswarm-experiment FIGURE [seeds=N] [scale=1.0] [series=PATTERN] [dir=runs/figures] [out=PATH] [key=value ...]
jaxswarm-experiment all [dir=runs/figures] [out=benchmarks/results] [key=value ...]

Trains all series of a figure of the thesis as they were trained there, and writes the figure with the curves of the
thesis behind, a table, and a verdict on each thing that the figure shows. The same command continues after Ctrl-C.
Figures share run folders where their series are the same. all trains nothing: it reports what has been trained, and
keeps the evaluations of these runs in out/runs, from where later reports take what is not in dir.

  seeds=N          of each series; default: as many as verdicts need. More seeds later train only those that are missing
  scale=0.1        a tenth of the updates; verdicts then say that the runs were cut. A larger scale goes on from there
  series=PATTERN   only series with such names, * for anything: series='Mean*'
  dir=PATH         where the run folders are
  out=PATH         where figures and report are written; default: dir, and for all benchmarks/results
  key=value        a key of jaxswarm-train, for every series; runs with other keys are runs of their own

examples
  jaxswarm-experiment fig_6_1
  jaxswarm-experiment fig_6_5 seeds=4 scale=0.1
  jaxswarm-experiment fig_6_1 series='*(simple)'
  jaxswarm-experiment all
"""
OPTIONS = ("seeds", "scale", "series", "dir", "out")


@program
def main(arguments: Sequence[str]) -> int:
    """Trains and reports a figure, or reports all; returns the exit code."""
    if wants_help(arguments) or not arguments:
        print(HELP + "\n" + _figures_help())
        return 0 if arguments else 2
    name, (options, overrides) = arguments[0], split(arguments[1:], OPTIONS)
    if name == "all" and {"seeds", "scale", "series"} & options.keys():
        raise ConfigError("seeds, scale and series have no meaning here; all reports what has been trained")
    directory = Path(options.get("dir", "runs/figures"))
    out = Path(options.get("out", "benchmarks/results" if name == "all" else directory))
    try:
        if name == "all":
            return _report_all(directory, out, overrides)
        return _run(arguments, directory, out, options, overrides)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise ConfigError(f"cannot write to {error.filename}: {error.strerror}") from error


def _run(
    arguments: Sequence[str], directory: Path, out: Path, options: dict[str, str], overrides: Sequence[str]
) -> int:
    from jaxswarm.figures import figure as experiments  # noqa: PLC0415

    figure = experiments.load(arguments[0])
    if any(word.startswith("num_seeds=") for word in overrides):
        raise ConfigError("num_seeds has no meaning here; write seeds=N")
    num_seeds = whole("seeds", options["seeds"], 1) if "seeds" in options else None
    scale, chosen = _scale(options.get("scale", "1")), _choose(list(figure.series), options.get("series", "*"))
    trials = experiments.plan(figure, directory, experiments.stored(directory), num_seeds, scale, overrides)
    if not _train({series: trials[series] for series in chosen}):
        print(f"stopped; continue with: {command('jaxswarm-experiment', *arguments)}")
        return 0
    section = _section(figure, trials, experiments.stored(directory), out, overrides)
    replace_text(out / f"{figure.name}.md", section)
    print(f"\n{section}\nwrote {out / f'{figure.name}.md'}")
    return 0


def _report_all(directory: Path, out: Path, overrides: Sequence[str]) -> int:
    from jaxswarm.figures import figure as experiments  # noqa: PLC0415
    from jaxswarm.figures import report  # noqa: PLC0415

    kept = out / "runs"
    found, sections, used = experiments.stored(directory, kept), [], set()
    if not found:
        raise ConfigError(
            f"dir = {directory} holds no run folder; train a figure first, or name the folder of its runs"
        )
    for figure in map(experiments.load, experiments.names()):
        trials = experiments.plan(figure, directory, found, overrides=overrides)
        sections.append(_section(figure, trials, found, out, overrides))
        configs_of_series = [trial.config for trial, *_ in trials.values()]
        used |= {folder.path for folder in found if any(experiments.is_of(folder, x) for x in configs_of_series)}
    for folder in found:
        if folder.path not in used:
            print(f"warning: {folder.path} is of no figure", file=sys.stderr)
    of_figures = [folder for folder in found if folder.path in used]
    for folder in of_figures:
        experiments.keep(folder, kept)
    replace_text(out / "report.md", report.page(sections, [experiments.origin(folder) for folder in of_figures]))
    print(f"wrote {out / 'report.md'}")
    return 0


def _section(figure: Any, trials: dict, found: Sequence[Any], out: Path, overrides: Sequence[str]) -> str:
    """The figure's part of the report, its pictures drawn."""
    from jaxswarm.figures import figure as experiments  # noqa: PLC0415
    from jaxswarm.figures import report  # noqa: PLC0415

    out.mkdir(parents=True, exist_ok=True)
    measured = experiments.measure(figure, trials, found, lambda text: print(f"warning: {text}", file=sys.stderr))
    if measured:
        experiments.draw(figure, measured, out)
    return report.section(figure, trials, measured, overrides)


def _train(trials: dict) -> bool:
    """Trains series after series, from where their folders stand; whether all have reached their end."""
    from jaxswarm.figures import figure as experiments  # noqa: PLC0415
    from jaxswarm.host import ensemble  # noqa: PLC0415
    from jaxswarm.studies.trials import train  # noqa: PLC0415

    use_compile_cache()
    ensemble.use_cores(math.gcd(*[trial.settings.num_seeds for of_series in trials.values() for trial in of_series]))
    for number, (series, of_series) in enumerate(trials.items()):
        for trial in of_series:
            seeds, steps = trial.settings.seeds, trial.num_updates * trial.experiment.agent_steps_per_update
            length = f"seeds {seeds[0]} to {seeds[-1]}, {steps:,} agent steps"
            print(f"series {number + 1} of {len(trials)}: {series}, {length}")
            print(f"  {trial.run_dir}", flush=True)
            if not experiments.is_finished(trial) and not train([trial])[0]:
                return False
    return True


def _choose(series: Sequence[str], pattern: str) -> list[str]:
    """The series with such names."""
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
    """Figures with the comment of each file."""
    from jaxswarm.figures import figure as experiments  # noqa: PLC0415

    lines = ["figures"]
    for name in experiments.names():
        with open(configs.config_dir() / configs.FIGURES / f"{name}.yaml", encoding="utf-8") as file:
            lines.append(f"  {name:<18} {file.readline()[2:].strip()}")
    return "\n".join(lines)
