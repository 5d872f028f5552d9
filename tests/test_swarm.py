"""What holds for every swarm of points: absent agents do not exist, and lists of the nearest change nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxswarm.tasks import TASKS

ROOM, PRESENT = 7, 4
KEY = jax.random.key(5)
SWARMS = ["rendezvous", "pursuit"]
every_swarm = pytest.mark.parametrize("name", SWARMS)


@jax.jit
def reset(task, key=KEY):
    return task.reset(key)


@jax.jit
def play(task, state, action):
    """The outcome of a step, and what is observed after it."""
    state, outcome = task.step(KEY, state, action)
    return outcome, task.observe(state)


def crowded(name, **fields):
    return TASKS[name](num_agents=ROOM, **fields)


def with_absent(task, number):
    return reset(task).replace(active_agents=jnp.array(number))


def rows(group, agent):
    """Features of the visible entities of an agent, in an order of their own."""
    features = np.asarray(group.features[agent])[np.asarray(group.mask[agent])]
    return features[np.lexsort(features.T.round(3))]


def assert_same_sight(obs, other, num_agents):
    np.testing.assert_allclose(obs.own[:num_agents], other.own[:num_agents], atol=1e-6)
    for name, group in obs.groups.items():
        for agent in range(num_agents):
            np.testing.assert_allclose(rows(group, agent), rows(other.groups[name], agent), atol=1e-5)


def assert_same_outcome(outcome, other):
    np.testing.assert_allclose(outcome.reward, other.reward, rtol=1e-5)
    for name, metric in outcome.metrics.items():
        np.testing.assert_allclose(metric, other.metrics[name], rtol=1e-4)


@pytest.mark.parametrize(("name", "max_neighbors"), [("rendezvous", ROOM), ("pursuit", None)])
def test_a_swarm_with_absent_agents_is_a_smaller_swarm(name, max_neighbors):
    large = crowded(name, active_agents=(2, ROOM), max_neighbors=max_neighbors)
    small = TASKS[name](num_agents=PRESENT)
    state = with_absent(large, PRESENT)
    fields = ("position", "heading", "velocity")
    same = {field: getattr(state, field)[:PRESENT] for field in fields}
    if name == "pursuit":
        same["evader_position"] = state.evader_position
    action = jax.random.normal(KEY, (ROOM, 2))
    outcome, obs = play(large, state, action)
    expected, expected_obs = play(small, reset(small).replace(**same), action[:PRESENT])
    assert_same_outcome(expected, outcome)
    assert_same_sight(expected_obs, obs, PRESENT)
    np.testing.assert_array_equal(obs.mask, np.arange(ROOM) < PRESENT)
    assert expected_obs.mask is None


@pytest.mark.parametrize(("name", "max_neighbors"), [("rendezvous", None), ("pursuit", 3)])
def test_absent_agents_have_no_influence(name, max_neighbors):
    task = crowded(name, active_agents=(2, ROOM), max_neighbors=max_neighbors)
    state, action = with_absent(task, PRESENT), jnp.zeros((ROOM, 2))
    elsewhere = state.replace(
        position=state.position.at[PRESENT:].set(50.0), heading=state.heading.at[PRESENT:].set(1.0)
    )
    one = play(task, state, action)
    two = play(task, elsewhere, action.at[PRESENT:].set(1.0))
    np.testing.assert_array_equal(one[0].reward, two[0].reward)
    present = jax.tree.map(lambda x: x[:PRESENT], (one[1], two[1]))
    jax.tree.map(np.testing.assert_array_equal, *present)


@pytest.mark.parametrize(("name", "torus"), [("rendezvous", True), ("pursuit", False)])
@pytest.mark.parametrize("radius", [15.0, 40.0, 200.0])
def test_lists_of_all_neighbours_change_nothing(name, torus, radius):
    dense = crowded(name, torus=torus, visibility_radius=radius)
    listed = dense.replace(max_neighbors=ROOM - 1)
    state, action = reset(dense), jax.random.normal(KEY, (ROOM, 2))
    (expected, expected_obs), (outcome, obs) = play(dense, state, action), play(listed, state, action)
    assert_same_outcome(expected, outcome)
    assert outcome.metrics["unseen_neighbors"] == 0
    assert_same_sight(expected_obs, obs, ROOM)


@pytest.mark.slow
@every_swarm
def test_neighbours_without_room_are_reported(name):
    task = crowded(name, max_neighbors=2)
    outcome, obs = play(task, reset(task), jnp.zeros((ROOM, 2)))
    assert outcome.metrics["unseen_neighbors"] == ROOM - 1 - 2
    assert obs.groups["neighbors"].mask.sum() == 2 * ROOM
    np.testing.assert_allclose(obs.own[:, 0], 1)  # all are counted


@pytest.mark.slow
@every_swarm
def test_numbers_of_agents_are_drawn_between_their_bounds(name):
    task = crowded(name, active_agents=(3, 5))
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
