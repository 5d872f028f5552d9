"""Worlds stepped by a policy, many at once: the only place where tasks and networks meet.

Axes are [steps, worlds, agents, ...]. Trajectories hold states, not observations: a state is O(agents) large, the
observations of all its agents are O(agents^2), and recomputing them where they are needed is faster than fetching them.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from jaxswarm.types import Key, Metrics, Observation, Step, pytree

ENVS_AXIS = "envs"  # of a mesh of devices

PolicyFn = Callable[[Observation], Any]  # to a `distributions.Policy`


@pytree
class Trajectory:
    """What the learner gets; `final_state` is the state after the step, before any reset."""

    state: Any
    action: Float[Array, "steps envs agents action_dim"]  # as sampled, not clipped
    log_prob: Float[Array, "steps envs agents"]
    action_mean: Float[Array, "steps envs agents action_dim"]  # of the policy that acted
    action_std: Float[Array, "steps envs agents action_dim"]
    reward: Float[Array, "steps envs"]
    terminated: Bool[Array, "steps envs"]
    truncated: Bool[Array, "steps envs"]
    final_state: Any
    mask: Bool[Array, "steps envs agents"] | None  # agents that exist; None: all do


@pytree
class Environments:
    """Worlds in the middle of their episodes, with the sums of the episodes so far."""

    state: Any
    episode_return: Float[Array, " envs"]
    episode_length: Int[Array, " envs"]
    is_complete: Bool[Array, " envs"]  # the episode was seen from its start


def start(key: Key, task: Any, num_envs: int, is_desynchronized: bool) -> Environments:
    """Fresh worlds; desynchronised ones start at a random time of an episode whose return then counts nowhere."""
    reset_key, time_key = jax.random.split(key)
    state = jax.vmap(task.reset)(jax.random.split(reset_key, num_envs))
    if is_desynchronized:
        state = state.replace(time=jax.random.randint(time_key, (num_envs,), 0, task.episode_length))
    is_complete = jnp.full((num_envs,), not is_desynchronized)
    return Environments(state, jnp.zeros(num_envs), jnp.zeros(num_envs, jnp.int32), is_complete)


def collect(
    key: Key, task: Any, policy: PolicyFn, envs: Environments, num_steps: int, reset_pool: int
) -> tuple[Environments, Trajectory, Metrics]:
    """Steps all worlds `num_steps` times with sampled actions; finished ones restart.

    Start states are drawn once per call, `reset_pool` for each world; a world that restarts more often within one
    call uses them again. The metrics are means over the episodes that were completed, NaN where there were none.
    """
    num_envs = envs.episode_return.shape[0]
    pool_key, step_key = jax.random.split(key)
    reset_keys = jax.random.split(pool_key, (reset_pool, num_envs))
    pool = jax.vmap(jax.vmap(task.reset))(reset_keys)

    def step(carry: tuple, key: Key) -> tuple:
        envs, num_resets, totals = carry
        action_key, env_key = jax.random.split(key)
        obs = jax.vmap(task.observe)(envs.state)
        distribution = policy(obs)
        action = distribution.sample(seed=action_key)
        final_state, outcome = step_envs(env_key, task, envs.state, action)
        transition = Trajectory(
            envs.state,
            action,
            distribution.log_prob(action),
            distribution.mean(),
            distribution.stddev(),
            outcome.reward,
            outcome.terminated,
            outcome.truncated,
            final_state,
            obs.mask,
        )
        is_done = outcome.terminated | outcome.truncated
        episode_return = envs.episode_return + outcome.reward
        episode_length = envs.episode_length + 1
        counts = (is_done & envs.is_complete).astype(jnp.float32)
        completed = (counts, counts * episode_return, counts * episode_length)
        totals = jax.tree.map(lambda total, x: total + x.sum(), totals, completed)
        start_state = jax.tree.map(lambda x: x[num_resets % reset_pool, jnp.arange(num_envs)], pool)
        envs = Environments(
            jax.vmap(_select)(is_done, start_state, final_state),
            jnp.where(is_done, 0.0, episode_return),
            jnp.where(is_done, 0, episode_length),
            envs.is_complete | is_done,
        )
        return (envs, num_resets + is_done, totals), transition

    carry = (envs, jnp.zeros(num_envs, jnp.int32), (jnp.zeros(()),) * 3)
    carry, trajectory = jax.lax.scan(step, carry, jax.random.split(step_key, num_steps))
    envs, _, (episodes, returns, lengths) = carry
    metrics = {"episodes": episodes, "return": returns / episodes, "episode_length": lengths / episodes}
    return envs, trajectory, metrics


def spread_rows(tree: Any) -> Any:
    """The tree with its rows spread over the devices that share worlds, if there are several."""
    mesh = jax.sharding.get_abstract_mesh()
    num_devices = dict(mesh.shape).get(ENVS_AXIS, 1)

    def spread(x: Array) -> Array:
        is_even = num_devices > 1 and x.shape[0] % num_devices == 0
        return jax.lax.with_sharding_constraint(x, PartitionSpec(ENVS_AXIS)) if is_even else x

    return jax.tree.map(spread, tree)


def evaluate(key: Key, task: Any, policy: PolicyFn, num_envs: int) -> Metrics:
    """One whole episode in each of fresh worlds with the mean action: undiscounted returns and the task's own metrics.

    The task's metrics are averaged over the steps of an episode, then over episodes. A metric that is NaN at a step
    says nothing there: only the other steps count, and only episodes that have any.
    """
    reset_key, step_key = jax.random.split(key)
    start = jax.vmap(task.reset)(jax.random.split(reset_key, num_envs))

    def step(carry: tuple, key: Key) -> tuple:
        state, is_running, returns, lengths, totals, counts = carry
        action = policy(jax.vmap(task.observe)(state)).mean()
        state, outcome = step_envs(key, task, state, action)
        counted = {name: is_running & ~jnp.isnan(x) for name, x in outcome.metrics.items()}
        totals = {name: totals[name] + jnp.where(counted[name], x, 0.0) for name, x in outcome.metrics.items()}
        counts = {name: counts[name] + x for name, x in counted.items()}
        returns = returns + jnp.where(is_running, outcome.reward, 0.0)
        is_over = outcome.terminated | outcome.truncated
        return (state, is_running & ~is_over, returns, lengths + is_running, totals, counts), None

    action = jnp.zeros((num_envs, task.num_agents, task.action_dim))
    names = jax.eval_shape(lambda: step_envs(step_key, task, start, action)[1]).metrics
    zeros = dict.fromkeys(names, jnp.zeros(num_envs))
    carry = (start, jnp.ones(num_envs, bool), jnp.zeros(num_envs), jnp.zeros(num_envs), zeros, zeros)
    carry, _ = jax.lax.scan(step, carry, jax.random.split(step_key, task.episode_length))
    _, _, returns, lengths, totals, counts = carry
    means = {name: jnp.nanmean(total / counts[name]) for name, total in totals.items()}
    return {"return": returns.mean(), "return_std": returns.std(), "episode_length": lengths.mean()} | means


def step_envs(key: Key, task: Any, state: Any, action: Float[Array, "envs agents action_dim"]) -> tuple[Any, Step]:
    """One step of every world; actions are clipped to the action box here."""
    keys = jax.random.split(key, action.shape[0])
    return jax.vmap(task.step)(keys, state, jnp.clip(action, -1.0, 1.0))


def _select(condition: Bool[Array, ""], on_true: Any, on_false: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), on_true, on_false)
