"""Rollouts: restarts, truncation and statistics of complete episodes, on a task with known results."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxswarm import rollout
from jaxswarm.distributions import gaussian
from jaxswarm.types import Entities, Observation, Step, pytree, static


@pytree
class Clock:
    start: jax.Array
    time: jax.Array


@pytree
class Ticking:
    """One agent with reward 1 + action; episodes terminate after `length` steps or are truncated at the time limit."""

    length: int = 100
    num_agents: int = static(default=1)
    episode_length: int = static(default=4)
    action_dim: ClassVar[int] = 1

    def reset(self, key):
        return Clock(jax.random.uniform(key), jnp.zeros((), jnp.int32))

    def step(self, key, state, action):
        state = state.replace(time=state.time + 1)
        is_late = state.time >= self.episode_length
        is_over = state.time >= self.length
        time = state.time.astype(jnp.float32)
        metrics = {"time": time, "end": jnp.where(is_late | is_over, time, jnp.nan), "nothing": jnp.array(jnp.nan)}
        return state, Step(1 + action[0, 0], is_over, is_late, metrics)

    def observe(self, state):
        group = Entities(jnp.zeros((1, 0, 1)), jnp.zeros((1, 0), bool))
        return Observation(state.time.astype(jnp.float32).reshape(1, 1), {"neighbors": group})


def policy(mean):
    return lambda obs: gaussian(jnp.full((*obs.own.shape[:-1], 1), mean), jnp.full((1, 1, 1), -20.0))


@pytest.fixture(scope="module")
def collected():
    envs = rollout.start(jax.random.key(0), Ticking(), 3, is_desynchronized=False)
    return rollout.collect(jax.random.key(1), Ticking(), policy(0.0), envs, 10, reset_pool=2)


def test_environments_restart_after_the_last_step(collected):
    envs, trajectory, _ = collected
    np.testing.assert_array_equal(trajectory.state.time[:, 0], [0, 1, 2, 3, 0, 1, 2, 3, 0, 1])
    np.testing.assert_array_equal(trajectory.truncated[:, 0], [0, 0, 0, 1, 0, 0, 0, 1, 0, 0])
    np.testing.assert_array_equal(trajectory.final_state.time[:, 0], [1, 2, 3, 4, 1, 2, 3, 4, 1, 2])
    np.testing.assert_array_equal(envs.state.time, 2)


def test_start_states_are_fresh(collected):
    _, trajectory, _ = collected
    starts = trajectory.state.start[jnp.array([0, 4, 8])].reshape(-1)
    assert len(np.unique(starts)) == 9


def test_only_whole_episodes_are_counted(collected):
    _, _, metrics = collected
    assert metrics["episodes"] == 6
    np.testing.assert_allclose(metrics["return"], 4.0, rtol=1e-5)
    np.testing.assert_allclose(metrics["episode_length"], 4.0)
    envs = rollout.start(jax.random.key(0), Ticking(), 50, is_desynchronized=True)
    _, trajectory, metrics = rollout.collect(jax.random.key(1), Ticking(), policy(0.0), envs, 4, reset_pool=1)
    assert trajectory.truncated.sum() == 50
    assert metrics["episodes"] == (envs.state.time == 0).sum() * 0  # their first steps are unknown
    assert np.isnan(metrics["return"])


def test_episodes_go_on_across_rollouts(collected):
    envs, _, _ = collected
    _, trajectory, metrics = rollout.collect(jax.random.key(2), Ticking(), policy(0.0), envs, 3, reset_pool=1)
    np.testing.assert_array_equal(trajectory.state.time[:, 0], [2, 3, 0])
    np.testing.assert_allclose(metrics["return"], 4.0, rtol=1e-5)


def test_actions_are_clipped_for_the_world_only():
    envs = rollout.start(jax.random.key(0), Ticking(), 3, is_desynchronized=False)
    _, trajectory, _ = rollout.collect(jax.random.key(1), Ticking(), policy(3.0), envs, 2, reset_pool=1)
    np.testing.assert_allclose(trajectory.action, 3.0, rtol=1e-5)
    np.testing.assert_allclose(trajectory.reward, 2.0)


@pytest.mark.parametrize(("length", "steps"), [(100, 4), (2, 2)])
def test_evaluation_plays_one_whole_episode_in_each_world(length, steps):
    metrics = rollout.evaluate(jax.random.key(0), Ticking(length), policy(0.5), 3)
    expected = {
        "return": 1.5 * steps,
        "return_std": 0.0,
        "episode_length": steps,
        "time": (steps + 1) / 2,
        "end": steps,
        "nothing": float("nan"),
    }
    assert {name: float(x) for name, x in metrics.items()} == pytest.approx(expected, nan_ok=True)
