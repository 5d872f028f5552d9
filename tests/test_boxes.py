"""Tests of the box tasks against recorded states and averages of the thesis's program, closed forms and symmetries.

`golden/boxes.npz` holds numbered cases: for case k `cKKK_actions, kb_pose, box_pose, box_vel, reward` at every step,
and `cKKK_obs` at every `obs_every`-th; index 0 is the start. `meta_json` describes the cases.
"""

import functools
import itertools
import json
import pathlib
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxswarm.physics import rigid2d
from jaxswarm.tasks.boxes import Assembly, Clustering, State

GOLDEN = np.load(pathlib.Path(__file__).parent / "golden" / "boxes.npz")
CASES = json.loads(str(GOLDEN["meta_json"]))["cases"]
REWARD = {"object_clustering_amp": "amplified", "object_clustering_explicit": "corners"}
KEY = jax.random.key(0)
golden_cases = pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case['case']}-{case['name']}")


def record(case, name):
    return GOLDEN[f"c{case['case']:03d}_{name}"]


def recorded_task(case):
    sizes = {"num_agents": case["n_agents"], "num_boxes": case["n_boxes"], "side": float(case["world_width"])}
    if case["reward_function"] == "assembly":
        return Assembly(**sizes)
    return Clustering(**sizes, num_clusters=case["n_clusters"], reward=REWARD[case["reward_function"]])


def recorded_states(case, every=1):
    robots, boxes, velocity = (record(case, name)[::every] for name in ("kb_pose", "box_pose", "box_vel"))
    arrays = (robots[..., :2], robots[..., 2], boxes[..., :2], boxes[..., 2], velocity)
    present, time = jnp.ones(boxes.shape[:2], bool), jnp.arange(len(boxes))
    return State(*map(jnp.asarray, arrays), box_present=present, time=time)


@jax.jit
def observe(task, state):
    return task.observe(state)


@jax.jit
def transitions(task, states, actions):
    return jax.vmap(lambda state, action: task.step(KEY, state, action))(states, actions)


@jax.jit
def step(task, state, action):
    return task.step(KEY, state, action)


def place(task, boxes, robots=None):
    """Return a state with all boxes present at these positions, and robots away from them."""
    num_boxes = len(boxes)
    robots = np.stack([np.linspace(-0.45, 0.45, task.num_agents), np.full(task.num_agents, -0.47)], -1)
    arrays = (robots, np.zeros(task.num_agents), boxes, np.zeros(num_boxes), np.zeros((num_boxes, 3)))
    return State(*(jnp.array(x, jnp.float32) for x in arrays), jnp.ones(num_boxes, bool), jnp.array(0))


