"""The whole training loop as one compiled program: rollouts, updates and evaluations.

`train` is a pure function of an experiment and a state, without host callbacks, so that `jax.vmap` runs it over seeds
(states from several keys) and over every number of the experiment that fixes no shape.
"""

import dataclasses
import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxswarm import checks, rollout
from jaxswarm.checks import require
from jaxswarm.learners.on_policy import LearnerState, OnPolicy, batch_size
from jaxswarm.networks import ActorCritic
from jaxswarm.rollout import Environments, PolicyFn
from jaxswarm.types import Key, Metrics, pytree, static

MAX_SAMPLES = 2**31 - 1  # of one update: int32 numbers them


@pytree
class Experiment:
    """All that defines a run but its seed. One update takes `num_steps` steps in each of `num_envs` worlds.

    Every `eval_every` updates, before the update, the deterministic policy plays one episode in each of `num_eval_envs`
    separate worlds. With `desynchronized_start` each world begins at a random time of its first episode, so that
    worlds do not move in lockstep. `reset_pool` start states are drawn per world and update; `None`: as many as whole
    episodes begin in `num_steps`. Worlds of a task that ends early may need more; they use theirs again.
    """

    task: Any
    network: ActorCritic = static()
    learner: Any
    num_envs: int = static(default=32)
    num_steps: int = static(default=128)
    num_eval_envs: int = static(default=20)
    eval_every: int = static(default=5)
    desynchronized_start: bool = static(default=True)
    reset_pool: int | None = static(default=None)

    def __post_init__(self) -> None:
        for name, does in {"task": "reset", "network": "apply", "learner": "update"}.items():
            require(self, checks.Check(f"an object with `{does}`", lambda x, does=does: _has(x, does)), name)
        sizes = ("num_envs", "num_steps", "num_eval_envs", "eval_every")
        require(self, checks.integer(1), *sizes)
        require(self, checks.optional(checks.integer(1)), "reset_pool")
        require(self, checks.BOOL, "desynchronized_start")
        if self.agent_steps_per_update > MAX_SAMPLES:
            raise ValueError(
                f"num_envs * num_steps * num_agents: must be at most {MAX_SAMPLES}, got {self.agent_steps_per_update}"
            )
        task, network = type(self.task).__name__, self.network
        if isinstance(network, ActorCritic) and network.action_dim != self.task.action_dim:
            raise ValueError(f"action_dim: must be {self.task.action_dim} for {task}, got {network.action_dim}")
        if isinstance(self.learner, OnPolicy):
            batch_size(self.learner, self.agent_steps_per_update, self.task.num_agents)  # raises if it cannot be

    @property
    def num_start_states(self) -> int:
        """Drawn per world and update."""
        return self.reset_pool or math.ceil(self.num_steps / self.task.episode_length)

    @property
    def agent_steps_per_update(self) -> int:
        """Environment steps of all agents in one update."""
        return self.num_envs * self.num_steps * self.task.num_agents


def _has(part: Any, method: str) -> bool:
    return hasattr(part, method) and not isinstance(part, type)


@pytree
class TrainState:
    """All that changes during a run. Random numbers are functions of `key` and `update` alone."""

    update: Int[Array, ""]  # updates done
    key: Key
    learner: LearnerState
    envs: Environments
    is_finite: Bool[Array, ""]  # False: numbers stopped being finite in the update after these, and the state stays


@jax.jit
def init(experiment: Experiment, key: Key) -> TrainState:
    """State before the first update."""
    run_key, params_key, obs_key, envs_key = jax.random.split(key, 4)
    obs = experiment.task.observe(experiment.task.reset(obs_key))
    params = experiment.network.init(params_key, obs)
    envs = rollout.start(envs_key, experiment.task, experiment.num_envs, experiment.desynchronized_start)
    return TrainState(jnp.zeros((), jnp.int32), run_key, experiment.learner.init(params), envs, jnp.array(True))


@partial(jax.jit, static_argnames="num_updates")
def train(experiment: Experiment, train_state: TrainState, num_updates: int) -> tuple[TrainState, Metrics]:
    """`num_updates` updates; the metrics have one row per update, NaN in `eval/...` where no evaluation was due.

    Once a parameter, a loss or a return is not finite the state stays that before, and `is_finite` is 0 from there on.
    n calls with 1 update give the same bits as 1 call with n.
    """
    return train_chunk(experiment, train_state, num_updates, num_updates)


