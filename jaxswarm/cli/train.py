"""The program `jaxswarm-train`."""

import contextlib
import io
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxswarm import config as configs
from jaxswarm.cli.help import keys_help
from jaxswarm.cli.policy_options import restore_policies
from jaxswarm.cli.program import (
    command,
    join_processes,
    load_config,
    parse_flag,
    program,
    require_keys,
    resume_command,
    split,
    substitute_imports,
    use_compile_cache,
    wants_help,
    warn,
)
from jaxswarm.config import Config, ConfigError
from jaxswarm.files import claim_folder, is_vacant, removed_if_empty

HELP = """\
jaxswarm-train [group=choice | key=value] ... [run_dir=PATH]
jaxswarm-train resume=PATH [num_updates=N | total_agent_steps=N] [force=true]
jaxswarm-train [group=choice] ... --help

Trains a swarm and writes a run folder: config.yaml, manifest.json, metrics.csv, curve.png, replay.html, checkpoints.
Ctrl-C or SIGTERM stops after a checkpoint. resume=PATH continues that run exactly from its last checkpoint.
It refuses a folder whose settings or results were changed since; force=true continues with what the folder holds.
Several processes, on one or more machines, train together if each runs the same command with JAX_COORDINATOR_ADDRESS,
JAX_NUM_PROCESSES and JAX_PROCESS_ID set. The first process writes the files.

examples
  jaxswarm-train
  jaxswarm-train aggregator=bayesian learner.learning_rate=3e-4 task.num_agents=10 seed=3
  jaxswarm-train experiment=rendezvous_thesis run_dir=runs/thesis
  jaxswarm-train task=pursuit num_seeds=16
  jaxswarm-train init_from=runs/small task.num_agents=50
  jaxswarm-train resume=runs/thesis num_updates=320
"""


@program
def main(arguments: Sequence[str]) -> int:
    """Train or resume a run; return the exit code."""
    if wants_help(arguments):
        print(HELP + "\n" + keys_help([word for word in arguments if "=" in word]))
        return 0
    if join_processes():
        return _train(arguments, is_first=True)
    with contextlib.redirect_stdout(io.StringIO()):
        return _train(arguments, is_first=False)


def _train(arguments: Sequence[str], is_first: bool) -> int:
    paths, overrides = split(arguments, ("run_dir", "resume", "force"))
    force = parse_flag("force", paths.pop("force", "false"))
    if "resume" in paths:
        if "run_dir" in paths:
            raise ConfigError("give only one of run_dir and resume")
        return _resume(Path(paths["resume"]), overrides, is_first, force)
    if force:
        raise ConfigError("force=true: must be used with resume=PATH")
    config = configs.compose(overrides)
    if "run_dir" not in paths:
        configs.run_settings(config)  # raises before a folder is created, as the next line
        configs.build(config)
        name = Path(_default_run_dir(config))
        run_dir = claim_folder(name) if is_first else name
        with removed_if_empty(run_dir.parent), removed_if_empty(run_dir):
            return _fit(config, run_dir, is_resumed=False, is_first=is_first)
    run_dir = Path(paths["run_dir"])
    if is_first and not is_vacant(run_dir):
        is_run = (run_dir / "config.yaml").exists()
        hint = f"resume it with resume={run_dir}, or choose another folder" if is_run else "choose another folder"
        raise ConfigError(f"run_dir: must be a new or empty folder, got {str(run_dir)!r}; {hint}")
    return _fit(config, run_dir, is_resumed=False, is_first=is_first)


def _resume(run_dir: Path, overrides: Sequence[str], is_first: bool, force: bool) -> int:
    overrides = substitute_imports(overrides)
    config = load_config(run_dir)
    pairs = configs.parse(overrides)
    changed = [f"{key}={value}" for key, value in pairs if key not in configs.LENGTHS and key in configs.flat(config)]
    if changed:
        new = command("jaxswarm-train", f"init_from={run_dir}", *changed)
        raise ConfigError(f"{changed[0]}: a resumed run keeps its settings; to train its policy with others: {new}")
    require_keys(pairs, lambda key: key in configs.LENGTHS, " or ".join(f"{name}=N" for name in configs.LENGTHS))
    extended = configs.override(config, pairs)
    if pairs:
        per_update = configs.build(config).agent_steps_per_update
        before, after = (configs.run_settings(x).length(per_update) for x in (config, extended))
        if after < before:
            key, value = pairs[0]
            raise ConfigError(f"{key}: must be at least {before} updates, got {value} ({after} updates)")
    return _fit(extended, run_dir, is_resumed=True, is_first=is_first, force=force)