@jax.jit
def reward_between(task, state, next_box_position):
    """Return the reward of a step in which a physics stub moves the boxes to `next_box_position`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            rigid2d, "move", lambda solver, side, state, command: state.replace(box_position=next_box_position)
        )
        return task.step(KEY, state, jnp.zeros((task.num_agents, 2)))[1].reward


@golden_cases
def test_recorded_observations_are_reproduced(case):
    task, every = recorded_task(case), case["obs_every"]
    obs = jax.vmap(observe, (None, 0))(task, recorded_states(case, every))
    num_agents, recorded = case["n_agents"], record(case, "obs")
    rows, boxes, own = np.split(recorded, [5 * (num_agents - 1), recorded.shape[-1] - 5], axis=-1)

    # Recorded neighbors are in the order of their index; ours are in cyclic order after the robot.
    index = (np.arange(num_agents)[:, None] + np.arange(1, num_agents)) % num_agents
    neighbors = np.take_along_axis(np.asarray(obs.groups["neighbors"].features), np.argsort(index)[None, ..., None], 2)
    np.testing.assert_allclose(neighbors, rows.reshape(*rows.shape[:2], -1, 5), atol=2e-5)

    groups = [obs.groups[name] for name in sorted(obs.groups) if name.startswith("boxes")]
    assert len(groups) == case["n_clusters"]
    boxes = boxes.reshape(*boxes.shape[:2], -1, 8)
    np.testing.assert_allclose(np.concatenate([group.features for group in groups], 2), boxes[..., :7], atol=2e-5)
    np.testing.assert_array_equal(np.concatenate([group.mask for group in groups], 2), boxes[..., 7] == 1)
    np.testing.assert_allclose(obs.own, own, atol=2e-5)


@golden_cases
def test_recorded_rewards_are_reproduced_from_recorded_states(case):
    task, states = recorded_task(case), recorded_states(case)
    state = jax.tree.map(lambda leaf: leaf[:-1], states)
    rewards = jax.vmap(reward_between, (None, 0, 0))(task, state, states.box_position[1:])
    np.testing.assert_allclose(rewards, record(case, "reward"), atol=2e-5)


@pytest.mark.parametrize("case", [case for case in CASES if case["name"] == "free"], ids=lambda case: str(case["case"]))
def test_robots_that_touch_nothing_move_as_recorded(case):
    states, _ = transitions(
        recorded_task(case), recorded_states(case).replace(), record(case, "actions")[[*range(case["steps"]), -1]]
    )
    expected = recorded_states(case)
    np.testing.assert_allclose(states.position[:-1], expected.position[1:], atol=1e-6)
    turn = [np.exp(1j * np.float64(heading)) for heading in (states.heading[:-1], expected.heading[1:])]
    np.testing.assert_allclose(*turn, atol=1e-5)


def test_actions_say_half_speed_at_zero_and_are_clipped():
    task = Assembly(num_agents=3)
    state = place(task, [[0.3, 0.3], [0.3, 0.0], [-0.3, 0.3], [-0.3, 0.0]])
    state = state.replace(heading=jnp.full(3, jnp.pi / 2))
    actions = jnp.array([[0.0, 0.0], [9.0, -9.0], [-9.0, 0.5]])
    next_state, _ = step(task, state, actions)
    clipped, _ = step(task, state, jnp.clip(actions, -1, 1))
    np.testing.assert_array_equal(next_state.position, clipped.position)
    distance = jnp.linalg.norm(next_state.position - state.position, axis=-1)
    np.testing.assert_allclose(distance[jnp.array([0, 2])], [0.0046, 0.0], atol=1e-6)
    turned = next_state.heading - state.heading
    np.testing.assert_allclose(turned, [0, -0.92 * np.pi / 2, 0.46 * np.pi / 2], atol=1e-5)


def test_a_robot_sees_as_the_formulas_say():
    task = Assembly(num_agents=2, num_boxes=1)
    state = place(task, [[0.1, 0.3]]).replace(
        position=jnp.array([[0.1, 0.0], [0.1, -0.2]]), heading=jnp.array([0.5, 0.7]), box_heading=jnp.array([1.5])
    )
    obs = observe(task, state)
    np.testing.assert_allclose(obs.own[0], [0.1, 0.0, np.sin(0.5), np.cos(0.5), 1], atol=1e-6)
    left, back = np.pi / 2 - 0.5, -np.pi / 2 - 0.5
    seen = [0.3, np.sin(left), np.cos(left), np.sin(1.0), np.cos(1.0), 0.1, 0.3]
    np.testing.assert_allclose(obs.groups["boxes"].features[0, 0], seen, atol=1e-6)
    seen = [0.2, np.sin(back), np.cos(back), np.sin(0.2), np.cos(0.2)]
    np.testing.assert_allclose(obs.groups["neighbors"].features[0, 0], seen, atol=1e-6)


def random_state(task):
    """Draw a state with random bodies that may overlap."""
    keys = jax.random.split(KEY, 3)
    state = place(task, jax.random.uniform(keys[0], (task.num_boxes, 2), minval=-0.4, maxval=0.4))
    return state.replace(
        position=jax.random.uniform(keys[1], state.position.shape, minval=-0.4, maxval=0.4),
        heading=jax.random.uniform(keys[2], state.heading.shape, maxval=6.0),
        box_heading=jax.random.uniform(keys[2], state.box_heading.shape, maxval=6.0),
    )


@pytest.mark.slow
def test_the_order_of_robots_and_boxes_does_not_matter():
    task = Assembly(num_agents=5)
    state = random_state(task)
    robots, boxes = jnp.array([3, 0, 4, 1, 2]), jnp.array([2, 3, 1, 0])
    permuted = state.replace(
        position=state.position[robots],
        heading=state.heading[robots],
        box_position=state.box_position[boxes],
        box_heading=state.box_heading[boxes],
    )

    def by_distance(group):
        order = jnp.argsort(group.features[..., 0], axis=-1)
        return jnp.take_along_axis(group.features, order[..., None], 1)

    obs, permuted_obs = observe(task, state), observe(task, permuted)
    np.testing.assert_allclose(permuted_obs.own, obs.own[robots], atol=1e-6)
    for name, group in obs.groups.items():
        np.testing.assert_allclose(by_distance(permuted_obs.groups[name]), by_distance(group)[robots], atol=1e-6)


def test_rewards_of_an_assembly_add_up_to_what_distances_shrink():
    task = Assembly(num_agents=3)
    state = start = place(task, [[0.0, 0.0], [0.3, 0.1], [0.0, -0.2], [-0.3, 0.3]]).replace(
        position=jnp.array([[-0.07, 0.0], [-0.07, -0.2], [-0.37, 0.3]])
    )
    total = 0.0
    for _ in range(10):
        state, outcome = step(task, state, jnp.tile(jnp.array([[1.0, 0.0]]), (3, 1)))
        total += outcome.reward

    def distances(state):
        return [np.linalg.norm(np.float64(a) - np.float64(b)) for a, b in itertools.combinations(state.box_position, 2)]

    assert abs(total) > 1e-3  # the robots move boxes
    np.testing.assert_allclose(total, sum(distances(start)) - sum(distances(state)), atol=1e-6)
    np.testing.assert_allclose(outcome.metrics["box_distance"], np.mean(distances(state)), rtol=1e-6)


def test_amplified_rewards_pay_for_close_colors_that_are_apart():
    task = Clustering(num_agents=2)
    state = place(task, [[0.0, 0.0], [0.2, 0.0], [0.0, 0.3], [0.2, 0.3]])
    moved = jnp.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.3], [0.2, 0.3]])  # centroids (0.1, 0) -> (0.05, 0), (0.1, 0.3)
    expected = 20 * (1.5 * (0.1 + 0.0) / 2 + np.hypot(0.05, 0.3) - 0.3)
    np.testing.assert_allclose(reward_between(task, state, moved), expected, rtol=1e-5)


@pytest.mark.parametrize(("box", "corner"), [(0, (-0.5, -0.5)), (1, (0.5, 0.5)), (2, (0.5, -0.5)), (3, (-0.5, 0.5))])
def test_each_color_has_its_corner(box, corner):
    task = Clustering(num_agents=2, num_clusters=4, reward="corners", side=1.0)
    state = place(task, [[0.0, 0.0], [0.2, 0.0], [0.0, 0.3], [0.2, 0.3]])
    moved = state.box_position.at[box].set(jnp.array(corner))
    expected = 20 * np.linalg.norm(np.array(corner) - np.float64(state.box_position[box]))
    np.testing.assert_allclose(reward_between(task, state, moved), expected, rtol=1e-5)


@pytest.mark.parametrize("reward", ["amplified", "corners"])
def test_clusters_of_any_size_are_contiguous(reward):
    task = Clustering(num_agents=2, num_boxes=7, num_clusters=3, reward=reward)
    assert task.cluster == (0, 0, 0, 1, 1, 2, 2)
    obs = observe(task, random_state(task))
    assert {name: group.features.shape[1:] for name, group in obs.groups.items()} == {
        "neighbors": (1, 5),
        "boxes_0": (3, 7),
        "boxes_1": (2, 7),
        "boxes_2": (2, 7),
    }


def test_one_hot_identity_says_what_groups_say():
    task = Clustering(num_agents=3)
    state = random_state(task)
    groups, boxes = (
        observe(task, state).groups,
        observe(task.replace(cluster_identity="one-hot"), state).groups["boxes"],
    )
    features = jnp.concatenate([groups["boxes_0"].features, groups["boxes_1"].features], 1)
    np.testing.assert_array_equal(boxes.features[..., :7], features)
    np.testing.assert_array_equal(boxes.features[0, :, 7:], [[1, 0], [1, 0], [0, 1], [0, 1]])


@pytest.mark.slow
def test_the_number_of_boxes_varies_evenly_over_clusters(monkeypatch):
    monkeypatch.setattr(rigid2d, "settle", lambda solver, side, state, substeps: state)  # physics has no influence here
    task = Clustering(num_agents=2, num_boxes=6, num_clusters=3, active_boxes=(2, 6))
    present = np.asarray(jax.jit(jax.vmap(task.reset))(jax.random.split(KEY, 400)).box_present)
    share = np.bincount(present.sum(1), minlength=7) / 400
    np.testing.assert_allclose(share, [0, 0, 0.2, 0.2, 0.2, 0.2, 0.2], atol=0.07)
    of_cluster = present.reshape(400, 3, 2).sum(-1)
    assert (of_cluster.max(1) - of_cluster.min(1) <= 1).all()


def states_with_one_absent(task):
    """Return two states that differ only in the position of the absent box."""
    state = place(task, [[-0.1, -0.4], [0.2, -0.3], [0.0, 0.3], [0.2, 0.3]])
    state = state.replace(
        position=jnp.array([[-0.17, -0.4], [0.3, -0.47], [0.4, -0.47]]),
        box_present=jnp.array([True, True, True, False]),
    )
    return state, state.replace(box_position=state.box_position.at[3].set(jnp.array([0.05, -0.42])))


def test_absent_boxes_are_not_touched():
    task = Assembly(num_agents=3)
    state, moved = states_with_one_absent(task)
    (end, outcome), (moved_end, moved_outcome) = (step(task, s, jnp.ones((3, 2))) for s in (state, moved))
    np.testing.assert_array_equal(end.position, moved_end.position)
    np.testing.assert_array_equal(end.box_position[:3], moved_end.box_position[:3])
    np.testing.assert_array_equal(outcome.reward, moved_outcome.reward)


@pytest.mark.parametrize(
    "task",
    [Assembly(num_agents=3), Clustering(num_agents=3), Clustering(num_agents=3, reward="corners")],
    ids=["assembly", "amplified", "corners"],
)
def test_absent_boxes_are_neither_seen_nor_rewarded(task):
    state, moved = states_with_one_absent(task)
    target = state.box_position + jnp.array([[0.1, 0.0], [0.0, 0.2], [0.1, 0.1], [0.0, 0.0]])
    reward, moved_reward = (reward_between(task, s, target.at[3].set(s.box_position[3] + 0.1)) for s in (state, moved))
    assert reward != 0
    np.testing.assert_array_equal(reward, moved_reward)
    obs, moved_obs = observe(task, state), observe(task, moved)
    jax.tree.map(np.testing.assert_array_equal, obs, moved_obs)
    np.testing.assert_allclose(obs.own[:, 4], 0.75)
    masks = [group.mask for name, group in sorted(obs.groups.items()) if "boxes" in name]
    np.testing.assert_array_equal(jnp.concatenate(masks, 1)[0], state.box_present)


@pytest.mark.parametrize(
    "task",
    [
        Assembly(num_agents=3, active_boxes=(1, 3)),
        Clustering(num_agents=3, active_boxes=(1, 3)),
        Clustering(num_agents=3, active_boxes=(1, 3), cluster_identity="one-hot"),
    ],
    ids=["assembly", "groups", "one-hot"],
)
def test_features_of_absent_boxes_are_zero(task):
    state, _ = states_with_one_absent(task)
    groups = [group for name, group in observe(task, state).groups.items() if "boxes" in name]
    num_absent = sum((~np.asarray(group.mask)).sum() for group in groups)
    assert num_absent == task.num_agents
    for group in groups:
        assert not np.asarray(group.features)[~np.asarray(group.mask)].any()
        assert np.asarray(group.features)[np.asarray(group.mask)].any(-1).all()


@functools.cache
def starts():
    return jax.jit(jax.vmap(Assembly().reset))(jax.random.split(KEY, 2000))


@pytest.mark.slow
def test_starts_are_uniform_with_boxes_in_the_middle():
    states = starts()
    for heading in (states.heading, states.box_heading):
        assert np.abs(heading).max() < np.pi + 0.3
        assert np.abs(np.exp(1j * np.float64(heading)).mean()) < 0.03
    assert np.abs(states.position).max() < 0.5 - 0.0165
    assert np.abs(states.position).mean() == pytest.approx(0.25, abs=0.005)
    assert np.abs(states.box_position).mean() == pytest.approx(0.35 / 2, abs=0.008)  # overlapping boxes were separated
    assert np.quantile(np.abs(states.box_position), 0.99) == pytest.approx(0.35, abs=0.02)
    assert not states.box_velocity.any()
    mean_distance = 0.7 * (2 + np.sqrt(2) + 5 * np.arcsinh(1)) / 15  # of two uniform points in the middle square
    distance = np.linalg.norm(states.box_position[:, :, None] - states.box_position[:, None], axis=-1)
    assert distance.sum((1, 2)).mean() / 2 == pytest.approx(6 * mean_distance, abs=0.06)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "expected", "deviation"),
    [(Assembly(), -0.118, 0.04), (Clustering(), -0.30, 0.4)],
    ids=["assembly", "clustering"],
)
def test_robots_that_drive_straight_on_score_as_untrained_networks_did(task, expected, deviation):
    """Expected values are means of 118 and 94 runs; deviations are three rounded standard errors of 256 episodes."""

    @jax.jit
    @jax.vmap
    def episode(key):
        def body(state, _):
            state, step = task.step(KEY, state, jnp.zeros((10, 2)))
            return state, step.reward

        return jax.lax.scan(body, task.reset(key), length=task.episode_length)[1].sum()

    returns = episode(jax.random.split(KEY, 256))
    assert 3 * returns.std() / 16 <= deviation
    np.testing.assert_allclose(returns.mean(), expected, atol=deviation)


@pytest.mark.parametrize(
    ("task", "field", "value", "accepted"),
    [
        (Assembly, "num_agents", 0, "an integer >= 1"),
        (Assembly, "num_boxes", 2.5, "an integer >= 1"),
        (Assembly, "episode_length", 0, "an integer >= 1"),
        (Assembly, "side", 0.1, "a finite number >= 0.2"),
        (Assembly, "physics", "exact", "one of faithful, fast"),
        (Assembly, "active_boxes", (1, 5), r"null or a pair \[low, high\] of integers from 1 to 4"),
        (Clustering, "num_clusters", 5, "an integer from 1 to 4"),
        (Clustering, "reward", "explicit", "one of amplified, corners"),
        (Clustering, "cluster_identity", "color", "one of groups, one-hot"),
    ],
)
def test_impossible_fields_are_named_with_what_is_accepted(task, field, value, accepted):
    with pytest.raises(ValueError, match=f"{field}: must be {accepted}.*, got {re.escape(repr(value))}"):
        task(**{field: value})


def test_there_are_four_corners():
    with pytest.raises(ValueError, match="num_clusters: must be an integer from 1 to 4, got 5"):
        Clustering(num_boxes=10, num_clusters=5, reward="corners")
