"""The program `jaxswarm-eval`."""

import functools
import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxswarm import config as configs
from jaxswarm.cli.policy_options import load_policies, require_fit, which_checkpoint, which_seeds
from jaxswarm.cli.program import load, only_of_task, program, split_paths, use_compile_cache, wants_help, whole
from jaxswarm.config import Config, ConfigError

HELP = """\
jaxswarm-eval PATH [episodes=N] [seed=N] [checkpoint=best|last] [train_seed=N] [task.key=value[,value...]] ...

Evaluates the trained policy of a run folder, also on changed tasks: prints a table and writes JSON into the folder.
The action is the mean of the policy; each episode is played in a world of its own. Of a run with several seeds all
policies are evaluated, or that of train_seed; the table has means over them, the file has each. The best checkpoint is
that with the highest mean return over the seeds.

examples
  jaxswarm-eval runs/thesis
  jaxswarm-eval runs/thesis episodes=100 checkpoint=last task.num_agents=5,10,20,50,100,200
"""
OPTIONS = ("checkpoint", "episodes", "seed", "train_seed")


@program
def main(arguments: Sequence[str]) -> int:
    """Evaluates the policy of a run; returns the exit code."""
    if wants_help(arguments) or not arguments:
        print(HELP)
        return 0 if arguments else 2
    paths, options, overrides = split_paths(arguments, OPTIONS)
    if len(paths) != 1:
        raise ConfigError(f"give one run folder, not {len(paths)}: jaxswarm-eval PATH [key=value ...]")
    which = which_checkpoint(options)
    config = load(paths[0])
    episodes = whole("episodes", options.get("episodes", config["num_eval_envs"]), 1)
    seed = whole("seed", options.get("seed", 0), 0)
    changes = configs.combinations(overrides)
    only_of_task(changes[0], config, OPTIONS)
    asked = {"which": which, "seed": seed, "episodes": episodes, "train_seeds": which_seeds(options, config)}
    result = _evaluate(paths[0], config, changes, asked)
    return _report(paths[0], result) if result else 1


def _evaluate(
    run_dir: Path, config: Config, changes: Sequence[Sequence[tuple[str, Any]]], asked: dict[str, Any]
) -> dict[str, Any] | None:
    """Plays the episodes of every changed task; `None` after saying that no checkpoint can be restored."""
    tasks = [configs.override(config, pairs)["task"] for pairs in changes]
    built = [configs.build_part("task", {"task": task}) for task in tasks]
    use_compile_cache()
    policies = load_policies(run_dir, config, asked["which"], asked["train_seeds"])
    if policies is None:
        return None
    for task in built:
        require_fit(policies, task)
    import jax  # noqa: PLC0415
    import numpy as np  # noqa: PLC0415

    from jaxswarm import rollout  # noqa: PLC0415

    key = jax.random.key(asked["seed"])

    @jax.jit
    def play(params: Any, task: Any) -> dict[str, Any]:
        def episodes(params: Any) -> dict[str, Any]:
            policy: Any = functools.partial(policies.experiment.network.apply, params, method="policy")
            return rollout.evaluate(key, task, policy, asked["episodes"])

        return jax.lax.map(episodes, params)

    results = []
    for pairs, task, with_leaves in zip(changes, tasks, built, strict=True):
        of_seeds = {name: np.asarray(x, np.float64) for name, x in play(policies.params, with_leaves).items()}
        means = {name: _mean(x) for name, x in of_seeds.items()}
        each = {name: [_number(x) for x in values.tolist()] for name, values in of_seeds.items()}
        results.append({"changed": dict(pairs), "task": task, "metrics": means, "of_each_seed": each})
    found = {"update": policies.update, "score_in_training": policies.score, "device": jax.devices()[0].device_kind}
    return asked | found | {"results": results}


def _number(value: float) -> float | None:
    """`None`, which JSON has a word for, in place of NaN."""
    return value if math.isfinite(value) else None


def _mean(values: Any) -> float | None:
    """Of those that are numbers."""
    finite = [x for x in values.tolist() if math.isfinite(x)]
    return math.fsum(finite) / len(finite) if finite else None


def _report(run_dir: Path, result: dict[str, Any]) -> int:
    from jaxswarm.files import replace_text  # noqa: PLC0415

    name = f"eval-{result['which']}-{time.strftime('%Y%m%d-%H%M%S')}"
    while (path := run_dir / f"{name}.json").exists():
        name += "x"
    num_seeds = len(result["train_seeds"])
    seeds = f" of each of {num_seeds} seeds; means" if num_seeds > 1 else ""
    print(
        f"{run_dir}: {result['which']} checkpoint, of update {result['update']}; {result['episodes']} episodes{seeds}"
    )
    print(_table(result["results"]))
    replace_text(path, json.dumps(result, indent=2, allow_nan=False) + "\n")
    print(f"wrote {path}")
    return 0


def _table(results: Sequence[dict[str, Any]]) -> str:
    """A row per metric, returns first; a column per changed task."""
    metrics = sorted(results[0]["metrics"], key=lambda name: not name.startswith("return"))
    rows = [[key, *[str(result["changed"][key]) for result in results]] for key in results[0]["changed"]]
    rows += [[name, *[_cell(result["metrics"][name]) for result in results]] for name in metrics]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    cells = [[x.rjust(width) for x, width in zip(row, widths, strict=True)] for row in rows]
    return "\n".join("  ".join(["", row[0].ljust(widths[0]), *line[1:]]) for row, line in zip(rows, cells, strict=True))


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"
