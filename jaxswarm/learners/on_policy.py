"""What on-policy learners share: hyper-parameters, values, advantages, samples, and descent by minibatches.

Every agent's step is a sample of its own, with the common reward and that agent's own value. Samples are numbered
[steps, worlds, agents] in this order. Those of agents that did not exist have no influence on any loss.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from jaxswarm import checks
from jaxswarm.checks import require
from jaxswarm.rollout import Trajectory, spread_rows
from jaxswarm.types import Key, Metrics, Observation, pytree, static

Params = Any
Mask = Bool[Array, "*rows"] | None  # rows that exist; None: all do

USUAL_BATCH_SIZE = 1280
FEWEST_COLUMNS = 8  # that are shuffled without sorting


@pytree
class OnPolicy:
    """Hyper-parameters of every on-policy learner.

    A minibatch has `batch_size` samples, or the possible number nearest to 1280: rows of single agents drawn at random,
    or those of all agents of randomly drawn worlds, which is faster because they share most of the perceiving. With
    `bootstrap_truncation` the value of the last state stands for what would have come after a time limit; without,
    a time limit counts as the end of the world, as in the thesis.
    """

    learning_rate: float = 3e-3
    discount: float = 0.99
    gae_lambda: float = 0.95
    value_coefficient: float = 0.5
    entropy_coefficient: float = 0.0
    max_grad_norm: float = 0.5
    adam_epsilon: float = 1e-5
    num_epochs: int = static(default=2)
    batch_size: int | None = static(default=None)
    sampling_unit: Literal["agents", "envs"] = static(default="envs")
    bootstrap_truncation: bool = static(default=True)


def check(learner: OnPolicy) -> None:
    """A `ValueError` names the first of these hyper-parameters that is not possible."""
    positive = ("learning_rate", "max_grad_norm", "adam_epsilon")
    require(learner, checks.POSITIVE_FINITE, *positive)
    require(learner, checks.UNIT_INTERVAL, "discount", "gae_lambda")
    require(learner, checks.NOT_NEGATIVE, "value_coefficient", "entropy_coefficient")
    require(learner, checks.integer(1), "num_epochs")
    require(learner, checks.optional(checks.integer(2)), "batch_size")
    require(learner, checks.BOOL, "bootstrap_truncation")
    require(learner, checks.choice(("agents", "envs")), "sampling_unit")


def batch_size(learner: OnPolicy, num_samples: int, num_agents: int) -> int:
    """Samples per gradient step; a `ValueError` says which sizes are possible if the one asked for is not."""
    asked = learner.batch_size
    nearest = nearest_batch_sizes(learner, num_samples, num_agents)
    if nearest and (asked is None or asked == nearest[0]):
        return nearest[0]
    unit = _unit(learner, num_agents)
    raise ValueError(
        f"batch_size: must divide num_envs * num_steps * num_agents = {num_samples} and be a multiple of {unit}, "
        f"for example {', '.join(map(str, sorted(nearest[:4]))) or 'none'}, got {asked}"
    )


def nearest_batch_sizes(learner: OnPolicy, num_samples: int, num_agents: int) -> list[int]:
    """All that are possible, the one nearest to the learner's or to the usual one first."""
    unit = _unit(learner, num_agents)
    num_units = num_samples // unit
    small = [n for n in range(1, math.isqrt(num_units) + 1) if num_units % n == 0]
    possible = [unit * n for n in sorted({*small, *(num_units // n for n in small)}) if unit * n > 1]
    return sorted(possible, key=lambda n: abs(n - (learner.batch_size or USUAL_BATCH_SIZE)))


def _unit(learner: OnPolicy, num_agents: int) -> int:
    """Samples that a minibatch has or has not as a whole."""
    return 1 if learner.sampling_unit == "agents" else num_agents


@pytree
class LearnerState:
    """Parameters of the network and of the optimizer."""

    params: Params
    optimizer_state: optax.OptState


State = TypeVar("State", bound=LearnerState)


@pytree
class Minibatch:
    """Samples to learn from, one row each."""

    obs: Observation
    action: Float[Array, "rows action_dim"]
    log_prob: Float[Array, " rows"]  # of the action under the policy that took it
    advantage: Float[Array, " rows"]
    target: Float[Array, " rows"]  # for the value
    action_mean: Float[Array, "rows action_dim"] | None = None  # of the policy that took it, for those who ask
    action_std: Float[Array, "rows action_dim"] | None = None


@pytree
class Samples:
    """All samples of a trajectory, numbered [steps, worlds, agents]; observations are recomputed from the views."""

    view: Any  # [steps * worlds, ...]
    action: Float[Array, "samples action_dim"]
    log_prob: Float[Array, " samples"]
    advantage: Float[Array, " samples"]
    target: Float[Array, " samples"]
    action_mean: Float[Array, "samples action_dim"]
    action_std: Float[Array, "samples action_dim"]


Loss = Callable[[Params, Minibatch], tuple[Array, Metrics]]


def adam(learner: OnPolicy) -> optax.GradientTransformation:
    """Adam, on shortened gradients."""
    return optax.chain(
        optax.clip_by_global_norm(learner.max_grad_norm),
        optax.adam(learner.learning_rate, eps=learner.adam_epsilon),
    )


def update(
    learner: OnPolicy, loss: Loss, key: Key, state: State, network: Any, task: Any, trajectory: Trajectory
) -> tuple[State, Metrics]:
    """Descends `loss` on the samples of one trajectory, all epochs."""
    value, next_value = trajectory_values(network, state.params, task, trajectory)
    is_done = trajectory.terminated | trajectory.truncated
    is_terminal = trajectory.terminated if learner.bootstrap_truncation else is_done
    advantage = generalized_advantages(
        trajectory.reward,
        is_terminal,
        is_done,
        value,
        next_value,
        learner.discount,
        learner.gae_lambda,
        gone_after(task, trajectory),
    )
    target = advantage + value
    samples = stored_samples(task, trajectory, advantage, target)
    num_samples = advantage.size
    state, metrics = descend(
        key,
        loss,
        partial(FETCH[learner.sampling_unit], task, samples),
        adam(learner),
        state,
        num_samples if learner.sampling_unit == "agents" else num_samples // task.num_agents,
        num_samples // batch_size(learner, num_samples, task.num_agents),
        learner.num_epochs,
    )
    return state, metrics | {"explained_variance": explained_variance(value, target, trajectory.mask)}


def trajectory_values(
    network: Any, params: Params, task: Any, trajectory: Trajectory
) -> tuple[Float[Array, "steps envs agents"], Float[Array, "steps envs agents"]]:
    """Values of the state before each step, and of the state after it, before any reset."""

    def value(state: Any) -> Array:
        return network.apply(params, jax.vmap(task.observe)(state), method="value")

    def value_after(step: tuple) -> Array:
        """Where no episode ended, the state after this step is the one before the next; the last step has no next."""
        is_known, final_state, following = step
        return jax.lax.cond(is_known, lambda: following, lambda: value(final_state))

    values = jax.lax.map(value, trajectory.state)
    is_known = ~(trajectory.terminated | trajectory.truncated).any(-1)
    is_known = is_known.at[-1].set(False)
    return values, jax.lax.map(value_after, (is_known, trajectory.final_state, jnp.roll(values, -1, axis=0)))


def gone_after(task: Any, trajectory: Trajectory) -> Bool[Array, "steps envs #agents"]:
    """Agents that do not exist after each step, before any reset."""
    if trajectory.mask is None:
        return jnp.zeros((*trajectory.reward.shape, 1), bool)
    return ~jax.vmap(jax.vmap(task.observe))(trajectory.final_state).mask


def generalized_advantages(
    reward: Float[Array, "steps envs"],
    is_terminal: Bool[Array, "steps envs"],
    is_done: Bool[Array, "steps envs"],
    value: Float[Array, "steps envs agents"],
    next_value: Float[Array, "steps envs agents"],
    discount: Float[Array, ""] | float,
    gae_lambda: Float[Array, ""] | float,
    is_gone: Bool[Array, "steps envs #agents"] | bool = False,
) -> Float[Array, "steps envs agents"]:
    """Generalized advantage estimates (Schulman et al., 2016).

    `is_terminal` steps have no value after them; `is_done` steps end an episode, so nothing flows back across them.
    For agents that do not exist after a step, `is_gone`, it is both.
    """
    delta = reward[..., None] + discount * jnp.where(is_terminal[..., None] | is_gone, 0.0, next_value) - value
    decay = discount * gae_lambda * (1.0 - (is_done[..., None] | is_gone))

    def backwards(advantage: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        delta, decay = step
        advantage = delta + decay * advantage
        return advantage, advantage

    return jax.lax.scan(backwards, jnp.zeros_like(delta[0]), (delta, decay), reverse=True)[1]


def stored_samples(
    task: Any,
    trajectory: Trajectory,
    advantage: Float[Array, "steps envs agents"],
    target: Float[Array, "steps envs agents"],
) -> Samples:
    """All samples of a trajectory."""
    views = jax.vmap(jax.vmap(task.view))(trajectory.state)
    policy = (trajectory.action_mean, trajectory.action_std)
    arrays = (trajectory.action, trajectory.log_prob, advantage, target, *policy)
    return Samples(jax.tree.map(_merge, views), *[_merge(_merge(x)) for x in arrays])


def fetch_agents(task: Any, samples: Samples, sample: Int[Array, " rows"]) -> Minibatch:
    """The samples of these numbers."""
    view = jax.tree.map(lambda x: x[sample // task.num_agents], samples.view)
    return _minibatch(samples, sample, jax.vmap(task.perceive)(view, sample % task.num_agents))


def fetch_envs(task: Any, samples: Samples, env: Int[Array, " envs"]) -> Minibatch:
    """The samples of all agents of the worlds of these numbers."""
    agent = jnp.arange(task.num_agents)
    view = jax.tree.map(lambda x: x[env], samples.view)
    obs = jax.vmap(jax.vmap(task.perceive, (None, 0)), (0, None))(view, agent)
    return _minibatch(samples, _merge(env[:, None] * task.num_agents + agent[None]), jax.tree.map(_merge, obs))


FETCH = {"agents": fetch_agents, "envs": fetch_envs}


def _minibatch(samples: Samples, sample: Int[Array, " rows"], obs: Observation) -> Minibatch:
    policy = (samples.action_mean, samples.action_std)
    arrays = (samples.action, samples.log_prob, samples.advantage, samples.target, *policy)
    return Minibatch(obs, *[x[sample] for x in arrays])


def _merge(x: Array) -> Array:
    """The two leading axes in one."""
    return x.reshape(x.shape[0] * x.shape[1], *x.shape[2:])


def shuffled(key: Key, num_rows: int, num_columns: int) -> Int[Array, "rows columns"]:
    """The numbers below rows * columns in pseudo-random order: a Feistel network with random tables.

    Luby and Rackoff (1988) show why a few rounds suffice. Sorting, which is what `jax.random.permutation` does, took
    a fifth of the time of an update on CPU; this takes less than a hundredth. Rows of a few numbers are sorted: with
    one column the rounds would only turn the order round, and there are not many rows of such minibatches.
    """
    if num_columns < FEWEST_COLUMNS:
        return jax.random.permutation(key, num_rows * num_columns).reshape(num_rows, num_columns)
    tables = jax.random.bits(key, (4, num_columns + num_rows)) >> 1
    row, column = jnp.divmod(jnp.arange(num_rows * num_columns), num_columns)
    for table in tables.astype(jnp.int32):
        row = (row + table[:num_columns][column] % num_rows) % num_rows
        column = (column + table[num_columns:][row] % num_columns) % num_columns
    return (row * num_columns + column).reshape(num_rows, num_columns)


def descend(
    key: Key,
    loss: Loss,
    fetch: Callable[[Int[Array, " units"]], Minibatch],
    optimizer: optax.GradientTransformation,
    state: State,
    num_units: int,
    num_minibatches: int,
    num_epochs: int,
) -> tuple[State, Metrics]:
    """Minibatch gradient descent; each epoch goes through all units once, in a fresh random order.

    The metrics are means over all minibatches; those called `..._max` are maxima.
    """

    def over(metrics: Metrics) -> Metrics:
        return {name: (jnp.max if name.endswith("_max") else jnp.mean)(x) for name, x in metrics.items()}

    def minibatch(state: State, units: Int[Array, " units"]) -> tuple[State, Metrics]:
        gradient, metrics = jax.grad(loss, has_aux=True)(state.params, spread_rows(fetch(units)))
        updates, optimizer_state = optimizer.update(gradient, state.optimizer_state, state.params)
        metrics["gradient_norm"] = optax.tree.norm(gradient)
        params = optax.apply_updates(state.params, updates)
        return dataclasses.replace(state, params=params, optimizer_state=optimizer_state), metrics

    def epoch(state: State, key: Key) -> tuple[State, Metrics]:
        order = shuffled(key, num_minibatches, num_units // num_minibatches)
        state, metrics = jax.lax.scan(minibatch, state, order)
        return state, over(metrics)

    state, metrics = jax.lax.scan(epoch, state, jax.random.split(key, num_epochs))
    return state, over(metrics)


def mean(x: Float[Array, "*#rows"], mask: Mask) -> Float[Array, ""]:
    """Mean over the rows that exist."""
    if mask is None:
        return x.mean()
    return jnp.where(mask, x, 0.0).sum() / jnp.maximum(mask.sum(), 1)


def maximum(x: Float[Array, "#rows"], mask: Mask) -> Float[Array, ""]:
    """Maximum over the rows that exist, of numbers that are not negative."""
    return x.max() if mask is None else jnp.where(mask, x, 0.0).max()


def standardized(advantage: Float[Array, " rows"], mask: Mask) -> Float[Array, " rows"]:
    """Advantages of a minibatch with mean 0 and sample standard deviation 1."""
    num_rows = advantage.size if mask is None else mask.sum()
    centered = advantage - mean(advantage, mask)
    variance = mean(jnp.square(centered), mask) * (num_rows / jnp.maximum(num_rows - 1, 1))
    return centered / (jnp.sqrt(variance) + 1e-8)


def squared_error(value: Float[Array, " rows"], target: Float[Array, " rows"], mask: Mask) -> Float[Array, ""]:
    """Loss of the values."""
    return mean(jnp.square(value - target), mask)


def explained_variance(value: Float[Array, "*rows"], target: Float[Array, "*rows"], mask: Mask) -> Float[Array, ""]:
    """1 for perfect values, 0 for a constant, negative for worse; NaN if there is nothing to explain."""

    def variance(x: Array) -> Array:
        return mean(jnp.square(x - mean(x, mask)), mask)

    total = variance(target)
    return jnp.where(total > 0.0, 1.0 - variance(target - value) / total, jnp.nan)
