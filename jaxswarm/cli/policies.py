"""Trained policies, for the programs that use them: read from run folders, and fitted to tasks."""

import functools
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxswarm import config as configs
from jaxswarm.cli.words import resume_command, whole
from jaxswarm.config import Config, ConfigError


class Policies(NamedTuple):
    """A network with parameters from several seeds, and where in a run these come from."""

    network: Any
    params: Any  # leaves [seeds, ...]
    update: int
    score: float | None  # mean evaluation return in training, if they were evaluated


def which_checkpoint(options: Mapping[str, str]) -> Any:
    """What the option `checkpoint` asks for, `best` by default."""
    which = options.get("checkpoint", "best")
    if which not in ("best", "last"):
        raise ConfigError(f"checkpoint = {which!r} is not possible; accepted: best, last")
    return which


def which_seeds(options: Mapping[str, str], config: Config) -> list[int]:
    """Those that the option `train_seed` asks for: one, or by default all that were trained."""
    trained = configs.run_settings(config).seeds
    if "train_seed" not in options:
        return list(trained)
    seed = whole("train_seed", options["train_seed"], 0)
    if seed not in trained:
        raise ConfigError(f"train_seed = {seed} is not possible; accepted: {trained[0]} to {trained[-1]}")
    return [seed]


def load_policies(run_dir: Path, config: Config, which: Any, seeds: Sequence[int]) -> Policies | None:
    """The policies of these seeds from a run folder; `None` after saying that no checkpoint can be restored."""
    experiment, trained = configs.build(config), configs.run_settings(config).seeds
    import jax  # noqa: PLC0415
    import numpy as np  # noqa: PLC0415

    from jaxswarm.checkpoint import CheckpointError, restore  # noqa: PLC0415
    from jaxswarm.fit import abstract_state  # noqa: PLC0415

    warn = functools.partial(print, file=sys.stderr)
    try:
        restored = restore(run_dir / "checkpoints", abstract_state(experiment, len(trained)), which, warn)
    except CheckpointError as error:
        warn(f"error: {error}")
        return None
    if restored is None:
        raise ConfigError(f"{run_dir} has no checkpoint yet; continue it with: {resume_command(run_dir)}")
    for seed, reason in restored.record.get("diverged", {}).items():
        if int(seed) in seeds:
            warn(f"warning: seed {seed} diverged, its policy is the one before: {reason}")
    wanted = np.array([trained.index(seed) for seed in seeds])
    params = jax.tree.map(lambda x: x[wanted], restored.train_state.learner.params)
    return Policies(experiment.network, params, restored.update, restored.score)


def require_fit(policies: Policies, task: Any) -> None:
    """Raises a `ConfigError` if the policies cannot read what agents of this task perceive."""
    import jax  # noqa: PLC0415

    key = jax.random.key(0)
    needed = jax.eval_shape(lambda: policies.network.init(key, task.observe(task.reset(key))))
    if jax.tree.map(lambda x: x.shape, needed) != jax.tree.map(lambda x: x.shape[1:], policies.params):
        raise ConfigError("the policy cannot be used on this task: it was trained with observations of other sizes")
