"""Tests of rendezvous against recorded episodes of the thesis's program, closed forms and symmetries.

`golden/rendezvous.npz` holds numbered cases: for case k `cKKK_actions, pos, angle, p_vel, reward` at every step, as
float32, and `cKKK_obs` at every `obs_every`-th; index 0 is the start. `meta_json` describes the cases.
"""

import functools
import json
import pathlib
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxswarm.physics.geometry import bearing, direction, norm, unit
from jaxswarm.physics.neighbors import Neighborhood
from jaxswarm.tasks.rendezvous import Rendezvous, State

GOLDEN = np.load(pathlib.Path(__file__).parent / "golden" / "rendezvous.npz")
CASES = json.loads(str(GOLDEN["meta_json"]))["cases"]
KEY = jax.random.key(0)
golden_cases = pytest.mark.parametrize(
    "case", CASES, ids=lambda case: f"{case['case']}-{case['n_agents']}-{case['dynamics']}-{case['torus']}"
)


def record(case, name):
    return GOLDEN[f"c{case['case']:03d}_{name}"]


def recorded_task(case):
    return Rendezvous(
        num_agents=case["n_agents"],
        side=float(case["world_size"]),
        torus=case["torus"],
        visibility_radius=case["comm_radius"],
        dynamics={"unicycle": "velocity", "unicycle_acc": "acceleration"}[case["dynamics"]],
        relative_velocity="thesis",
    )


def recorded_states(case):
    """Return the states of all steps; velocities are recorded only for agents with inertia, which need them."""
    position, heading = record(case, "pos"), record(case, "angle")
    has_velocity = case["dynamics"] == "unicycle_acc"
    velocity = record(case, "p_vel") if has_velocity else np.zeros_like(position)
    time = jnp.arange(case["steps"] + 1)
    rounding, active = jnp.zeros((*position.shape[:2], 5)), jnp.full(time.shape, case["n_agents"])
    return State(jnp.array(position), jnp.array(heading), jnp.array(velocity), rounding, active, time)


def at(states, index):
    return jax.tree.map(lambda leaf: leaf[index], states)


@jax.jit
def transitions(task, states, actions):
    """Simulate one step from each recorded state."""
    return jax.vmap(lambda state, action: task.step(KEY, state, action))(at(states, slice(-1)), actions)


@jax.jit
def replay(task, states, actions):
    """Simulate all steps from the first state."""

    def body(state, action):
        state, step = task.step(KEY, state, action)
        return state, (state, step.reward)

    return jax.lax.scan(body, at(states, 0), actions)[1]


@functools.partial(jax.jit, static_argnames="every")
def observations(task, states, every):
    return jax.vmap(task.observe)(at(states, slice(None, None, every)))


@jax.jit
def observe(task, state):
    return task.observe(state)


@jax.jit
def step(task, state, action):
    return task.step(KEY, state, action)


def turn(heading):
    return np.exp(1j * np.float64(heading))


@golden_cases
def test_each_recorded_transition_is_reproduced(case):
    expected = recorded_states(case)
    states, steps = transitions(recorded_task(case), expected, record(case, "actions"))
    np.testing.assert_allclose(states.position, expected.position[1:], atol=1.6e-5, rtol=0)  # 2 units of float32 at 100
    np.testing.assert_allclose(turn(states.heading), turn(expected.heading[1:]), atol=1e-6)
    np.testing.assert_allclose(steps.reward, record(case, "reward"), atol=2e-6)
    if case["dynamics"] == "unicycle_acc":
        np.testing.assert_allclose(states.velocity, expected.velocity[1:], atol=5e-6)


@golden_cases
def test_recorded_episodes_are_reproduced(case):
    expected = recorded_states(case)
    states, rewards = replay(recorded_task(case), expected, record(case, "actions"))
    np.testing.assert_allclose(states.position, expected.position[1:], atol=5e-5, rtol=0)
    np.testing.assert_allclose(turn(states.heading), turn(expected.heading[1:]), atol=5e-6)
    np.testing.assert_allclose(rewards, record(case, "reward"), atol=2e-6)
    if case["dynamics"] == "unicycle_acc":
        np.testing.assert_allclose(states.velocity, expected.velocity[1:], atol=1e-4)


@golden_cases
def test_recorded_observations_are_reproduced(case):
    """The tolerance of bearings grows below a distance of one unit, where float32 positions are relatively coarser."""
    every, num_local, num_agents = case["obs_every"], case["n_local"], case["n_agents"]
    obs = observations(recorded_task(case), recorded_states(case), every)
    own, rows = np.split(record(case, "obs"), [num_local], axis=-1)
    rows = rows.reshape(*own.shape[:2], num_agents - 1, 9)
    neighbors = obs.groups["neighbors"]
    features, mask = np.asarray(neighbors.features), np.asarray(neighbors.mask)

    # Recorded neighbors are in the order of their index, visible ones first; ours are in cyclic order after the agent.
    index = (np.arange(num_agents)[:, None] + np.arange(1, num_agents)) % num_agents
    order = np.argsort(np.where(mask, index, num_agents), axis=-1, kind="stable")
    features, mask = np.take_along_axis(features, order[..., None], 2), np.take_along_axis(mask, order, 2)

    np.testing.assert_allclose(obs.own, own, atol=1e-6)
    np.testing.assert_array_equal(mask, rows[..., 8] == 1)
    distance = rows[..., :1] * case["world_size"] * np.sqrt(2)
    deviation = np.abs(features - rows[..., :8])
    assert (deviation[..., :1] < 1e-6).all()
    assert (deviation[..., 1:5] < 2e-6 + 1e-5 / np.maximum(distance, 1e-3)).all()
    assert (deviation[..., 5:7] < 5e-5 + 1e-5 * np.abs(rows[..., 5:7])).all()  # features of up to 100
    assert (deviation[..., 7] < 1e-6).all()


