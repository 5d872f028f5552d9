"""The whole training loop as a single compiled program: rollouts, updates and evaluations.

`train` is a pure function of an experiment and a state, without host callbacks. Therefore `jax.vmap` runs it over seeds
(states from several keys) and over every numeric (traced) hyperparameter of the experiment.
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

MAX_SAMPLES = 2**31 - 1  # of one update, whose samples are numbered by int32


@pytree
class Experiment:
    """A training run without seed and length: task, network, learner, and the sizes of rollouts and evaluations.

    Fields that determine shapes are static. All other numbers are leaves, so `jax.vmap` can run over them.

    Attributes:
        task: Agents are trained on this task, an instance of a class in `TASKS` or of your own.
        network: All agents use this policy and value network.
        learner: The learner updates the parameters after each rollout.
        num_envs: This number of environments is simulated in parallel.
        num_steps: The rollout length: each update takes this number of steps in each environment.
        num_eval_envs: An evaluation plays one episode of the deterministic policy in each of this number of separate
            environments.
        eval_every: The policy is evaluated before every update whose index is a multiple of this number.
        desynchronized_start: Each environment starts at a random time of its first episode if true, so that
            environments are not in lockstep; if false, all episodes start together.
        reset_pool: This number of start states is drawn per environment and update; with null it is num_steps /
            episode_length, rounded up. If more episodes start, because a task ends early, start states are used again.
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
        """Number of start states drawn per environment and update."""
        return self.reset_pool or math.ceil(self.num_steps / self.task.episode_length)

    @property
    def env_steps_per_update(self) -> int:
        """Environment steps of one update: environments times steps."""
        return self.num_envs * self.num_steps

    @property
    def agent_steps_per_update(self) -> int:
        """Agent steps of one update: environments times steps times agents."""
        return self.env_steps_per_update * self.task.num_agents


def _has(part: Any, method: str) -> bool:
    return hasattr(part, method) and not isinstance(part, type)


@pytree
class TrainState:
    """Everything that changes during a run. All random numbers are functions of `key` and `update` alone."""

    update: Int[Array, ""]  # number of updates done
    key: Key
    learner: LearnerState
    envs: Environments
    is_finite: Bool[Array, ""]  # False: the next update diverged, and this state is frozen


@jax.jit
def init(experiment: Experiment, key: Key) -> TrainState:
    """Return the state before the first update; raises a `TypeError` if `key` is no PRNG key."""
    _require_key(key)
    run_key, params_key, obs_key, envs_key = jax.random.split(key, 4)
    obs = experiment.task.observe(experiment.task.reset(obs_key))
    params = experiment.network.init(params_key, obs)
    envs = rollout.start(envs_key, experiment.task, experiment.num_envs, experiment.desynchronized_start)
    return TrainState(jnp.zeros((), jnp.int32), run_key, experiment.learner.init(params), envs, jnp.array(True))


def _require_key(key: Any) -> None:
    dtype, shape = getattr(key, "dtype", None), getattr(key, "shape", ())
    is_raw = dtype == jnp.uint32 and len(shape) == 1
    if dtype is None or not (jnp.issubdtype(dtype, jax.dtypes.prng_key) or is_raw):
        given = "None" if dtype is None else f"an array of type {dtype} with the shape {shape}"
        raise TypeError(f"key: must be a PRNG key such as jax.random.key(0), got {given}")


@partial(jax.jit, static_argnames="num_updates")
def train(experiment: Experiment, train_state: TrainState, num_updates: int) -> tuple[TrainState, Metrics]:
    """Run `num_updates` updates; metrics [num_updates], with NaN in `eval/...` if no evaluation was due.

    When a parameter, a loss or an evaluation return is not finite, the state before that update is frozen, and the
    metric `is_finite` is 0 from then on. n calls with 1 update give the same bits as 1 call with n updates.
    """
    return train_chunk(experiment, train_state, num_updates, num_updates)


def train_chunk(
    experiment: Experiment, train_state: TrainState, num_updates: int | Int[Array, ""], size: int
) -> tuple[TrainState, Metrics]:
    """Run at most `size` updates, a number that is traced; metrics [size], with NaN in the remaining rows."""
    shapes = jax.eval_shape(_evaluate_and_update, experiment, train_state)[1]
    rows = {name: jnp.full((size,), jnp.nan) for name in shapes}

    def body(i: Array, carry: tuple[TrainState, Metrics]) -> tuple[TrainState, Metrics]:
        state, metrics = _evaluate_and_update(experiment, carry[0])
        return state, {name: carry[1][name].at[i].set(x) for name, x in metrics.items()}

    # With a known trip count, XLA would compile single updates differently, with other rounding.
    num_updates = jax.lax.optimization_barrier(jnp.asarray(num_updates, jnp.int32))
    return jax.lax.fori_loop(0, num_updates, body, (train_state, rows))


@jax.jit
def evaluate(experiment: Experiment, train_state: TrainState) -> Metrics:
    """Evaluate the deterministic policy; the start states depend on the number of updates only, not on training."""
    key = jax.random.fold_in(_update_key(train_state), 0)
    policy = _policy(experiment, train_state.learner)
    metrics = rollout.evaluate(key, experiment.task, policy, experiment.num_eval_envs)
    return {f"eval/{name}": x for name, x in metrics.items()}


@jax.jit  # so that it is traced once, for its shapes and for the loop
def _evaluate_and_update(experiment: Experiment, state: TrainState) -> tuple[TrainState, Metrics]:
    is_due = state.update % experiment.eval_every == 0
    eval_metrics = _evaluate_if(is_due, experiment, state)
    rollout_key, learner_key = update_keys(state)
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
    """Return whether all parameters and losses are finite."""
    losses = {name: x for name, x in metrics.items() if is_loss(name)}
    checks = jax.tree.map(lambda x: jnp.isfinite(x).all(), (params, losses))
    return jax.tree.reduce(jnp.logical_and, checks)


def is_loss(name: str) -> bool:
    """Return whether the metric of this name must be finite at every update."""
    return name.startswith("learner/") and "loss" in name


def _evaluate_if(is_due: Bool[Array, ""], experiment: Experiment, state: TrainState) -> Metrics:
    """Evaluate if due, else return NaN; a loop of at most one pass, as `vmap` runs both branches of a `cond`."""
    shapes = jax.eval_shape(evaluate, experiment, state)
    skipped = jax.tree.map(lambda x: jnp.full(x.shape, jnp.nan, x.dtype), shapes)

    def body(_: tuple) -> tuple[Array, Metrics]:
        return jnp.zeros((), bool), evaluate(experiment, state)

    return jax.lax.while_loop(lambda carry: carry[0], body, (is_due, skipped))[1]


def update_keys(state: TrainState) -> tuple[Key, Key]:
    """Return the keys of the rollout and of the learner in the next update."""
    rollout_key, learner_key = jax.random.split(jax.random.fold_in(_update_key(state), 1))
    return rollout_key, learner_key


def _update_key(state: TrainState) -> Key:
    return jax.random.fold_in(state.key, state.update)


def _policy(experiment: Experiment, learner: LearnerState) -> PolicyFn:
    return partial(experiment.network.apply, learner.params, method="policy")
