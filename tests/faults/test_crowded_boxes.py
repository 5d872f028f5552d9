"""Crowded box worlds: robots that drive everything together neither press boxes into each other nor make them jump."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from overlaps import overlaps

from jaxswarm.physics import rigid2d
from jaxswarm.physics.contacts import MAX_SPEED
from jaxswarm.tasks.boxes import Assembly

NUM_ENVS, STEPS = 4, 200
CROWDS = {"corner": (40, 4, 1.0), "dense": (20, 12, 0.6), "swarm": (30, 4, 0.5)}  # robots, boxes, side in meters


def drive_to(goal, state):
    """Return commands [agents, 2] (m/s, rad/s) that turn all robots to their goals at full speed."""
    x, y = (goal - state.position).T
    error = jnp.atan2(y, x) - state.heading
    error = jnp.atan2(jnp.sin(error), jnp.cos(error))
    return jnp.stack([jnp.full_like(error, MAX_SPEED), jnp.clip(3 * error, -1.5, 1.5)], -1)


def wander(state, side, key):
    low, high = jnp.array([0.0, -1.5]), jnp.array([MAX_SPEED, 1.5])
    return jax.random.uniform(key, state.position.shape, minval=low, maxval=high)


def chase(state, side, key):
    return drive_to(state.box_position[jnp.arange(len(state.heading)) % len(state.box_heading)], state)


def gather(state, side, key):
    return drive_to(jnp.full_like(state.position, side / 2), state)


LIMITS = {wander: 2e-3, chase: 4e-3, gather: 4e-3}  # m; all robots drive at few boxes, or into one corner


def play(task, policy):
    """Return the states [envs, steps, ...] of some episodes, which include the start states."""

    def episode(key):
        def body(state, key):
            next_state = rigid2d.move(rigid2d.PRESETS[task.physics], task.side, state, policy(state, task.side, key))
            return next_state, state

        reset_key, key = jax.random.split(key)
        return jax.lax.scan(body, task.reset(reset_key), jax.random.split(key, STEPS))[1]

    return jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(0), NUM_ENVS))


@pytest.mark.slow
@pytest.mark.parametrize("physics", rigid2d.PRESETS)
@pytest.mark.parametrize("policy", LIMITS)
@pytest.mark.parametrize("crowd", CROWDS)
def test_crowds_neither_overlap_nor_throw_boxes(crowd, policy, physics):
    num_agents, num_boxes, side = CROWDS[crowd]
    states = play(Assembly(num_agents=num_agents, num_boxes=num_boxes, side=side, physics=physics), policy)
    found = overlaps(states, side)
    assert {kind: depth for kind, depth in found.items() if not depth < LIMITS[policy]} == {}
    moved = np.linalg.norm(np.diff(np.float64(states.box_position), axis=1), axis=-1)
    assert moved.max() <= 0.92 * MAX_SPEED  # m in a step of 1 s
    assert np.linalg.norm(states.box_velocity[..., :2], axis=-1).max() <= 0.92 * MAX_SPEED
