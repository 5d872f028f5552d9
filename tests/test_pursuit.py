"""Tests of pursuit against recorded episodes of the thesis's program, closed forms and the order of events.

`golden/pursuit.npz` holds numbered cases, see `golden/README.md`; index 0 of states is the start.
"""

import functools
import json
import math
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxswarm.tasks.pursuit import Pursuit

GOLDEN = np.load(pathlib.Path(__file__).parent / "golden" / "pursuit.npz")
CASES = json.loads(str(GOLDEN["meta_json"]))["cases"]
REWARD = {"min_distance": "distance", "count_catches": "catches"}
KEY = jax.random.key(0)
golden_cases = pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=[] if case["case"] in (0, 4, 7) else pytest.mark.slow) for case in CASES],
    ids=lambda case: f"{case['case']}-{case['n_agents']}v{case['n_evaders']}-{case['torus']}",
)


def record(case, name):
    return GOLDEN[f"c{case['case']:03d}_{name}"]


def recorded_task(case):
    return Pursuit(
        num_agents=case["n_agents"],
        num_evaders=case["n_evaders"],
        side=float(case["world_size"]),
        torus=case["torus"],
        visibility_radius=case["comm_radius"],
        evader_visibility_radius=case["obs_radius"],
        reward=REWARD[case["reward_mode"]],
    )


@jax.jit
def reset(task):
    return task.reset(KEY)


@jax.jit
def step(task, state, action):
    return task.step(KEY, state, action)


@jax.jit
def observe(task, state):
    return task.observe(state)


def place(task, **fields):
    return reset(task).replace(**{name: jnp.asarray(value, jnp.float32) for name, value in fields.items()})


@functools.partial(jax.jit, static_argnames="every")
def transitions(task, position, heading, evader_position, actions, every):
    """Simulate one step from each recorded state, and observe every `every`-th state."""

    def state(x):
        return task.reset(KEY).replace(position=x[0], heading=x[1], evader_position=x[2])

    recorded = (position, heading, evader_position)
    states = jax.tree.map(lambda x: x[:-1], recorded)
    steps = jax.vmap(lambda x, action: task.step(KEY, state(x), action))(states, actions)
    return *steps, jax.vmap(lambda x: task.observe(state(x)))(jax.tree.map(lambda x: x[::every], recorded))


@functools.cache
def replay(number):
    case = CASES[number]
    arrays = (record(case, name) for name in ("pos", "angle", "evader_pos", "actions"))
    return transitions(recorded_task(case), *arrays, every=case["obs_every"])


@golden_cases
def test_recorded_agents_move_as_recorded(case):
    states, _, _ = replay(case["case"])
    np.testing.assert_allclose(states.position, record(case, "pos")[1:], atol=1.6e-5, rtol=0)
    np.testing.assert_allclose(np.exp(1j * states.heading), np.exp(1j * record(case, "angle")[1:]), atol=1e-6)


@golden_cases
def test_recorded_evaders_move_as_recorded(case):
    """Evaders that restart at random are excluded. At a wall the original often finds no direction and stays."""
    states, _, _ = replay(case["case"])
    error = np.abs(states.evader_position - record(case, "evader_pos")[1:]).max(-1)
    is_compared = (record(case, "evader_dir") != 0).any(-1)
    if case["torus"]:
        assert is_compared.all()
    is_compared[record(case, "respawn_step"), record(case, "respawn_evader")] = False
    assert error[is_compared].max() < 2e-4


@golden_cases
def test_recorded_rewards_and_ends_are_reproduced(case):
    _, steps, _ = replay(case["case"])
    is_compared = (record(case, "evader_dir") != 0).any((1, 2)) | (case["reward_mode"] == "count_catches")
    np.testing.assert_allclose(steps.reward[is_compared], record(case, "reward")[is_compared], atol=2e-6)
    np.testing.assert_array_equal(steps.terminated[is_compared], record(case, "done")[is_compared])
    if case["reward_mode"] == "count_catches":
        np.testing.assert_array_equal(steps.reward, record(case, "caught"))


@golden_cases
def test_recorded_observations_are_reproduced(case):
    """The tolerance of bearings grows below a distance of one unit, where float32 positions are relatively coarser."""
    _, _, obs = replay(case["case"])
    num_agents, num_local = case["n_agents"], case["n_local"]
    sizes = [num_local, num_local + 6 * (num_agents - 1)]
    own, neighbors, evaders = np.split(record(case, "obs"), sizes, axis=-1)
    np.testing.assert_allclose(obs.own, own, atol=1e-6)
    # Recorded rows are in the order of their index, visible ones first; our neighbors are in cyclic order.
    cyclic = (np.arange(num_agents)[:, None] + np.arange(1, num_agents)) % num_agents
    in_order = np.broadcast_to(np.arange(case["n_evaders"]), (num_agents, case["n_evaders"]))
    for group, rows, index, radius in (
        (obs.groups["neighbors"], neighbors, cyclic, case["comm_radius"]),
        (obs.groups["evaders"], evaders, in_order, case["obs_radius"]),
    ):
        rows = rows.reshape(*group.mask.shape, -1)  # noqa: PLW2901
        order = np.argsort(np.where(group.mask, index, num_agents + 99), axis=-1, kind="stable")
        np.testing.assert_array_equal(np.take_along_axis(np.asarray(group.mask), order, 2), rows[..., -1] == 1)
        features = np.take_along_axis(np.asarray(group.features), order[..., None], 2)
        error = np.abs(features - rows[..., :-1])
        assert error[..., 0].max() < 1e-6
        assert (error[..., 1:] < 2e-6 + 1e-5 / np.maximum(rows[..., :1] * radius, 1e-3)).all()


