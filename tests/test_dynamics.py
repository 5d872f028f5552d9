import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxswarm.physics.dynamics import DYNAMICS, Acceleration, Velocity
from jaxswarm.physics.geometry import Plane, Torus
from jaxswarm.types import pytree

SIDE = 10.0


@pytree
class Agents:
    position: jax.Array
    heading: jax.Array
    velocity: jax.Array
    rounding: jax.Array


SPACES = [Plane(SIDE), Torus(SIDE)]


def simulate(name, is_torus, state, action):
    """Simulate the substeps of the thesis's program in float64; also return the velocity of the last displacement."""
    position, heading, velocity = (np.float64(x) for x in (state.position, state.heading, state.velocity))
    target = np.clip(np.float64(action), -1, 1) * [10, np.pi]
    for _ in range(10):
        velocity = 0.99 * velocity + 0.01 * target if name == "acceleration" else target
        velocity = np.clip(velocity, [-10, -np.pi], [10, np.pi])
        world_velocity = velocity[:, :1] * np.stack([np.cos(heading), np.sin(heading)], -1)
        position = position + 0.01 * world_velocity
        if is_torus:
            position = np.where(position < 0, position + SIDE, position)
            position = np.where(position > SIDE, position - SIDE, position)
        else:
            position = np.clip(position, 0, SIDE)
        heading = heading + 0.01 * velocity[:, 1]
    return position, heading, velocity, world_velocity


def random_agents(num_agents=200):
    """Draw agents, many of them close to a wall, with random speeds, and actions of which some exceed the bounds."""
    keys = jax.random.split(jax.random.key(0), 4)
    position = jax.random.uniform(keys[0], (num_agents, 2), maxval=SIDE)
    heading = jax.random.uniform(keys[1], (num_agents,), maxval=2 * math.pi)
    velocity = jax.random.uniform(keys[2], (num_agents, 2), minval=-1) * jnp.array([[10, math.pi]])
    return Agents(position, heading, velocity, jnp.zeros((num_agents, 5))), 1.3 * jax.random.uniform(
        keys[3], (num_agents, 2), minval=-1
    )


def agent_at_rest(x, y, heading):
    return Agents(jnp.array([[x, y]]), jnp.array([heading]), jnp.zeros((1, 2)), jnp.zeros((1, 5)))


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("name", DYNAMICS)
def test_a_step_is_ten_explicit_euler_steps(name, space):
    state, action = random_agents()
    position, heading, velocity, world_velocity = simulate(name, isinstance(space, Torus), state, action)
    moved = DYNAMICS[name]().move(space, state, action)
    np.testing.assert_allclose(moved.position, position, atol=5e-6)
    np.testing.assert_allclose(np.exp(1j * np.float64(moved.heading)), np.exp(1j * heading), atol=2e-6)
    np.testing.assert_allclose(moved.velocity, velocity, atol=5e-6)
    if name == "acceleration":
        np.testing.assert_allclose(
            Acceleration().world_velocity(moved.heading, moved.velocity), world_velocity, atol=2e-5
        )


@pytest.mark.parametrize("name", DYNAMICS)
def test_actions_are_clipped(name):
    state, action = random_agents()
    move = DYNAMICS[name]().move
    chosen, clipped = move(SPACES[0], state, action), move(SPACES[0], state, jnp.clip(action, -1, 1))
    jax.tree.map(np.testing.assert_array_equal, chosen, clipped)


def test_full_throttle_approaches_full_speed_with_damping():
    motion, state = Acceleration(), agent_at_rest(0.0, 0.0, 0.0)
    for step in range(1, 4):
        state = motion.move(Torus(SIDE), state, jnp.array([[1.0, -1.0]]))
        reached = 1 - 0.99 ** (10 * step)
        np.testing.assert_allclose(state.velocity, [[10 * reached, -math.pi * reached]], rtol=1e-5)


def test_speeds_do_not_pass_their_limits():
    motion = Acceleration(max_speed=2.0, max_turn_rate=1.0, max_acceleration=1000.0, max_turn_acceleration=1000.0)
    velocity = motion.move(Plane(SIDE), agent_at_rest(5.0, 5.0, 0.0), jnp.array([[1.0, -1.0]])).velocity
    np.testing.assert_array_equal(velocity, [[2, -1]])
    np.testing.assert_array_equal(motion.proprioception(velocity), [[1, -1]])


def test_without_action_speeds_decay():
    state = agent_at_rest(5.0, 5.0, 0.0).replace(velocity=jnp.array([[4.0, 2.0]]))
    moved = Acceleration().move(Torus(SIDE), state, jnp.zeros((1, 2)))
    np.testing.assert_allclose(moved.velocity, 0.99**10 * state.velocity, rtol=1e-5)


def test_walls_stop_agents_but_not_their_speed():
    state = agent_at_rest(9.9, 5.0, 0.0).replace(velocity=jnp.array([[10.0, 0.0]]))
    moved = Acceleration().move(Plane(SIDE), state, jnp.array([[1.0, 0.0]]))
    np.testing.assert_array_equal(moved.position, [[10, 5]])
    np.testing.assert_allclose(moved.velocity, [[10, 0]], rtol=1e-5)


def test_the_torus_lets_agents_through():
    moved = Velocity().move(Torus(SIDE), agent_at_rest(9.9, 5.0, 0.0), jnp.array([[1.0, 0.0]]))
    np.testing.assert_allclose(moved.position, [[0.9, 5]], atol=1e-5)


@pytest.mark.parametrize("max_turn_rate", [math.pi, 2 * math.pi])
def test_constant_commands_trace_a_regular_polygon(max_turn_rate):
    start, move = agent_at_rest(5.0, 5.0, 1.0), jax.jit(Velocity(max_turn_rate=max_turn_rate).move)
    num_steps = round(2 * math.pi / max_turn_rate / 0.1)
    state, corners = start, []
    for _ in range(num_steps):
        state = move(Torus(SIDE), state, jnp.array([[0.4, 1.0]]))
        corners.append(state.position)
    np.testing.assert_allclose(state.position, start.position, atol=1e-5)
    np.testing.assert_allclose(jnp.cos(state.heading - start.heading), [1], atol=1e-6)
    diameter = 0.04 / math.sin(max_turn_rate * 0.01 / 2)
    across = jnp.linalg.norm(corners[num_steps // 2 - 1] - start.position)
    np.testing.assert_allclose(across, diameter, rtol=1e-5)


def test_without_inertia_the_velocity_is_the_command_and_nobody_sees_it():
    moved = Velocity().move(Plane(SIDE), agent_at_rest(5.0, 5.0, 0.0), jnp.array([[-0.5, 0.25]]))
    heading, velocity = moved.heading, moved.velocity
    np.testing.assert_allclose(velocity, [[-5, math.pi / 4]])
    np.testing.assert_array_equal(Velocity().world_velocity(heading, velocity), jnp.zeros((1, 2)))
    assert Velocity().proprioception(velocity).shape == (1, 0)


def test_headings_stay_where_they_are_fine():
    state, move = agent_at_rest(5.0, 5.0, 3.0), jax.jit(Velocity().move)
    for _ in range(12):
        state = move(Plane(SIDE), state, jnp.ones((1, 2)))
        assert jnp.abs(state.heading).max() <= 3.1416
