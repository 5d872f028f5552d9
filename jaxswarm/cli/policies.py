"""Trained policies, for the programs that use them: read from run folders, and fitted to tasks."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jaxswarm import config as configs
from jaxswarm.cli.words import resume_command
from jaxswarm.config import Config, ConfigError


class Policy(NamedTuple):
    """A network with its parameters, and where in a run these come from."""

    network: Any
    params: Any
    update: int
    score: float | None  # mean evaluation return in training, if it was evaluated


def which_checkpoint(options: Mapping[str, str]) -> Any:
    """What the option `checkpoint` asks for, `best` by default."""
    which = options.get("checkpoint", "best")
    if which not in ("best", "last"):
        raise ConfigError(f"checkpoint = {which!r} is not possible; accepted: best, last")
    return which


def load_policy(run_dir: Path, config: Config, which: Any) -> Policy | None:
    """The policy of a run folder; `None` after saying that no checkpoint can be restored."""
    experiment = configs.build(config)
    from jaxswarm.checkpoint import CheckpointError, restore  # noqa: PLC0415
    from jaxswarm.fit import abstract_state  # noqa: PLC0415

    def warn(text: str) -> None:
        print(text, file=sys.stderr)

    try:
        restored = restore(run_dir / "checkpoints", abstract_state(experiment), which, warn)
    except CheckpointError as error:
        warn(f"error: {error}")
        return None
    if restored is None:
        raise ConfigError(f"{run_dir} has no checkpoint yet; continue it with: {resume_command(run_dir)}")
    return Policy(experiment.network, restored.train_state.learner.params, restored.update, restored.score)


def require_fit(policy: Policy, task: Any) -> None:
    """Raises a `ConfigError` if the policy cannot read what agents of this task perceive."""
    import jax  # noqa: PLC0415

    key = jax.random.key(0)
    needed = jax.eval_shape(lambda: policy.network.init(key, task.observe(task.reset(key))))
    if jax.tree.map(lambda x: x.shape, needed) != jax.tree.map(lambda x: x.shape, policy.params):
        raise ConfigError("the policy cannot be used on this task: it was trained with observations of other sizes")