def test_an_agent_sees_an_evader_as_the_formulas_say():
    task = Pursuit(num_agents=1, torus=False, visibility_radius=5.0, evader_visibility_radius=10.0)
    state = place(task, position=[[10, 10]], heading=[math.pi / 2], evader_position=[[13, 14]])
    obs = observe(task, state)
    np.testing.assert_allclose(obs.groups["evaders"].features[0, 0], [0.5, 0.8, 0.6], atol=1e-6)
    assert obs.groups["neighbors"].mask.shape == (1, 0)
    np.testing.assert_array_equal(obs.own, [[0, 0]])
    assert not observe(task.replace(evader_visibility_radius=4.9), state).groups["evaders"].mask.any()
    assert observe(task, place(task, position=[[10, 1]])).own[0, 1] == 1  # at a wall


@pytest.mark.parametrize("torus", [True, False])
def test_agents_at_one_place_see_each_other_in_the_direction_of_atan2_of_zeros(torus):
    task = Pursuit(num_agents=2, torus=torus)
    heading = np.array([0.3, 2.0])
    obs = observe(task, place(task, position=[[10, 10]] * 2, heading=heading, evader_position=[[10, 10]]))
    neighbors, evaders = obs.groups["neighbors"], obs.groups["evaders"]
    assert neighbors.mask.all()
    bearing = heading - math.atan2(0.0, 0.0)
    mine = np.stack([np.cos(bearing), np.sin(bearing)], -1)
    expected = np.concatenate([np.zeros((2, 1)), mine, mine[::-1]], -1)
    np.testing.assert_allclose(neighbors.features[:, 0], expected, atol=1e-6)
    np.testing.assert_allclose(evaders.features[:, 0], expected[:, :3], atol=1e-6)


def test_the_reward_is_the_smallest_distance_after_the_move():
    task = Pursuit(num_agents=2, num_evaders=1)
    state = place(task, position=[[20, 50], [50, 50]], heading=[0, 0], evader_position=[[60, 50]])
    state, outcome = step(task, state, jnp.ones((2, 2)) * jnp.array([[1.0, 0.0]]))
    np.testing.assert_allclose(state.position, [[21, 50], [51, 50]], atol=1e-5)
    distance = np.linalg.norm(state.evader_position[0] - np.array([51, 50]))
    np.testing.assert_allclose(outcome.reward, -distance / task.evader_visibility_radius, rtol=1e-5)
    assert outcome.reward > -0.5
    short_sighted = task.replace(evader_visibility_radius=5.0)
    assert step(short_sighted, state, jnp.zeros((2, 2)))[1].reward == -1  # the evader is farther away than that


def test_an_evader_is_twice_as_fast_as_an_agent_and_stays_in_its_world():
    task = Pursuit(num_agents=1, torus=False)
    state = place(task, position=[[50, 50]], evader_position=[[50, 60]])
    next_state, _ = step(task, state, jnp.zeros((1, 2)))
    np.testing.assert_allclose(next_state.evader_position, [[50, 62]], atol=1e-5)
    state = place(task, position=[[50, 90]], evader_position=[[50, 99]])
    next_state, _ = step(task, state, jnp.zeros((1, 2)))
    assert next_state.evader_position[0, 1] <= 100


def test_a_catch_ends_the_single_pursuit():
    task = Pursuit(
        num_agents=1, evader_visibility_radius=0.5, episode_length=3
    )  # the evader does not see the agent in time
    state = place(task, position=[[50, 50]], heading=[0], evader_position=[[52.9, 50]]).replace(time=jnp.array(1))
    forward = jnp.array([[1.0, 0.0]])
    state, outcome = step(task, state, forward)
    assert not outcome.terminated  # the distance is 1.9 units
    assert np.isnan(outcome.metrics["capture_time"])
    _, outcome = step(task, state, forward)
    assert outcome.terminated
    assert not outcome.truncated  # a catch in the last step terminates the episode
    assert outcome.metrics["caught"] == outcome.metrics["catches"] == 1
    assert outcome.metrics["capture_time"] == 2


