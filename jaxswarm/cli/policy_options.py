"""Shared options of the programs that use trained policies: checkpoint, seed, and changes of the task."""

import functools
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxswarm import config as configs
from jaxswarm.cli.program import load_config, parse_integer
from jaxswarm.config import Config, ConfigError


def which_checkpoint(options: Mapping[str, str]) -> Any:
    """Return the option `checkpoint`, "best" by default. Raise a `ConfigError` for other values than best and last."""
    which = options.get("checkpoint", "best")
    if which not in ("best", "last"):
        raise ConfigError(f"checkpoint: must be one of best, last, got {which!r}")
    return which


def which_seeds(options: Mapping[str, str], config: Config) -> list[int]:
    """Return the seed of the option `train_seed`, or all trained seeds by default."""
    trained = configs.run_settings(config).seeds
    if "train_seed" not in options:
        return list(trained)
    seed = parse_integer("train_seed", options["train_seed"], 0)
    if seed not in trained:
        raise ConfigError(f"train_seed: must be one of the trained seeds {trained[0]} to {trained[-1]}, got {seed}")
    return [seed]


def restore_policies(run_dir: Path, config: Config, which: Any, seeds: Sequence[int]) -> Any:
    """Return the `trained.TrainedPolicies` of these seeds.

    Returns `None` if no checkpoint can be restored; the error has been printed then.
    """
    from jaxswarm.host import trained  # noqa: PLC0415
    from jaxswarm.host.checkpoint import CheckpointError  # noqa: PLC0415

    warn = functools.partial(print, file=sys.stderr)
    try:
        found = trained.load_policies(run_dir, config, which, seeds, warn)
    except CheckpointError as error:
        warn(f"error: {error}")
        return None
    for seed, reason in found.diverged.items():
        warn(f"warning: seed {seed} diverged, and its last finite policy is used: {reason}")
    return found


def require_fit(policies: Any, task: Any) -> None:
    """Raise a `ConfigError` if the observations of this task do not fit the policies."""
    import jax  # noqa: PLC0415

    key, network = jax.random.key(0), policies.experiment.network
    needed = jax.eval_shape(lambda: network.init(key, task.observe(task.reset(key))))
    if jax.tree.map(lambda x: x.shape, needed) != jax.tree.map(lambda x: x.shape[1:], policies.params):
        raise ConfigError("the policy cannot be used on this task: it was trained with observations of other sizes")


def policy_on_task(
    run_dir: Path, pairs: Sequence[tuple[str, Any]], options: Mapping[str, str]
) -> tuple[Any, Any, Any, int] | None:
    """Return the task with these changes, and a policy: (task, network, parameters, number of updates).

    The policy is that of the option `train_seed`, or of the first seed by default. Returns `None` if no checkpoint can
    be restored; the error has been printed then.
    """
    config = load_config(run_dir)
    task = configs.build_part("task", configs.override(config, pairs))
    from jaxswarm.host import estimate  # noqa: PLC0415

    estimate.check_episodes(task)
    trained = which_seeds(options, config)[:1]
    policies = restore_policies(run_dir, config, which_checkpoint(options), trained)
    if policies is None:
        return None
    require_fit(policies, task)
    from jaxswarm.render import of_seed  # noqa: PLC0415

    return task, policies.experiment.network, of_seed(policies.params, 0), policies.update
