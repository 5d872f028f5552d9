"""The program `jaxswarm-eval`."""

import functools
import json
import math
import textwrap
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxswarm import config as configs
from jaxswarm.cli.policy_options import require_fit, restore_policies, which_checkpoint, which_seeds
from jaxswarm.cli.program import (
    load_config,
    parse_integer,
    program,
    require_task_keys,
    split_paths,
    use_compile_cache,
    wants_help,
)
from jaxswarm.config import Config, ConfigError

HELP = """\
jaxswarm-eval PATH [key=value ...] [task.KEY=VALUE[,VALUE...] ...]

Evaluates the trained policy of a run folder, prints a table, and writes all results as JSON into the folder. The action
is the mean of the policy. Each episode has its own start state. If the run has several seeds, the policies of all seeds
are evaluated. The table shows means over the seeds, and the file also contains the values of each seed. If a setting
differs on which the scale of the return depends, such as task.visibility_radius, one line reports it and the table
begins with a metric that does not depend on it.

options
  PATH                Run folder. Required.
  episodes=N          Number of episodes of each policy. Integer >= 1, default: num_eval_envs of the run.
  seed=N              Seed of the episodes. Integer >= 0, default: 0.
  checkpoint=NAME     Checkpoint: best or last, default: best. The best one has the highest mean return over the seeds.
  train_seed=N        Evaluate only the policy of this seed of the run. Integer, default: all seeds.
  task.KEY=VALUE,...  Change a field of the task. Several values evaluate the policy on each of them. The type is that
                      of the field, default: the task of the run.

examples
  jaxswarm-eval runs/thesis
  jaxswarm-eval runs/thesis episodes=100 checkpoint=last task.num_agents=5,10,20,50,100,200
"""
OPTIONS = ("checkpoint", "episodes", "seed", "train_seed")


@program
def main(arguments: Sequence[str]) -> int:
    """Evaluate the policy of a run; return the exit code."""
    if wants_help(arguments) or not arguments:
        print(HELP)
        return 0 if arguments else 2
    paths, options, overrides = split_paths(arguments, OPTIONS)
    if len(paths) != 1:
        raise ConfigError(f"give one run folder, got {len(paths)}: jaxswarm-eval PATH [key=value ...]")
    which = which_checkpoint(options)
    config = load_config(paths[0])
    episodes = parse_integer("episodes", options.get("episodes", config["num_eval_envs"]), 1)
    seed = parse_integer("seed", options.get("seed", 0), 0)
    changes = configs.combinations(overrides)
    require_task_keys(changes[0], config, OPTIONS)
    request = {"which": which, "seed": seed, "episodes": episodes, "train_seeds": which_seeds(options, config)}
    result = _evaluate(paths[0], config, changes, request)
    return _report(paths[0], result) if result else 1


def _evaluate(
    run_dir: Path, config: Config, changes: Sequence[Sequence[tuple[str, Any]]], request: dict[str, Any]
) -> dict[str, Any] | None:
    """Evaluate the policies on every changed task.

    Returns `None` if no checkpoint can be restored; the error has been printed then.
    """
    tasks = [configs.override(config, pairs)["task"] for pairs in changes]
    built = [configs.build_part("task", {"task": task}) for task in tasks]
    use_compile_cache()
    from jaxswarm.host import estimate  # noqa: PLC0415

    for task in built:
        estimate.check_episodes(task, request["episodes"])
    policies = restore_policies(run_dir, config, request["which"], request["train_seeds"])
    if policies is None:
        return None
    for task in built:
        require_fit(policies, task)
    import jax  # noqa: PLC0415
    import numpy as np  # noqa: PLC0415

    from jaxswarm import rollout  # noqa: PLC0415

    key = jax.random.key(request["seed"])

    @jax.jit
    def play(params: Any, task: Any) -> dict[str, Any]:
        def episodes(params: Any) -> dict[str, Any]:
            policy: Any = functools.partial(policies.experiment.network.apply, params, method="policy")
            return rollout.evaluate(key, task, policy, request["episodes"])

        return jax.lax.map(episodes, params)

    results = []
    for pairs, config_of_task, task in zip(changes, tasks, built, strict=True):
        metrics = {name: np.asarray(x, np.float64) for name, x in play(policies.params, task).items()}
        means = {name: _mean(x) for name, x in metrics.items()}
        of_seeds = {name: [_number(x) for x in values.tolist()] for name, values in metrics.items()}
        results.append({"changed": dict(pairs), "task": config_of_task, "metrics": means, "of_each_seed": of_seeds})
    found = {"update": policies.update, "score_in_training": policies.score, "device": jax.devices()[0].device_kind}
    return request | found | {"results": results}


def _number(value: float) -> float | None:
    """Return `None` for NaN and infinity, which JSON cannot represent."""
    return value if math.isfinite(value) else None


def _mean(values: Any) -> float | None:
    """Return the mean of the finite values; `None` if there are none."""
    finite = [x for x in values.tolist() if math.isfinite(x)]
    return math.fsum(finite) / len(finite) if finite else None


def _report(run_dir: Path, result: dict[str, Any]) -> int:
    from jaxswarm.analysis.comparability import compare  # noqa: PLC0415
    from jaxswarm.files import replace_text  # noqa: PLC0415

    name = f"eval-{result['which']}-{time.strftime('%Y%m%d-%H%M%S')}"
    while (path := run_dir / f"{name}.json").exists():
        name += "x"
    num_seeds = len(result["train_seeds"])
    seeds = f" of each of {num_seeds} seeds; means over seeds" if num_seeds > 1 else ""
    checkpoint = f"{result['which']} checkpoint, after update {result['update']}"
    print(f"{run_dir}: {checkpoint}; {result['episodes']} episodes{seeds}")
    comparison = compare([one["task"] for one in result["results"]])
    if comparison.settings:
        print(comparison.explain())
    print(_table(result["results"], comparison.metric))
    replace_text(path, json.dumps(result, indent=2, allow_nan=False) + "\n")
    print(f"wrote {path}")
    return 0


def _table(results: Sequence[dict[str, Any]], first: str) -> str:
    """Format a table with a row for each metric, `first` and returns at the top, and a column for each changed task."""
    from jaxswarm.analysis import summaries  # noqa: PLC0415

    metrics = sorted(results[0]["metrics"], key=lambda name: (name != first, not name.startswith("return")))
    rows = [[key, *[str(result["changed"][key]) for result in results]] for key in results[0]["changed"]]
    rows += [[name, *[_cell(result["metrics"][name]) for result in results]] for name in metrics]
    return textwrap.indent(summaries.aligned(rows), "  ")


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"