def test_evaders_caught_start_anew_and_move_in_the_same_step():
    task = Pursuit(num_agents=3, num_evaders=2, reward="catches")
    state = place(task, position=[[50, 50], [51, 50], [90, 90]], evader_position=[[50.5, 50.5], [10, 10]])
    state = state.replace(evader_age=jnp.array([7, 30]), catches=jnp.array(3))
    next_state, outcome = step(task, state, jnp.zeros((3, 2)))
    assert outcome.reward == 1  # two agents that catch one evader get one reward
    assert outcome.metrics["capture_time"] == 7
    np.testing.assert_array_equal(next_state.evader_age, [1, 31])
    assert next_state.catches == 4
    moved = np.linalg.norm(next_state.evader_position - state.evader_position, axis=-1)
    assert moved[0] > 2.1
    np.testing.assert_allclose(moved[1], 2, rtol=1e-5)


def test_a_catch_counts_in_the_step_after():
    """An evader within 2 units after the agents' move is rewarded in the next step, even if it escapes in that step."""
    task = Pursuit(num_agents=1, num_evaders=1, reward="catches", evader_visibility_radius=0.5)
    state = place(task, position=[[50, 50]], heading=[0], evader_position=[[52.5, 50]])
    forward = jnp.array([[1.0, 0.0]])
    state, outcome = step(task, state, forward)
    assert outcome.reward == 0
    assert np.isnan(outcome.metrics["capture_time"])
    state, outcome = step(task, state, -forward)
    assert outcome.reward == 1
    assert step(task, state, forward)[1].reward == 0


def test_evaders_that_start_anew_are_spread_over_the_world():
    task = Pursuit(num_agents=1, num_evaders=1, reward="catches", evader_visibility_radius=0.5)
    state = place(task, position=[[50, 50]], evader_position=[[51, 50]])
    new = jax.vmap(lambda key: task.step(key, state, jnp.zeros((1, 2)))[0].evader_position[0])
    position = jax.jit(new)(jax.random.split(KEY, 500))
    assert position.min() >= 5
    assert position.max() <= 95
    np.testing.assert_allclose(position.mean(0), 50, atol=4)
    np.testing.assert_allclose(position.std(0), 90 / np.sqrt(12), atol=2)


def test_metrics_of_an_episode_are_given_at_its_end():
    task = Pursuit(num_agents=2, num_evaders=1, episode_length=2)
    state = place(task, position=[[50, 50], [50, 60]], evader_position=[[80, 50]])
    state, outcome = step(task, state, jnp.zeros((2, 2)))
    assert np.isnan(outcome.metrics["caught"])
    assert np.isnan(outcome.metrics["catches"])
    distance = np.linalg.norm(np.asarray(state.evader_position) - np.array([[50, 50], [50, 60]]), axis=-1)
    np.testing.assert_allclose(outcome.metrics["evader_distance"], distance.mean(), rtol=1e-5)
    _, outcome = step(task, state, jnp.zeros((2, 2)))
    assert outcome.truncated
    assert outcome.metrics["caught"] == outcome.metrics["catches"] == 0


def test_the_order_of_agents_and_evaders_does_not_matter():
    task = Pursuit(num_agents=5, num_evaders=3, visibility_radius=40.0, evader_visibility_radius=50.0)
    state, action = reset(task), jax.random.normal(KEY, (5, 2))
    order, evader_order = jnp.array([3, 0, 4, 1, 2]), jnp.array([2, 0, 1])
    permuted = state.replace(
        position=state.position[order],
        heading=state.heading[order],
        evader_position=state.evader_position[evader_order],
    )

    def by_distance(obs, group):
        features = obs.groups[group].features
        return jnp.take_along_axis(features, jnp.argsort(features[..., 0], axis=-1)[..., None], 1)

    obs, permuted_obs = observe(task, state), observe(task, permuted)
    for group in ("neighbors", "evaders"):
        np.testing.assert_allclose(by_distance(permuted_obs, group), by_distance(obs, group)[order], atol=1e-6)
    next_state, outcome = step(task, state, action)
    permuted_next, permuted_outcome = step(task, permuted, action[order])
    np.testing.assert_allclose(permuted_next.evader_position, next_state.evader_position[evader_order], atol=1e-5)
    np.testing.assert_allclose(permuted_outcome.reward, outcome.reward, rtol=1e-5)


@pytest.mark.parametrize(
    ("field", "value", "accepted"),
    [
        ("num_agents", 0, "an integer >= 1"),
        ("num_evaders", 0, "an integer >= 1"),
        ("evader_visibility_radius", 0.0, "a positive finite number"),
        ("visibility_radius", -1.0, "a positive finite number"),
        ("reward", "min_distance", "one of distance, catches"),
        ("max_neighbors", 0, "null or an integer >= 1"),
        ("active_agents", (3, 2), r"null or a pair \[low, high\] of integers from 1 to 10"),
        ("active_agents", (3, 11), r"null or a pair \[low, high\] of integers from 1 to 10"),
        ("active_evaders", (0, 1), r"null or a pair \[low, high\] of integers from 1 to 1"),
    ],
)
def test_impossible_fields_are_named_with_what_is_accepted(field, value, accepted):
    with pytest.raises(ValueError, match=f"{field}: must be {accepted}.*, got "):
        Pursuit(**{field: value})