def test_relative_velocities_of_the_thesis_are_100_times_the_normalized():
    task = Rendezvous(num_agents=4)
    state = task.reset(KEY).replace(velocity=jax.random.normal(KEY, (4, 2)))
    normalized, thesis = (
        np.asarray(observe(task.replace(relative_velocity=scale), state).groups["neighbors"].features)
        for scale in ("normalized", "thesis")
    )
    np.testing.assert_allclose(thesis, normalized * np.where(np.isin(range(8), (5, 6)), 100, 1), rtol=1e-5)


def test_two_agents_see_each_other_as_the_formulas_say():
    task = Rendezvous(num_agents=2, visibility_radius=5.0)
    state = State(
        position=jnp.array([[10.0, 10.0], [13.0, 14.0]]),
        heading=jnp.array([0.0, jnp.pi / 2]),
        velocity=jnp.array([[2.0, 0.0], [4.0, jnp.pi / 2]]),
        rounding=jnp.zeros((2, 5)),
        active_agents=jnp.array(2),
        time=jnp.array(0),
    )
    assert not observe(task, state).groups["neighbors"].mask.any()  # the distance is exactly 5.0
    obs = observe(task.replace(visibility_radius=5.1), state)
    features = obs.groups["neighbors"].features
    np.testing.assert_allclose(obs.own, [[1, 0.2, 0], [1, 0.4, 0.5]], atol=1e-6)
    last_turn = np.pi / 200
    velocity = (np.array([2.0, 0.0]) - 4 * np.array([np.sin(last_turn), np.cos(last_turn)])) / 20
    distance, to_my_left, behind_its_left = 5 / (100 * np.sqrt(2)), [0.6, -0.8], [-0.8, -0.6]
    np.testing.assert_allclose(features[0, 0], [distance, *to_my_left, *behind_its_left, *velocity, 0], atol=1e-6)
    np.testing.assert_allclose(features[1, 0], [distance, *behind_its_left, *to_my_left, *-velocity, 0], atol=1e-6)


@pytest.mark.parametrize("torus", [False, True])
def test_the_order_of_agents_does_not_matter(torus):
    task = Rendezvous(num_agents=6, torus=torus, visibility_radius=40.0)
    state = task.reset(KEY).replace(velocity=jax.random.normal(KEY, (6, 2)))
    action = jax.random.normal(KEY, (6, 2))
    order = jnp.array([3, 0, 5, 1, 4, 2])
    permuted = jax.tree.map(lambda x: x[order] if x.ndim else x, state)

    def by_distance(obs):
        features = obs.groups["neighbors"].features
        order = jnp.argsort(features[..., 0], axis=-1)
        return jnp.take_along_axis(features, order[..., None], 1)

    obs, permuted_obs = observe(task, state), observe(task, permuted)
    np.testing.assert_allclose(permuted_obs.own, obs.own[order], atol=1e-6)
    np.testing.assert_allclose(by_distance(permuted_obs), by_distance(obs)[order], atol=1e-6)
    outcome, permuted_outcome = step(task, state, action)[1], step(task, permuted, action[order])[1]
    np.testing.assert_allclose(permuted_outcome.reward, outcome.reward, rtol=1e-6)


def test_a_torus_has_no_center():
    task = Rendezvous(num_agents=5, torus=True, visibility_radius=40.0)
    state = task.reset(KEY)
    shifted = state.replace(position=jnp.mod(state.position + jnp.array([[37.0, 81.0]]), 100))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), observe(task, state), observe(task, shifted))


def test_agents_at_one_place_do_not_see_each_other():
    task = Rendezvous(num_agents=3)
    state = task.reset(KEY)
    state = state.replace(position=state.position.at[1].set(state.position[0]))
    neighbors = observe(task, state).groups["neighbors"]
    np.testing.assert_array_equal(neighbors.mask, [[False, True], [True, False], [True, True]])
    np.testing.assert_array_equal(neighbors.features[~neighbors.mask], 0)


