"""Tests of all tasks of point agents: inactive agents do not exist, and lists of nearest neighbors change nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxswarm.tasks import TASKS

NUM_AGENTS, NUM_ACTIVE = 7, 4
KEY = jax.random.key(5)
SWARMS = ["rendezvous", "pursuit"]
every_swarm = pytest.mark.parametrize("name", SWARMS)


@jax.jit
def reset(task, key=KEY):
    return task.reset(key)


@jax.jit
def play(task, state, action):
    """Return the outcome of a step and the observation after it."""
    state, outcome = task.step(KEY, state, action)
    return outcome, task.observe(state)


def make_task(name, **fields):
    return TASKS[name](num_agents=NUM_AGENTS, **fields)


def reset_with_active(task, num_active):
    return reset(task).replace(active_agents=jnp.array(num_active))


def sorted_features(group, agent):
    """Return the features of the visible entities of an agent, in lexicographic order."""
    features = np.asarray(group.features[agent])[np.asarray(group.mask[agent])]
    return features[np.lexsort(features.T.round(3))]


def assert_same_observation(obs, other, num_agents):
    np.testing.assert_allclose(obs.own[:num_agents], other.own[:num_agents], atol=1e-6)
    for name, group in obs.groups.items():
        for agent in range(num_agents):
            np.testing.assert_allclose(
                sorted_features(group, agent), sorted_features(other.groups[name], agent), atol=1e-5
            )


def assert_same_outcome(outcome, other):
    np.testing.assert_allclose(outcome.reward, other.reward, rtol=1e-5)
    for name, metric in outcome.metrics.items():
        np.testing.assert_allclose(metric, other.metrics[name], rtol=1e-4)


@pytest.mark.parametrize(("name", "max_neighbors"), [("rendezvous", NUM_AGENTS), ("pursuit", None)])
def test_a_swarm_with_absent_agents_is_a_smaller_swarm(name, max_neighbors):
    large = make_task(name, active_agents=(2, NUM_AGENTS), max_neighbors=max_neighbors)
    small = TASKS[name](num_agents=NUM_ACTIVE)
    state = reset_with_active(large, NUM_ACTIVE)
    fields = ("position", "heading", "velocity")
    same = {field: getattr(state, field)[:NUM_ACTIVE] for field in fields}
    if name == "pursuit":
        same["evader_position"] = state.evader_position
    action = jax.random.normal(KEY, (NUM_AGENTS, 2))
    outcome, obs = play(large, state, action)
    expected, expected_obs = play(small, reset(small).replace(**same), action[:NUM_ACTIVE])
    assert_same_outcome(expected, outcome)
    assert_same_observation(expected_obs, obs, NUM_ACTIVE)
    np.testing.assert_array_equal(obs.mask, np.arange(NUM_AGENTS) < NUM_ACTIVE)
    assert expected_obs.mask is None


@pytest.mark.parametrize(("name", "max_neighbors"), [("rendezvous", None), ("pursuit", 3)])
def test_absent_agents_have_no_influence(name, max_neighbors):
    task = make_task(name, active_agents=(2, NUM_AGENTS), max_neighbors=max_neighbors)
    state, action = reset_with_active(task, NUM_ACTIVE), jnp.zeros((NUM_AGENTS, 2))
    elsewhere = state.replace(
        position=state.position.at[NUM_ACTIVE:].set(50.0), heading=state.heading.at[NUM_ACTIVE:].set(1.0)
    )
    one = play(task, state, action)
    two = play(task, elsewhere, action.at[NUM_ACTIVE:].set(1.0))
    np.testing.assert_array_equal(one[0].reward, two[0].reward)
    present = jax.tree.map(lambda x: x[:NUM_ACTIVE], (one[1], two[1]))
    jax.tree.map(np.testing.assert_array_equal, *present)


@pytest.mark.parametrize(("name", "torus"), [("rendezvous", True), ("pursuit", False)])
@pytest.mark.parametrize("radius", [15.0, 40.0, 200.0])
def test_lists_of_all_neighbors_change_nothing(name, torus, radius):
    dense = make_task(name, torus=torus, visibility_radius=radius)
    listed = dense.replace(max_neighbors=NUM_AGENTS - 1)
    state, action = reset(dense), jax.random.normal(KEY, (NUM_AGENTS, 2))
    (expected, expected_obs), (outcome, obs) = play(dense, state, action), play(listed, state, action)
    assert_same_outcome(expected, outcome)
    assert outcome.metrics["unseen_neighbors"] == 0
    assert_same_observation(expected_obs, obs, NUM_AGENTS)


@pytest.mark.slow
@every_swarm
def test_neighbors_without_room_are_reported(name):
    task = make_task(name, max_neighbors=2)
    outcome, obs = play(task, reset(task), jnp.zeros((NUM_AGENTS, 2)))
    assert outcome.metrics["unseen_neighbors"] == NUM_AGENTS - 1 - 2
    assert obs.groups["neighbors"].mask.sum() == 2 * NUM_AGENTS
    np.testing.assert_allclose(obs.own[:, 0], 1)  # all neighbors are counted


@pytest.mark.slow
@every_swarm
def test_numbers_of_agents_are_drawn_between_their_bounds(name):
    task = make_task(name, active_agents=(3, 5))
    states = jax.vmap(reset, (None, 0))(task, jax.random.split(KEY, 200))
    assert np.unique(states.active_agents).tolist() == [3, 4, 5]


def test_numbers_of_evaders_are_drawn_and_absent_ones_are_neither_seen_nor_caught():
    task = TASKS["pursuit"](num_agents=3, num_evaders=4, active_evaders=(1, 4), reward="catches")
    states = jax.vmap(reset, (None, 0))(task, jax.random.split(KEY, 200))
    assert np.unique(states.active_evaders).tolist() == [1, 2, 3, 4]
    state = reset(task).replace(active_evaders=jnp.array(2))
    state = state.replace(evader_position=jnp.broadcast_to(state.position[:1], (4, 2)))
    outcome, obs = play(task, state, jnp.zeros((3, 2)))
    assert outcome.reward == 2
    np.testing.assert_array_equal(obs.groups["evaders"].mask, [[True, True, False, False]] * 3)
