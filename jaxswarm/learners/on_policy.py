"""Shared parts of on-policy learners: hyperparameters, values, advantages, samples and minibatch gradient descent.

Each step of each agent is a sample, with the common reward and the agent's own value. Samples are numbered in the order
[steps, envs, agents]. Samples of absent agents have no influence on any loss.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, TypeVar

import chex
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from jaxswarm import checks
from jaxswarm.checks import require
from jaxswarm.networks import Network
from jaxswarm.rollout import Trajectory, spread_rows
from jaxswarm.types import Key, Metrics, Observation, pytree, static

Params = Any  # the parameters of a network, a pytree of arrays
Mask = Bool[Array, "*rows"] | None  # rows of present agents; None: all are present

DEFAULT_BATCH_SIZE = 1280
MIN_FEISTEL_COLUMNS = 8  # `shuffled` sorts matrices with fewer columns


@pytree
class OnPolicy:
    """Hyperparameters of all on-policy learners.

    The sampling unit `envs` is faster because the agents of an environment share most of the work of `perceive`.

    Attributes:
        learning_rate: The Adam optimizer uses this constant learning rate (> 0).
        discount: Future rewards are discounted by this factor per step (0 to 1), called gamma in the literature.
        gae_lambda: Generalized advantage estimation weights each further step by this factor (0 to 1; 0: one step only,
            1: all steps to the end of the episode).
        value_coefficient: The total loss contains the value loss with this weight (>= 0).
        entropy_coefficient: The total loss contains the entropy bonus with this weight (>= 0).
        max_grad_norm: Gradients are clipped to this global norm (> 0).
        adam_epsilon: Adam adds this number (> 0) to the denominator of its steps.
        num_epochs: Each update passes over all samples this many times (an integer >= 1).
        batch_size: Each gradient step uses this many samples (an integer >= 2 that divides num_envs * num_steps *
            num_agents and, with `sampling_unit=envs`, is a multiple of num_agents; null: the possible number nearest to
            1280).
        sampling_unit: Minibatches consist of all agents of randomly drawn environments (`envs`), or of randomly drawn
            single agents (`agents`, as in the thesis).
        bootstrap_truncation: At a time limit, advantages bootstrap from the value of the last state if true; if false,
            a time limit counts as a terminal state, as in the thesis.
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
    """Raise a `ValueError` for the first of these hyperparameters that is out of its range."""
    require(learner, checks.POSITIVE_FINITE, "learning_rate", "max_grad_norm", "adam_epsilon")
    require(learner, checks.UNIT_INTERVAL, "discount", "gae_lambda")
    require(learner, checks.NOT_NEGATIVE, "value_coefficient", "entropy_coefficient")
    require(learner, checks.integer(1), "num_epochs")
    require(learner, checks.optional(checks.integer(2)), "batch_size")
    require(learner, checks.BOOL, "bootstrap_truncation")
    require(learner, checks.choice(("agents", "envs")), "sampling_unit")


def batch_size(learner: OnPolicy, num_samples: int, num_agents: int) -> int:
    """Return the number of samples per gradient step.

    Raises a `ValueError` with possible sizes if the learner's `batch_size` is not possible.
    """
    requested = learner.batch_size
    nearest = nearest_batch_sizes(learner, num_samples, num_agents)
    if nearest and requested in (None, nearest[0]):
        return nearest[0]
    unit_size = _unit_size(learner, num_agents)
    raise ValueError(
        f"batch_size: must divide num_envs * num_steps * num_agents = {num_samples} and be a multiple of {unit_size}, "
        f"for example {', '.join(map(str, sorted(nearest[:4]))) or 'none'}, got {requested}"
    )