@pytest.mark.parametrize("num_agents", [2, 7, 20])
def test_the_reward_is_the_mean_distance_and_a_price_of_action(num_agents):
    task = Rendezvous(num_agents=num_agents, visibility_radius=50.0)
    action = 2 * jax.random.normal(KEY, (num_agents, 2))  # the penalty is that of the unclipped action
    state, outcome = step(task, task.reset(KEY), action)
    difference = np.float64(state.position)[:, None] - np.float64(state.position)
    distance = np.linalg.norm(difference, axis=-1)[np.triu_indices(num_agents, 1)]
    expected = -np.minimum(distance, 50).mean() / 50 - 0.001 * np.square(np.float64(action)).mean()
    np.testing.assert_allclose(outcome.reward, expected, rtol=1e-5)
    np.testing.assert_allclose(outcome.metrics["distance"], np.minimum(distance, 50).mean(), rtol=1e-5)


def test_a_swarm_of_more_agents_than_pairs_can_be_counted():
    """50 000 agents have 2.5e9 ordered pairs, and int32 ends at 2.1e9. A stub replaces the neighbor search."""
    spread = jnp.full(50_000, 50_000.0)
    task = Rendezvous(num_agents=50_000)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            Rendezvous, "around", lambda self, state: Neighborhood(jnp.zeros(50_000, jnp.int32), spread, None)
        )
        _, outcome = task.step(KEY, task.reset(KEY), jnp.zeros((50_000, 2)))
    np.testing.assert_allclose(outcome.reward, -1 / task.visibility_radius, rtol=1e-3)


def test_starts_are_uniform_and_at_rest():
    states = jax.vmap(Rendezvous(side=60.0).reset)(jax.random.split(KEY, 500))
    assert 3 <= states.position.min() < 3.1
    assert 56.9 < states.position.max() <= 57
    np.testing.assert_allclose(states.position.mean((0, 1)), 30, atol=0.5)
    assert 0 <= states.heading.min() < 0.01
    assert 6.27 < states.heading.max() < 2 * np.pi
    assert not states.velocity.any()


def test_without_action_an_episode_scores_what_uniform_positions_predict():
    task = Rendezvous()
    states = jax.vmap(task.reset)(jax.random.split(KEY, 500))
    reward = jax.vmap(step, (None, 0, None))(task, states, jnp.zeros((20, 2)))[1].reward
    mean_distance = 90 * (2 + np.sqrt(2) + 5 * np.arcsinh(1)) / 15  # of two uniform points in a square
    np.testing.assert_allclose(1024 * reward.mean(), -1024 * mean_distance / (100 * np.sqrt(2)), atol=2)


def test_driving_to_the_first_centroid_scores_ten_to_sixteen():
    task = Rendezvous()

    def drive(state, goal):
        displacement = goal[None] - state.position
        distance = norm(displacement)
        cos, sin = bearing(direction(state.heading), unit(displacement, distance)).T
        speed = jnp.clip(distance * jnp.maximum(cos, 0), 0, 10)
        turn_rate = jnp.clip(-5 * jnp.atan2(sin, cos), -jnp.pi, jnp.pi) * (distance > 0.5)
        return jnp.clip(jnp.stack([speed, turn_rate], -1) - state.velocity, -1, 1)

    @jax.vmap
    def episode(key):
        start = task.reset(key)
        goal = start.position.mean(0)

        def body(state, _):
            state, step = task.step(KEY, state, drive(state, goal))
            return state, step.reward

        return jax.lax.scan(body, start, length=task.episode_length)[1].sum()

    returns = jax.jit(episode)(jax.random.split(KEY, 8))
    assert ((returns > -16) & (returns < -9)).all(), returns


@pytest.mark.parametrize(
    ("field", "value", "accepted"),
    [
        ("num_agents", 1, "an integer >= 2"),
        ("num_agents", 2.5, "an integer >= 2"),
        ("episode_length", 0, "an integer >= 1"),
        ("side", 0.0, "a positive finite number"),
        ("visibility_radius", -1, "a positive finite number"),
        ("visibility_radius", float("nan"), "a positive finite number"),
        ("visibility_radius", float("inf"), "a positive finite number"),
        ("dynamics", "unicycle", "one of acceleration, velocity"),
        ("relative_velocity", "times 5", "one of normalized, thesis"),
        ("torus", "yes", "true or false"),
        ("torus", 1, "true or false"),
    ],
)
def test_impossible_fields_are_named_with_what_is_accepted(field, value, accepted):
    with pytest.raises(ValueError, match=f"{field}: must be {accepted}.*, got {re.escape(repr(value))}"):
        Rendezvous(**{field: value})


@pytest.mark.parametrize("torus", [False, True])
def test_the_distance_to_the_center_does_not_depend_on_the_visibility_radius(torus):
    metrics = []
    for radius in (1.0, 100.0):
        task = Rendezvous(num_agents=4, torus=torus, visibility_radius=radius, episode_length=1)
        state = task.reset(KEY).replace(active_agents=jnp.array(3))
        position = jnp.array([[98.0, 50.0], [99.0, 50.0], [1.0, 50.0], [30.0, 20.0]])
        metrics.append(task.step(KEY, state.replace(position=position), jnp.zeros((4, 2)))[1].metrics)
    assert metrics[0]["final_distance"] != metrics[1]["final_distance"]
    expected = np.mean(np.abs(np.array([98, 99, 101 if torus else 1]) - (99 + 1 / 3 if torus else 66)))
    np.testing.assert_allclose([x["final_center_distance"] for x in metrics], expected, rtol=1e-3)
