"""What the programs that use trained policies have in common: which ones are asked for, and whether they fit a task."""

import functools
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxswarm import config as configs
from jaxswarm.cli.program import load, whole
from jaxswarm.config import Config, ConfigError


def which_checkpoint(options: Mapping[str, str]) -> Any:
    """What the option `checkpoint` asks for, `best` by default."""
    which = options.get("checkpoint", "best")
    if which not in ("best", "last"):
        raise ConfigError(f"checkpoint: must be one of best, last, got {which!r}")
    return which


def which_seeds(options: Mapping[str, str], config: Config) -> list[int]:
    """Those that the option `train_seed` asks for: one, or by default all that were trained."""
    trained = configs.run_settings(config).seeds
    if "train_seed" not in options:
        return list(trained)
    seed = whole("train_seed", options["train_seed"], 0)
    if seed not in trained:
        raise ConfigError(f"train_seed: must be one of the trained seeds {trained[0]} to {trained[-1]}, got {seed}")
    return [seed]


def load_policies(run_dir: Path, config: Config, which: Any, seeds: Sequence[int]) -> Any:
    """The `policies.Policies` of these seeds; `None` after saying that no checkpoint can be restored."""
    from jaxswarm.host import trained as policies  # noqa: PLC0415
    from jaxswarm.host.checkpoint import CheckpointError  # noqa: PLC0415

    warn = functools.partial(print, file=sys.stderr)
    try:
        found = policies.read(run_dir, config, which, seeds, warn)
    except CheckpointError as error:
        warn(f"error: {error}")
        return None
    for seed, reason in found.diverged.items():
        warn(f"warning: seed {seed} diverged, its policy is the one before: {reason}")
    return found


def require_fit(policies: Any, task: Any) -> None:
    """Raises a `ConfigError` if the policies cannot read what agents of this task perceive."""
    import jax  # noqa: PLC0415

    key, network = jax.random.key(0), policies.experiment.network
    needed = jax.eval_shape(lambda: network.init(key, task.observe(task.reset(key))))
    if jax.tree.map(lambda x: x.shape, needed) != jax.tree.map(lambda x: x.shape[1:], policies.params):
        raise ConfigError("the policy cannot be used on this task: it was trained with observations of other sizes")


def policy_on_task(
    run_dir: Path, pairs: Sequence[tuple[str, Any]], options: Mapping[str, str]
) -> tuple[Any, Any, Any, int] | None:
    """The task with these changes, and a policy for it: network, parameters, and after which update.

    Of a run with several seeds it is the policy of the first, or of the option `train_seed`. `None` after saying that
    no checkpoint can be restored.
    """
    config = load(run_dir)
    task = configs.build_part("task", configs.override(config, pairs))
    trained = which_seeds(options, config)[:1]
    policies = load_policies(run_dir, config, which_checkpoint(options), trained)
    if policies is None:
        return None
    require_fit(policies, task)
    from jaxswarm.render import of_seed  # noqa: PLC0415

    return task, policies.experiment.network, of_seed(policies.params, 0), policies.update
