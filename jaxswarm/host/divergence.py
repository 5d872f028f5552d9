"""Updates that diverge: the state before such an update is saved, and the update can be replayed.

All random numbers are functions of this state, so a replay on the same machine gives the same batch and the same bits.
"""

import contextlib
import dataclasses
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxswarm import config as configs
from jaxswarm import files, rollout, training
from jaxswarm.host.checkpoint import CheckpointError, Checkpoints, restore
from jaxswarm.host.ensemble import abstract_state
from jaxswarm.host.run import Run, load_config
from jaxswarm.training import Experiment, TrainState
from jaxswarm.types import Metrics


class Replay(NamedTuple):
    """A replayed update."""

    experiment: Experiment
    state: TrainState  # before the update
    trajectory: rollout.Trajectory  # batch of the update, leaves [steps, envs, ...]
    metrics: Metrics  # of the update
    first: str  # what became non-finite first: "evaluation", "observation", "reward", "loss", "gradient", "parameter"


def save(run: Run, seed: int, state: TrainState) -> Path:
    """Save the frozen state of a seed that has diverged, leaves [1, ...], as `diverged/seed<n>`; return the folder."""
    folder = run.folder / "diverged" / f"seed{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    if run.config is not None:
        config = dict(run.config) | {"seed": seed, "num_seeds": 1}
        files.replace_text(folder / "config.yaml", configs.dump(config))
    with contextlib.closing(Checkpoints(folder / "checkpoints")) as checkpoints:
        checkpoints.save(int(state.update[0]), state, {}, None)
    return folder


def replay_update(folder: str | Path, experiment: Experiment | None = None) -> Replay:
    """Replay the update that diverged, and find what became non-finite first, in the order of computation.

    `folder` is `RUN/diverged/seed<n>`. The `experiment` is needed only if the run has no config. Raises a `ConfigError`
    if the folder has no config, and a `CheckpointError` if the state cannot be restored.
    """
    folder = Path(folder)
    experiment = experiment or configs.build(load_config(folder))
    restored = restore(folder / "checkpoints", abstract_state(experiment))
    if restored is None:
        raise CheckpointError(f"{folder} holds no state of an update that diverged")
    state = jax.tree.map(lambda x: x[0], restored.train_state)
    state = dataclasses.replace(state, is_finite=jax.numpy.array(True))
    trajectory = _trajectory(experiment, state)
    _, metrics = training.train(experiment, state, 1)
    metrics = {name: x[0] for name, x in metrics.items()}
    return Replay(experiment, state, trajectory, metrics, _first(experiment, trajectory, metrics))


@jax.jit
def _trajectory(experiment: Experiment, state: TrainState) -> rollout.Trajectory:
    key, _ = training.update_keys(state)
    policy = partial(experiment.network.apply, state.learner.params, method="policy")
    sizes = (experiment.num_steps, experiment.num_start_states)
    return rollout.collect(key, experiment.task, policy, state.envs, *sizes)[1]


def _first(experiment: Experiment, trajectory: rollout.Trajectory, metrics: Metrics) -> str:
    obs = jax.vmap(jax.vmap(experiment.task.observe))(trajectory.state)
    steps = {"observation": _first_step(obs), "reward": _first_step(trajectory.reward)}
    losses = [x for name, x in metrics.items() if training.is_loss(name)]
    if min(steps.values()) < experiment.num_steps:
        return min(steps, key=lambda name: steps[name])
    if not np.isfinite(losses).all():
        return "loss"
    if not np.isfinite(metrics.get("learner/gradient_norm", 0.0)):
        return "gradient"
    return "parameter" if np.isnan(metrics["eval/return"]) or np.isfinite(metrics["eval/return"]) else "evaluation"


def _first_step(tree: Any) -> float:
    """Return the first step at which a number is not finite, leaves [steps, ...]; infinity without one."""
    wrong = [~np.isfinite(np.asarray(x)) for x in jax.tree.leaves(tree) if np.issubdtype(x.dtype, np.floating)]
    steps = [np.flatnonzero(x.reshape(len(x), -1).any(1)) for x in wrong]
    return float(min((found[0] for found in steps if found.size), default=np.inf))