def nearest_batch_sizes(learner: OnPolicy, num_samples: int, num_agents: int) -> list[int]:
    """Return all possible batch sizes, sorted by their distance from the learner's or the default batch size."""
    unit_size = _unit_size(learner, num_agents)
    num_units = num_samples // unit_size
    small = [n for n in range(1, math.isqrt(num_units) + 1) if num_units % n == 0]
    divisors = sorted({*small, *(num_units // n for n in small)})
    possible = [unit_size * n for n in divisors if unit_size * n > 1]
    return sorted(possible, key=lambda n: abs(n - (learner.batch_size or DEFAULT_BATCH_SIZE)))


def _unit_size(learner: OnPolicy, num_agents: int) -> int:
    """Return the number of samples of a sampling unit."""
    return 1 if learner.sampling_unit == "agents" else num_agents


@pytree
class LearnerState:
    """Parameters of the network and state of the optimizer."""

    params: Params
    optimizer_state: optax.OptState


State = TypeVar("State", bound=LearnerState)


@pytree
class Minibatch:
    """Samples of one gradient step, one per row."""

    obs: Observation
    action: Float[Array, "rows action_dim"]
    log_prob: Float[Array, " rows"]  # of the action under the policy that acted
    advantage: Float[Array, " rows"]
    target: Float[Array, " rows"]  # of the value
    action_mean: Float[Array, "rows action_dim"] | None = None  # of the policy that acted; only TRL needs it
    action_std: Float[Array, "rows action_dim"] | None = None


@pytree
class Samples:
    """All samples of a trajectory, in the order [steps, envs, agents]; observations are recomputed from the views."""

    view: Any  # of the task, [steps * envs, ...]
    action: Float[Array, "samples action_dim"]
    log_prob: Float[Array, " samples"]
    advantage: Float[Array, " samples"]
    target: Float[Array, " samples"]
    action_mean: Float[Array, "samples action_dim"]
    action_std: Float[Array, "samples action_dim"]


Loss = Callable[[Params, Minibatch], tuple[Array, Metrics]]


def adam(learner: OnPolicy) -> optax.GradientTransformation:
    """Return Adam on clipped gradients."""
    return optax.chain(
        optax.clip_by_global_norm(learner.max_grad_norm),
        optax.adam(learner.learning_rate, eps=learner.adam_epsilon),
    )


def update(
    learner: OnPolicy, loss: Loss, key: Key, state: State, network: Network, task: Any, trajectory: Trajectory
) -> tuple[State, Metrics]:
    """Minimize `loss` on the samples of one trajectory, in all epochs.

    Raises a `ValueError` if the shapes of the trajectory do not fit.
    """
    check_trajectory(trajectory)
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
        next_absent(task, trajectory),
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


def check_trajectory(trajectory: Trajectory) -> None:
    """Raise a `ValueError` unless leaves have the leading axes [steps, envs] or, per agent, [steps, envs, agents].

    The check runs at tracing and costs nothing in the compiled program.
    """
    actions = [trajectory.action, trajectory.action_mean, trajectory.action_std]
    per_agent = (actions, trajectory.log_prob, trajectory.mask)
    message = "trajectory: must have leaves with the same leading axes [steps, envs, ...]"
    chex.assert_tree_shape_prefix(
        trajectory, trajectory.reward.shape, custom_message=message, exception_type=ValueError
    )
    message = "trajectory: must have actions [steps, envs, agents, action_dim], log_prob and mask [steps, envs, agents]"
    chex.assert_equal_shape(actions, custom_message=message, exception_type=ValueError)
    chex.assert_tree_shape_prefix(
        per_agent, trajectory.action.shape[:-1], custom_message=message, exception_type=ValueError
    )


def trajectory_values(
    network: Network, params: Params, task: Any, trajectory: Trajectory
) -> tuple[Float[Array, "steps envs agents"], Float[Array, "steps envs agents"]]:
    """Return the values of the state before each step, and of the state after it, before any reset."""

    def value(state: Any) -> Array:
        return network.apply(params, jax.vmap(task.observe)(state), method="value")

    def value_after(step: tuple) -> Array:
        """Return the values before the next step, which are known unless an episode ended or the step is the last."""
        is_known, final_state, next_known = step
        return jax.lax.cond(is_known, lambda: next_known, lambda: value(final_state))

    values = jax.lax.map(value, trajectory.state)
    is_known = ~(trajectory.terminated | trajectory.truncated).any(-1)
    is_known = is_known.at[-1].set(False)
    return values, jax.lax.map(value_after, (is_known, trajectory.final_state, jnp.roll(values, -1, axis=0)))


def next_absent(task: Any, trajectory: Trajectory) -> Bool[Array, "steps envs #agents"]:
    """Mark agents that are absent after each step, before any reset."""
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
    is_next_absent: Bool[Array, "steps envs #agents"] | bool = False,
) -> Float[Array, "steps envs agents"]:
    """Return the generalized advantage estimates of Schulman et al. (2016), eq. 16.

    `is_terminal` marks steps without a bootstrap value; `is_done` marks the last step of an episode. `is_next_absent`
    marks agents that are absent after a step; for them the step is both. Raises a `ValueError` if the shapes do not
    fit.
    """
    chex.assert_equal_shape([reward, is_terminal, is_done], exception_type=ValueError)
    chex.assert_shape([value, next_value], (*reward.shape, None), exception_type=ValueError)
    chex.assert_equal_shape([value, next_value], exception_type=ValueError)
    delta = reward[..., None] + discount * jnp.where(is_terminal[..., None] | is_next_absent, 0.0, next_value) - value
    decay = discount * gae_lambda * (1.0 - (is_done[..., None] | is_next_absent))

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
    """Return all samples of a trajectory."""
    views = jax.vmap(jax.vmap(task.view))(trajectory.state)
    policy = (trajectory.action_mean, trajectory.action_std)
    arrays = (trajectory.action, trajectory.log_prob, advantage, target, *policy)
    return Samples(jax.tree.map(_merge, views), *[_merge(_merge(x)) for x in arrays])


def fetch_agents(task: Any, samples: Samples, sample: Int[Array, " rows"]) -> Minibatch:
    """Return the samples with these numbers, for `sampling_unit="agents"`."""
    view = jax.tree.map(lambda x: x[sample // task.num_agents], samples.view)
    return _minibatch(samples, sample, jax.vmap(task.perceive)(view, sample % task.num_agents))


def fetch_envs(task: Any, samples: Samples, env: Int[Array, " envs"]) -> Minibatch:
    """Return the samples of all agents of the environments with these numbers, for `sampling_unit="envs"`.

    An environment is numbered per step, in the order [steps, envs].
    """
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
    """Merge the two leading axes."""
    return x.reshape(x.shape[0] * x.shape[1], *x.shape[2:])


def shuffled(key: Key, num_rows: int, num_columns: int) -> Int[Array, "rows columns"]:
    """Return the integers below rows * columns in pseudo-random order, by a Feistel network with random tables.

    Luby and Rackoff (1988) show why a few rounds suffice. `jax.random.permutation` sorts, which took a fifth of the
    time of an update on a CPU; the network takes less than a hundredth. Matrices with fewer than `MIN_FEISTEL_COLUMNS`
    columns are sorted nevertheless: with one column the rounds would only rotate the order, and so few columns go with
    few rows.
    """
    if num_columns < MIN_FEISTEL_COLUMNS:
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
    """Run minibatch gradient descent; each epoch passes over all sampling units once, in a new random order.

    The metrics are means over all minibatches, but maxima if their name ends with `_max`.
    """

    def summarize(metrics: Metrics) -> Metrics:
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
        return state, summarize(metrics)

    state, metrics = jax.lax.scan(epoch, state, jax.random.split(key, num_epochs))
    return state, summarize(metrics)


def mean(x: Float[Array, "*#rows"], mask: Mask) -> Float[Array, ""]:
    """Return the mean over the rows of present agents."""
    if mask is None:
        return x.mean()
    return jnp.where(mask, x, 0.0).sum() / jnp.maximum(mask.sum(), 1)


def maximum(x: Float[Array, "#rows"], mask: Mask) -> Float[Array, ""]:
    """Return the maximum of nonnegative numbers over the rows of present agents."""
    return x.max() if mask is None else jnp.where(mask, x, 0.0).max()


def standardized(advantage: Float[Array, " rows"], mask: Mask) -> Float[Array, " rows"]:
    """Return the advantages of a minibatch, standardized to mean 0 and sample standard deviation 1."""
    num_rows = advantage.size if mask is None else mask.sum()
    centered = advantage - mean(advantage, mask)
    variance = mean(jnp.square(centered), mask) * (num_rows / jnp.maximum(num_rows - 1, 1))
    return centered / (jnp.sqrt(variance) + 1e-8)


def squared_error(value: Float[Array, " rows"], target: Float[Array, " rows"], mask: Mask) -> Float[Array, ""]:
    """Return the value loss, the mean squared error."""
    return mean(jnp.square(value - target), mask)


def explained_variance(value: Float[Array, "*rows"], target: Float[Array, "*rows"], mask: Mask) -> Float[Array, ""]:
    """Return 1 - Var(target - value) / Var(target).

    It is 1 for perfect values, 0 for a constant, negative for worse values, and NaN if the targets have no variance.
    """

    def variance(x: Array) -> Array:
        return mean(jnp.square(x - mean(x, mask)), mask)

    total = variance(target)
    return jnp.where(total > 0.0, 1.0 - variance(target - value) / total, jnp.nan)
