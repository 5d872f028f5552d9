"""The gymnax adapter of every task agrees with the task itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxswarm
from jaxswarm.bridges.gymnax import Gymnax
from jaxswarm.tasks import TASKS

SIZES = {"num_agents": 3, "episode_length": 3}


def assert_same(one, other):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), one, other)


@pytest.mark.parametrize("name", TASKS)
def test_environments_restart_and_show_what_was_before(name):
    env = Gymnax(jaxswarm.make(name, **SIZES))
    action = jnp.full((3, env.num_actions), 0.5)

    def step(state, key):
        out = env.step(key, state, action)
        return out[1], (*out, env.task.observe(out[1]), env.task.step(jax.random.split(key)[0], state, action))

    _, start = env.reset(jax.random.key(1))
    _, steps = jax.lax.scan(step, start, jax.random.split(jax.random.key(0), 5))
    obs, state, reward, terminated, truncated, info, expected_obs, (final_state, outcome) = steps
    assert truncated.tolist() == [False, False, True, False, False]
    assert state.time.tolist() == [1, 2, 0, 1, 2]
    assert_same(obs, expected_obs)
    assert_same((reward, terminated, truncated), (outcome.reward, outcome.terminated, outcome.truncated))
    assert_same(info.pop("final_observation"), jax.vmap(env.task.observe)(final_state))
    assert_same(info, outcome.metrics | {"terminated": terminated, "truncated": truncated})
    moved = final_state.position != state.position
    assert moved.any((1, 2)).tolist() == truncated.tolist()


def test_numbers_of_the_task_are_parameters():
    env = Gymnax(jaxswarm.make("rendezvous", **SIZES))
    key, state, action = jax.random.key(0), env.reset(jax.random.key(1))[1], jnp.zeros((3, 2))

    def seen(radius):
        params = env.default_params.replace(visibility_radius=radius)
        return env.step(key, state, action, params)[0].groups["neighbors"].mask.sum()

    assert jax.jit(jax.vmap(seen))(jnp.array([0.0, 1e6])).tolist() == [0, 6]
    assert_same(env.step(key, state, 10 + action), env.step(key, state, 1 + action))
    assert hash(env) is not None
