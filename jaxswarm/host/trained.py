"""Trained policies, read from run folders: networks and their parameters, without the rest of the training state."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from jaxswarm import config as configs
from jaxswarm.config import Config, ConfigError, RunSettings, plugins
from jaxswarm.host.checkpoint import restore
from jaxswarm.host.ensemble import abstract_state
from jaxswarm.host.run import has_checkpoint, load_config
from jaxswarm.training import Experiment

MAX_NAMED = 4  # arrays that a message about shapes lists


class TrainedPolicies(NamedTuple):
    """The policies of several seeds of an experiment, and the update that they were saved at."""

    experiment: Experiment
    params: Any  # leaves [seeds, ...]
    update: int
    score: float | None  # mean evaluation return during training; `None`: this update was not evaluated
    diverged: dict[int, str]  # reasons, for those of the seeds that have diverged


def load(
    run_dir: str | Path, which: Literal["best", "last"] = "best", seed: int | None = None, *, trust: bool = False
) -> tuple[Experiment, Any]:
    """Load the experiment of a run folder and the parameters of its policy, of one seed (`None`: the first).

    If a run has several seeds, "best" is the update at which the mean of their returns was highest.

        experiment, params = jaxswarm.load("runs/NAME")
        distribution = experiment.network.apply(params, experiment.task.observe(state), method="policy")

    The folder's copies of your `imports` are executed if you have trained with the same code on this machine. With
    `trust`, code of others is executed, too.

    Raises a `ConfigError` if the folder is no run folder, would execute code of others, has no checkpoint or not this
    seed, and a `CheckpointError` if no checkpoint can be restored. Damaged checkpoints are skipped, and each is
    reported with one line.
    """
    with plugins.trusting(trust):
        config = load_config(Path(run_dir))
    seeds = configs.run_settings(config).seeds
    policies = load_policies(Path(run_dir), config, which, seeds[:1] if seed is None else [seed])
    return policies.experiment, jax.tree.map(lambda x: x[0], policies.params)


def warm_start(settings: RunSettings, run_dir: Path) -> Any:
    """Load the parameters that `init_from` names; `None` without it, or if the run folder has a checkpoint.

    Raises the errors of `load`.
    """
    if settings.init_from is None or has_checkpoint(run_dir):
        return None
    require_warm_start(settings)
    return load(settings.init_from)[1]


def require_warm_start(settings: RunSettings) -> None:
    """Raise a `ConfigError` if `init_from` is set and no run folder."""
    if settings.init_from is not None and not (Path(settings.init_from) / "config.yaml").is_file():
        raise ConfigError(f"init_from: must be a run folder, got {settings.init_from!r}")


def check_params(params: Any, needed: Any, init_from: str | None) -> None:
    """Raise a `ConfigError` that lists the arrays whose shapes differ from the needed ones.

    `init_from` is the run folder that the parameters are from; `None`: they are the argument `init_params` of `fit`.
    """
    given, wanted = _shapes_by_name(params), _shapes_by_name(needed)
    names = [name for name in {**wanted, **given} if given.get(name) != wanted.get(name)]
    if not names:
        return
    shown = [f"{name} is {given.get(name, 'missing')}, needed {wanted.get(name, 'no such array')}" for name in names]
    more = f" and {len(shown) - MAX_NAMED} more" if len(shown) > MAX_NAMED else ""
    source = "init_params" if init_from is None else f"init_from={init_from}"
    raise ConfigError(
        f"{source}: must have the parameter shapes of this network, but {'; '.join(shown[:MAX_NAMED])}{more}; "
        "train the warm start with the same network, observation features and actions"
    )


def _shapes_by_name(params: Any) -> dict[str, tuple[int, ...]]:
    leaves = jax.tree.leaves_with_path(params)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): np.shape(x) for path, x in leaves}


def load_policies(
    run_dir: Path,
    config: Config,
    which: Literal["best", "last"],
    seeds: Sequence[int],
    warn: Callable[[str], Any] = print,
) -> TrainedPolicies:
    """Load the policies of these seeds from the run folder with this config; raises the errors of `load`."""
    experiment, trained = configs.build(config), configs.run_settings(config).seeds
    missing = [seed for seed in seeds if seed not in trained]
    if missing:
        raise ConfigError(f"seed: must be one of the trained seeds {trained[0]} to {trained[-1]}, got {missing[0]}")
    template = {"learner": {"params": abstract_state(experiment, len(trained)).learner.params}}
    restored = restore(run_dir / "checkpoints", template, which, warn)
    if restored is None:
        raise ConfigError(f"{run_dir} has no checkpoint yet; continue it with: jaxswarm-train resume={run_dir}")
    wanted = np.array([trained.index(seed) for seed in seeds])
    params = jax.tree.map(lambda x: x[wanted], restored.train_state["learner"]["params"])
    diverged = {int(seed): reason for seed, reason in restored.record.get("diverged", {}).items() if int(seed) in seeds}
    return TrainedPolicies(experiment, params, restored.update, restored.score, diverged)
