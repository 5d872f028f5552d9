"""Environments stepped by a policy, many in parallel: the only place where tasks and networks meet.

Axes are [steps, envs, agents, ...]. Trajectories store states, not observations: a state needs O(agents) memory, the
observations of all its agents need O(agents^2), and recomputing them in minibatches is faster than gathering them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from jaxswarm.types import Key, Metrics, Observation, Step, clip_action, pytree

ENVS_AXIS = "envs"  # of a mesh of devices

PolicyFn = Callable[[Observation], Any]  # to a `distributions.Policy`


@pytree
class Trajectory:
    """Transitions that a learner updates from; `final_state` is the state after each step, before any reset."""

    state: Any
    action: Float[Array, "steps envs agents action_dim"]  # as sampled, not clipped
    log_prob: Float[Array, "steps envs agents"]
    action_mean: Float[Array, "steps envs agents action_dim"]  # of the policy that acted
    action_std: Float[Array, "steps envs agents action_dim"]
    reward: Float[Array, "steps envs"]
    terminated: Bool[Array, "steps envs"]
    truncated: Bool[Array, "steps envs"]
    final_state: Any
    mask: Bool[Array, "steps envs agents"] | None  # agents that exist; None: all exist


@pytree
class Environments:
    """Environments in the middle of their episodes, with the sums of the episodes so far."""

    state: Any
    episode_return: Float[Array, " envs"]
    episode_length: Int[Array, " envs"]
    is_complete: Bool[Array, " envs"]  # the episode was recorded from its first step


class Interaction(NamedTuple):
    """One step of all environments: what the agents observed and did, and what followed; leaves [envs, ...]."""

    obs: Observation
    distribution: Any
    action: Float[Array, "envs agents action_dim"]  # as selected, not clipped
    state: Any  # after the step
    outcome: Step

    @property
    def is_done(self) -> Bool[Array, " envs"]:
        """Mark environments whose episode ended with this step."""
        return self.outcome.terminated | self.outcome.truncated


def interact(
    key: Key,
    task: Any,
    policy: PolicyFn,
    state: Any,
    select: Callable[[Any], Float[Array, "envs agents action_dim"]],
) -> Interaction:
    """Let all agents observe, act by `select` (sampling, or the mean) and step every environment once.

    The environments get the action clipped to the action bounds.
    """
    obs = jax.vmap(task.observe)(state)
    distribution = policy(obs)
    action = select(distribution)
    keys = jax.random.split(key, action.shape[0])
    return Interaction(obs, distribution, action, *jax.vmap(task.step)(keys, state, clip_action(action)))


def mean_action(distribution: Any) -> Float[Array, "envs agents action_dim"]:
    """Select the mean of the policy, the deterministic action of evaluations and replays."""
    return distribution.mean()


def start(key: Key, task: Any, num_envs: int, is_desynchronized: bool) -> Environments:
    """Reset all environments.

    Desynchronized environments start at a random time of their first episode, whose return is not counted.
    """
    reset_key, time_key = jax.random.split(key)
    state = jax.vmap(task.reset)(jax.random.split(reset_key, num_envs))
    if is_desynchronized:
        state = state.replace(time=jax.random.randint(time_key, (num_envs,), 0, task.episode_length))
    is_complete = jnp.full((num_envs,), not is_desynchronized)
    return Environments(state, jnp.zeros(num_envs), jnp.zeros(num_envs, jnp.int32), is_complete)


def collect(
    key: Key, task: Any, policy: PolicyFn, envs: Environments, num_steps: int, reset_pool: int
) -> tuple[Environments, Trajectory, Metrics]:
    """Step all environments `num_steps` times with sampled actions; finished environments restart.

    Start states are drawn once per call, `reset_pool` for each environment. An environment that restarts more often
    within one call reuses them. The metrics are means over the completed episodes, NaN if there were none.
    """
    num_envs = envs.episode_return.shape[0]
    chex.assert_tree_shape_prefix(envs, (num_envs,))
    pool_key, step_key = jax.random.split(key)
    reset_keys = jax.random.split(pool_key, (reset_pool, num_envs))
    pool = jax.vmap(jax.vmap(task.reset))(reset_keys)

    def step(carry: tuple, key: Key) -> tuple:
        envs, num_resets, totals = carry
        action_key, env_key = jax.random.split(key)
        done = interact(env_key, task, policy, envs.state, lambda distribution: distribution.sample(seed=action_key))
        episode_return = envs.episode_return + done.outcome.reward
        episode_length = envs.episode_length + 1
        counts = (done.is_done & envs.is_complete).astype(jnp.float32)
        completed = (counts, counts * episode_return, counts * episode_length)
        totals = jax.tree.map(lambda total, x: total + x.sum(), totals, completed)
        start_state = jax.tree.map(lambda x: x[num_resets % reset_pool, jnp.arange(num_envs)], pool)
        after = Environments(
            jax.vmap(_select)(done.is_done, start_state, done.state),
            jnp.where(done.is_done, 0.0, episode_return),
            jnp.where(done.is_done, 0, episode_length),
            envs.is_complete | done.is_done,
        )
        return (after, num_resets + done.is_done, totals), _transition(envs.state, done)

    carry = (envs, jnp.zeros(num_envs, jnp.int32), (jnp.zeros(()),) * 3)
    carry, trajectory = jax.lax.scan(step, carry, jax.random.split(step_key, num_steps))
    envs, _, (episodes, returns, lengths) = carry
    metrics = {"episodes": episodes, "return": returns / episodes, "episode_length": lengths / episodes}
    return envs, trajectory, metrics


def _transition(state: Any, done: Interaction) -> Trajectory:
    """Return the part of an interaction that learners need."""
    return Trajectory(
        state,
        done.action,
        done.distribution.log_prob(done.action),
        done.distribution.mean(),
        done.distribution.stddev(),
        done.outcome.reward,
        done.outcome.terminated,
        done.outcome.truncated,
        done.state,
        done.obs.mask,
    )


def spread_rows(tree: Any) -> Any:
    """Spread the rows of the tree over the devices that share environments, if there are several."""
    mesh = jax.sharding.get_abstract_mesh()
    num_devices = dict(mesh.shape).get(ENVS_AXIS, 1)

    def spread(x: Array) -> Array:
        is_even = num_devices > 1 and x.shape[0] % num_devices == 0
        return jax.lax.with_sharding_constraint(x, PartitionSpec(ENVS_AXIS)) if is_even else x

    return jax.tree.map(spread, tree)


def evaluate(key: Key, task: Any, policy: PolicyFn, num_envs: int) -> Metrics:
    """Evaluate the mean action over one episode in each of `num_envs` fresh environments.

    Returns are undiscounted. A metric of the task is averaged over the steps of an episode at which it is not NaN,
    then over the episodes that have such a step.
    """
    reset_key, step_key = jax.random.split(key)
    start = jax.vmap(task.reset)(jax.random.split(reset_key, num_envs))

    def step(carry: tuple, key: Key) -> tuple:
        state, is_running, returns, lengths, totals, counts = carry
        done = interact(key, task, policy, state, mean_action)
        metrics = done.outcome.metrics
        counted = {name: is_running & ~jnp.isnan(x) for name, x in metrics.items()}
        totals = {name: totals[name] + jnp.where(counted[name], x, 0.0) for name, x in metrics.items()}
        counts = {name: counts[name] + x for name, x in counted.items()}
        returns = returns + jnp.where(is_running, done.outcome.reward, 0.0)
        return (done.state, is_running & ~done.is_done, returns, lengths + is_running, totals, counts), None

    names = jax.eval_shape(lambda: interact(step_key, task, policy, start, mean_action).outcome).metrics
    zeros = dict.fromkeys(names, jnp.zeros(num_envs))
    carry = (start, jnp.ones(num_envs, bool), jnp.zeros(num_envs), jnp.zeros(num_envs), zeros, zeros)
    carry, _ = jax.lax.scan(step, carry, jax.random.split(step_key, task.episode_length))
    _, _, returns, lengths, totals, counts = carry
    means = {name: jnp.nanmean(total / counts[name]) for name, total in totals.items()}
    return {"return": returns.mean(), "return_std": returns.std(), "episode_length": lengths.mean()} | means


def _select(condition: Bool[Array, ""], on_true: Any, on_false: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), on_true, on_false)
