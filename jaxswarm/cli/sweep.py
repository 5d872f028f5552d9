"""The program `jaxswarm-sweep`."""

import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from jaxswarm import config as configs
from jaxswarm.cli import plot
from jaxswarm.cli.program import command, parse_integer, program, split, use_compile_cache, wants_help, warn
from jaxswarm.config import ConfigError, plugins, renamed
from jaxswarm.files import claim_folder, is_vacant, read_text, removed_if_empty

if TYPE_CHECKING:
    from jaxswarm.studies.grid import Summary

HELP = """\
jaxswarm-sweep key=a,b,c [key=1e-4..1e-3:5log] ... [num_seeds=N] [sweep_dir=PATH]
jaxswarm-sweep search=NAME [trials=N] [storage=PATH|URL] [key=value ...] [num_seeds=N] [sweep_dir=PATH]
jaxswarm-sweep resume=PATH

The first form trains every combination of the values, each in its own run folder. Combinations that differ in numbers
only are vectorized in one compiled program; the others are trained one program after another. It ends with
a table of final returns, which is also written as summary.csv and summary.tex, the probabilities of improvement of all
pairs of runs in summary_improvement.csv, and curves.png. If a setting differs on which the scale of the return depends,
such as task.visibility_radius, the table has a metric of the task that does not depend on it.

The second form searches with Optuna. configs/search/NAME.yaml, or a YAML file, defines the search space. Each trial is
trained with num_seeds seeds, and the search maximizes the mean return during training. Machines that name the same
storage (a shared journal file, or a database such as postgresql://user@host/name) work on the same search, each in its
own sweep_dir.

Ctrl-C or SIGTERM stops after a checkpoint; the third form resumes the sweep or the search.

options
  sweep_dir=PATH   Folder of the sweep (default: sweeps/ and the time).
  search=NAME      Search space in configs/search, or the path of a YAML file.
  trials=N         Number of trials of the whole search (default: 20).
  storage=PATH     Journal file or database URL of the search (default: journal.log in sweep_dir).
  resume=PATH      Folder of a sweep or a search to resume.

examples
  jaxswarm-sweep learner.learning_rate=1e-4,3e-4,1e-3 aggregator=mean,bayesian num_seeds=8
  jaxswarm-sweep "learner.learning_rate=1e-4..1e-2:5 log" num_seeds=4 task=pursuit
  jaxswarm-sweep search=thesis aggregator=bayesian trials=40 num_seeds=4 storage=shared/journal.log
"""
OPTIONS = ("sweep_dir", "resume", "search", "trials", "storage")
PLAN = "sweep.json"  # file in the sweep folder with the options and overrides of its command


@program
def main(arguments: Sequence[str]) -> int:
    """Train a sweep or a search, or resume one; return the exit code."""
    if wants_help(arguments) or not arguments:
        print(HELP)
        return 0 if arguments else 2
    options, overrides = split(arguments, OPTIONS)
    if "resume" in options:
        if overrides or len(options) > 1:
            raise ConfigError("resume=PATH takes nothing else")
        sweep_dir = Path(options["resume"])
        options, overrides = _load(sweep_dir)
        plugins.require_trust(_imports(overrides), sweep_dir)
        return _run(sweep_dir, options, overrides)
    if given := options.pop("sweep_dir", ""):
        if not is_vacant(Path(given)):
            raise ConfigError(f"sweep_dir={given} exists and is not empty; resume it with resume={given}")
        return _run(Path(given), options, overrides)
    sweep_dir = claim_folder(Path(f"sweeps/{time.strftime('%Y%m%d-%H%M%S')}"))
    with removed_if_empty(sweep_dir.parent), removed_if_empty(sweep_dir):
        return _run(sweep_dir, options, overrides)


def _run(sweep_dir: Path, options: dict[str, str], overrides: Sequence[str]) -> int:
    if "search" in options:
        return _search(sweep_dir, options, overrides)
    if options:
        raise ConfigError(f"{next(iter(options))}: must be used with search=NAME")
    return _sweep(sweep_dir, overrides)


def _sweep(sweep_dir: Path, overrides: Sequence[str]) -> int:
    from jaxswarm.host import ensemble, estimate, signals, trained  # noqa: PLC0415
    from jaxswarm.host.run import check_folder  # noqa: PLC0415
    from jaxswarm.studies import grid  # noqa: PLC0415
    from jaxswarm.studies.execution import train  # noqa: PLC0415

    runs = grid.runs(grid.expand(overrides), sweep_dir)
    programs = grid.programs(runs)
    use_compile_cache()
    ensemble.use_cores(math.gcd(*[len(together) * together[0].settings.num_seeds for together in programs]))
    for first, *others in programs:
        num_runs = (1 + len(others)) * first.settings.num_seeds
        estimate.check_training(first.experiment, num_runs, first.num_updates, warn)
        trained.require_warm_start(first.settings)
        for run in (first, *others):
            check_folder(run, resume=True)
    _save(sweep_dir, {}, overrides)
    print(f"{_count(runs, 'run')} in {_count(programs, 'program')}\nfolder: {sweep_dir}", flush=True)
    rows = {}
    for number, together in enumerate(programs):
        num_seeds = together[0].settings.num_seeds
        names = ", ".join(run.folder.name for run in together)
        print(f"program {number + 1} of {len(programs)}: {names}; seeds of each: {num_seeds}", flush=True)
        is_finished, of_each = train(together)
        if not is_finished or signals.exit_code():  # a signal in the last chunk stops the sweep, too
            print(f"stopped; resume with: {command('jaxswarm-sweep', f'resume={sweep_dir}')}")
            return signals.exit_code()
        rows |= {run.run_dir: x for run, x in zip(together, of_each, strict=True)}
    _report(sweep_dir, grid.summary(runs, [rows[run.run_dir] for run in runs]))
    return plot.main([str(sweep_dir), f"out={sweep_dir / 'curves.png'}"])