def train_chunk(
    experiment: Experiment, train_state: TrainState, num_updates: int | Int[Array, ""], size: int
) -> tuple[TrainState, Metrics]:
    """`train` for a number of updates that is not known when compiling, at most `size`; the other rows are NaN."""
    shapes = jax.eval_shape(_evaluate_and_update, experiment, train_state)[1]
    rows = {name: jnp.full((size,), jnp.nan) for name in shapes}

    def body(i: Array, carry: tuple[TrainState, Metrics]) -> tuple[TrainState, Metrics]:
        state, metrics = _evaluate_and_update(experiment, carry[0])
        return state, {name: carry[1][name].at[i].set(x) for name, x in metrics.items()}

    # A trip count that XLA knows would let it compile single updates in another way, with other rounding.
    num_updates = jax.lax.optimization_barrier(jnp.asarray(num_updates, jnp.int32))
    return jax.lax.fori_loop(0, num_updates, body, (train_state, rows))


@jax.jit
def evaluate(experiment: Experiment, train_state: TrainState) -> Metrics:
    """Evaluates the deterministic policy; the worlds depend on the number of updates done, not on the training."""
    key = jax.random.fold_in(_update_key(train_state), 0)
    policy = _policy(experiment, train_state.learner)
    metrics = rollout.evaluate(key, experiment.task, policy, experiment.num_eval_envs)
    return {f"eval/{name}": x for name, x in metrics.items()}


@jax.jit  # traced once, for its shapes and for the loop
def _evaluate_and_update(experiment: Experiment, state: TrainState) -> tuple[TrainState, Metrics]:
    is_due = state.update % experiment.eval_every == 0
    eval_metrics = _evaluate_if(is_due, experiment, state)
    rollout_key, learner_key = jax.random.split(jax.random.fold_in(_update_key(state), 1))
    envs, trajectory, train_metrics = rollout.collect(
        rollout_key,
        experiment.task,
        _policy(experiment, state.learner),
        state.envs,
        experiment.num_steps,
        experiment.num_start_states,
    )
    learner, learner_metrics = experiment.learner.update(
        learner_key, state.learner, experiment.network, experiment.task, trajectory
    )
    metrics = eval_metrics | {f"train/{name}": x for name, x in train_metrics.items()}
    metrics |= {f"learner/{name}": x for name, x in learner_metrics.items()}
    after = TrainState(state.update + 1, state.key, learner, envs, state.is_finite)
    is_finite = state.is_finite & _are_finite(learner.params, metrics)
    is_finite &= jnp.isfinite(metrics["eval/return"]) | ~is_due
    kept = jax.tree.map(lambda a, b: jnp.where(is_finite, a, b), after, state)
    return dataclasses.replace(kept, is_finite=is_finite), metrics | {"is_finite": is_finite.astype(jnp.float32)}


def _are_finite(params: Any, metrics: Metrics) -> Bool[Array, ""]:
    """Parameters and losses."""
    losses = {name: x for name, x in metrics.items() if is_loss(name)}
    checks = jax.tree.map(lambda x: jnp.isfinite(x).all(), (params, losses))
    return jax.tree.reduce(jnp.logical_and, checks)


def is_loss(name: str) -> bool:
    """Whether the metric of this name has to be finite at every update."""
    return name.startswith("learner/") and "loss" in name


def _evaluate_if(is_due: Bool[Array, ""], experiment: Experiment, state: TrainState) -> Metrics:
    """Evaluates, or gives NaN. A loop of at most one pass, because `vmap` would turn a `cond` into doing both."""
    shapes = jax.eval_shape(evaluate, experiment, state)
    skipped = jax.tree.map(lambda x: jnp.full(x.shape, jnp.nan, x.dtype), shapes)

    def body(_: tuple) -> tuple[Array, Metrics]:
        return jnp.zeros((), bool), evaluate(experiment, state)

    return jax.lax.while_loop(lambda carry: carry[0], body, (is_due, skipped))[1]


def _update_key(state: TrainState) -> Key:
    return jax.random.fold_in(state.key, state.update)


def _policy(experiment: Experiment, learner: LearnerState) -> PolicyFn:
    return partial(experiment.network.apply, learner.params, method="policy")