def _fit(config: Config, run_dir: Path, is_resumed: bool, is_first: bool, force: bool = False) -> int:
    use_compile_cache()
    from jaxswarm.host import ensemble, estimate, signals, trained  # noqa: PLC0415
    from jaxswarm.host.checkpoint import CheckpointError  # noqa: PLC0415
    from jaxswarm.host.fit import DivergedError, fit_runs  # noqa: PLC0415
    from jaxswarm.host.run import Run  # noqa: PLC0415

    run = Run.from_config(config, run_dir)
    ensemble.use_cores(run.settings.num_seeds)
    estimate.check_training(run.experiment, run.settings.num_seeds, run.num_updates, warn)
    if not is_resumed:
        trained.require_warm_start(run.settings)
    print(_summary(config, run), flush=True)
    try:
        train_state, (rows,) = fit_runs([run], resume=is_resumed, force=force)
    except (DivergedError, CheckpointError) as error:
        print(f"error: {error}\n{_files(run_dir)}", file=sys.stderr)
        return 1
    update = int(train_state.update.max())
    if update < run.num_updates:
        hint = (
            f"resume with: {resume_command(run_dir)}" if (run_dir / "config.yaml").exists() else "nothing was written"
        )
        print(f"stopped after update {update} of {run.num_updates}; {hint}")
        return signals.exit_code()
    if is_first:
        print("writing the replay ...", flush=True)
        _write_replay(config, run, update)
    if rows:
        print(f"done: {update} updates, {_result(rows, 'warm start' if run.settings.init_from else 'untrained')}")
    print(f"{_files(run_dir)}\nnext: {command('jaxswarm-eval', str(run_dir), 'episodes=100')}")
    return 0


def _write_replay(config: Config, run: Any, update: int) -> None:
    """Write a replay of the final policy of the first seed."""
    from jaxswarm import render  # noqa: PLC0415

    found = restore_policies(run.folder, config, "last", run.seeds[:1])
    assert found
    render.write_replay(run.folder, run.experiment, render.of_seed(found.params, 0), update=update)


def _result(rows: Sequence[dict[str, Any]], start: str) -> str:
    """Format the last and the first evaluation return, and the mean training return between the last two evaluations.

    The training return is that of sampled actions. It is left out if no episode ended between these evaluations.
    """
    evaluation = f"evaluation return {_return_at(rows, -1)} ({start} {_return_at(rows, 0)})"
    training = _return_at(rows, -1, "train/return")
    return evaluation + (f", training return {training}" if training else "")


def _return_at(rows: Sequence[dict[str, Any]], index: int, name: str = "eval/return") -> str:
    """Format the return of an evaluation, or "" without one; for several seeds, the median and the quartiles."""
    import numpy as np  # noqa: PLC0415

    returns = [row.get(name, np.nan) for row in rows if row["update"] == rows[index]["update"]]
    returns = [x for x in returns if np.isfinite(x)]
    if not returns:
        return ""
    low, median, high = np.percentile(returns, [25, 50, 75])
    return f"{median:.2f}" if len(returns) == 1 else f"{median:.2f} [{low:.2f}, {high:.2f}] over {len(returns)} seeds"


def _default_run_dir(config: Config) -> str:
    names = "-".join(config[part]["name"] for part in ("task", "aggregator", "learner"))
    return f"runs/{names}-{time.strftime('%Y%m%d-%H%M%S')}"


def _summary(config: Config, run: Any) -> str:
    names = ", ".join(config[part]["name"] for part in ("task", "aggregator", "learner"))
    num_updates, per_update, seeds = run.num_updates, run.experiment.agent_steps_per_update, run.seeds
    seeds = f"seed {seeds[0]}" if len(seeds) == 1 else f"vectorized seeds {seeds[0]} to {seeds[-1]}"
    return (
        f"{names}: {run.experiment.task.num_agents} agents, {num_updates} updates of {per_update:,} agent steps "
        f"({num_updates * per_update:,} in total), {seeds}\nrun folder: {run.run_dir}"
    )


def _files(run_dir: Path) -> str:
    about = {
        "curve.png": "learning curve",
        "replay.html": "an episode of the final policy; open it in a browser",
        "metrics.csv": "a row per evaluation and seed",
        "checkpoints": "the latest and the best training state",
        "config.yaml": "all settings of the run",
        "manifest.json": "versions, device, exact numbers of steps",
    }
    return "\n".join(f"  {run_dir / name!s:<50} {text}" for name, text in about.items() if (run_dir / name).exists())