def _report(sweep_dir: Path, summary: "Summary") -> None:
    """Print the summary of a sweep, and write it as CSV and LaTeX."""
    from jaxswarm.analysis import summaries  # noqa: PLC0415

    explanation = summary.comparison.explain()
    print(f"\nfinal {summary.lines[0]['metric']} of each run" + (f"; {explanation}" if explanation else ""))
    print(summaries.text(summary.lines) + "\n")
    for path in summaries.write(sweep_dir / "summary", summary.lines, summary.improvements):
        print(f"wrote {path}")


def _search(sweep_dir: Path, options: dict[str, str], overrides: Sequence[str]) -> int:
    from jaxswarm.host import ensemble, estimate, signals, trained  # noqa: PLC0415
    from jaxswarm.host.run import Run, check_folder  # noqa: PLC0415
    from jaxswarm.studies import search  # noqa: PLC0415
    from jaxswarm.studies.execution import train  # noqa: PLC0415

    pairs = configs.parse(overrides)
    config = configs.compose_pairs(pairs)
    space = search.load_space(options["search"], config)
    num_trials = parse_integer("trials", options.get("trials", 20), 1)
    use_compile_cache()
    ensemble.use_cores(config["num_seeds"])
    template = Run.from_config(config, sweep_dir / "trial")
    check_folder(template, resume=True)
    estimate.check_training(template.experiment, template.settings.num_seeds)
    trained.require_warm_start(template.settings)
    study = search.open_study(options["storage"]) if "storage" in options else None
    _save(sweep_dir, options, overrides)
    study = search.open_study(str(sweep_dir / "journal.log")) if study is None else study
    search.requeue_killed(study, sweep_dir)
    while search.num_started(study) < num_trials:
        asked = search.ask(study, config["seed"])
        run_dir = Path(asked.user_attrs.get(search.RUN_DIR, sweep_dir.resolve() / f"trial-{asked.number:04}"))
        asked.set_user_attr(search.RUN_DIR, str(run_dir))
        of_trial = search.suggest(asked, space, pairs)
        print(f"trial {asked.number}: {json.dumps(asked.params)}", flush=True)
        run = Run.from_config(of_trial, run_dir)
        is_finished, (rows,) = train([run])
        if not is_finished:
            search.requeue(study, asked.number)
            print(f"stopped; resume with: {command('jaxswarm-sweep', f'resume={sweep_dir}')}")
            return signals.exit_code()
        search.tell(study, asked, search.value(rows, run.seeds, run.num_evaluations))
    done = [trial for trial in study.get_trials(deepcopy=False) if trial.value is not None]
    for trial in sorted(done, key=lambda trial: trial.value or 0.0, reverse=True)[:5]:
        print(f"{trial.value:10.2f}  {trial.user_attrs[search.RUN_DIR]}  {json.dumps(trial.params)}")
    return 0


def _count(things: Sequence, name: str) -> str:
    return f"{len(things)} {name}" + ("s" if len(things) != 1 else "")


def _save(sweep_dir: Path, options: dict[str, str], overrides: Sequence[str]) -> None:
    from jaxswarm.files import replace_text  # noqa: PLC0415

    try:
        sweep_dir.mkdir(parents=True, exist_ok=True)
        replace_text(sweep_dir / PLAN, json.dumps({"options": options, "overrides": list(overrides)}, indent=2) + "\n")
    except OSError as error:
        raise ConfigError(f"cannot write to {sweep_dir}: {error.strerror}") from error
    plugins.trust(_imports(overrides))


def _imports(overrides: Sequence[str]) -> list[str]:
    """Return the files and modules that a sweep imports."""
    values = [value for _, value in configs.parse([word for word in overrides if word.startswith("imports=")])]
    return [one for value in values for one in ([value] if isinstance(value, str) else value)]


def _load(sweep_dir: Path) -> tuple[dict[str, str], list[str]]:
    try:
        plan = json.loads(read_text(sweep_dir / PLAN))
        if not isinstance(plan, dict):
            raise ValueError("it must be a mapping")
        options, is_old = dict(plan["options"]), "words" in plan  # version 0.1
        overrides = list(plan["words" if is_old else "overrides"])
        if not all(isinstance(text, str) for text in (*options, *options.values(), *overrides)):
            raise ValueError("options and overrides must be texts")
        if unknown := set(options) - set(OPTIONS):
            raise ValueError(f"unknown option {unknown.pop()!r}")
        return options, [renamed.translate_override(text) for text in overrides] if is_old else overrides
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{sweep_dir} is not the folder of a sweep: it has no valid {PLAN} ({error})") from error
