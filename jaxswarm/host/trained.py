"""Trained policies, read from run folders: networks and their parameters, without all else that a run goes on with."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from jaxswarm import config as configs
from jaxswarm.config import Config, ConfigError
from jaxswarm.host.checkpoint import restore
from jaxswarm.host.fit import abstract_state
from jaxswarm.host.recorder import has_checkpoint
from jaxswarm.training import Experiment


class Policies(NamedTuple):
    """An experiment with the parameters that several seeds of it have come to, and where in the run that was."""

    experiment: Experiment
    params: Any  # leaves [seeds, ...]
    update: int
    score: float | None  # mean evaluation return in training, if they were evaluated
    diverged: dict[int, str]  # reasons, of those of the seeds that have


def load(
    run_dir: str | Path, which: Literal["best", "last"] = "best", seed: int | None = None
) -> tuple[Experiment, Any]:
    """The experiment of a run folder and the parameters of its policy, of one seed (`None`: the first).

    Of several seeds that were trained side by side, "best" is where the mean of their returns was highest.

        experiment, params = jaxswarm.load("runs/NAME")
        distribution = experiment.network.apply(params, experiment.task.observe(state), method="policy")

    Raises `ConfigError` for what is no run folder, has no checkpoint or not this seed, and `CheckpointError` where no
    checkpoint can be restored. Skips damaged ones, and says so.
    """
    config = configs.load(Path(run_dir) / "config.yaml")
    trained = configs.run_settings(config).seeds
    policies = read(Path(run_dir), config, which, trained[:1] if seed is None else [seed])
    return policies.experiment, jax.tree.map(lambda x: x[0], policies.params)


def warm_start(settings: configs.RunSettings, run_dir: Path) -> Any:
    """The parameters that `init_from` asks for; `None` without it, or where the run folder has a checkpoint.

    Errors are those of `load`.
    """
    if settings.init_from is None or has_checkpoint(run_dir):
        return None
    if not (Path(settings.init_from) / "config.yaml").is_file():
        raise ConfigError(f"init_from: must be a run folder, got {settings.init_from!r}")
    return load(settings.init_from)[1]


def read(
    run_dir: Path,
    config: Config,
    which: Literal["best", "last"],
    seeds: Sequence[int],
    warn: Callable[[str], Any] = print,
) -> Policies:
    """The policies of these seeds from the run folder with this config; errors are those of `load`."""
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
    return Policies(experiment, params, restored.update, restored.score, diverged)
