"""Closed forms, conserved quantities, symmetries, and scenes recorded from Box2D (`golden/boxes.json`).

Scenes of one disc to four, and one box or two, run in one compiled program: discs that a scene does not have stand in
a corner, boxes that it does not have are absent.
"""

import functools
import json
import math
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from overlaps import HALF, RADIUS, overlaps

from jaxswarm.physics import rigid2d
from jaxswarm.physics.contacts import BOX_INERTIA, BOX_MASS, MAX_SPEED, Offsets, Solver
from jaxswarm.tasks.boxes import State

GOLDEN = json.loads((pathlib.Path(__file__).parent / "golden" / "boxes.json").read_text())
KEY = jax.random.key(0)
FAITHFUL, FAST = rigid2d.PRESETS["faithful"], rigid2d.PRESETS["fast"]
BARE = Solver(box_friction=0.0, wall_friction=0.0, offsets=Offsets(0.0, 0.0, 0.0, 0.0, 0.0))
PARKED = [[-0.46, y, 0.0] for y in (-0.46, -0.4, 0.4, 0.46)]
STEPS = 10
GO, STAY = (MAX_SPEED, 0.0), (0.0, 0.0)
FACE = -HALF - RADIUS  # x of a disc that touches the left face of a box at the origin


def world(discs, boxes, box_velocity=None):
    """Bodies as rows of x, y, heading; filled up to four discs and two boxes."""
    discs, num_boxes = np.array([*discs, *PARKED[len(discs) :]]), len(boxes)
    boxes = np.array([*boxes, *[[0.0, 0.0, 0.0]] * (2 - num_boxes)])
    velocity = np.zeros((2, 3))
    if box_velocity is not None:
        velocity[:num_boxes] = box_velocity
    return bodies(discs, boxes, velocity, np.arange(2) < num_boxes)


def bodies(discs, boxes, box_velocity, present):
    discs, boxes, box_velocity = (np.asarray(x, np.float32) for x in (discs, boxes, box_velocity))
    arrays = (discs[:, :2], discs[:, 2], boxes[:, :2], boxes[:, 2], box_velocity, present)
    return State(*map(jnp.asarray, arrays), time=jnp.array(0))


def commands(rows):
    return jnp.array([*rows, *[STAY] * (4 - len(rows))])


@functools.partial(jax.jit, static_argnames="solver")
def replay(solver, side, state, command):
    """States after each step of a `command` [steps, discs, 2]."""

    def body(state, command):
        state = rigid2d.move(solver, side, state, command)
        return state, state

    return jax.lax.scan(body, state, command)[1]


@functools.partial(jax.jit, static_argnames="solver")
def replay_worlds(solver, side, states, command):
    """States [worlds, steps, ...] of a `command` [worlds, steps, discs, 2]."""
    return jax.vmap(replay, (None, None, 0, 0))(solver, side, states, command)


def run(solver, state, command, steps=STEPS, side=1.0):
    """States [steps, ...], with a constant command, of as many steps as full programs of ten hold."""
    parts = []
    for _ in range(math.ceil(steps / STEPS)):
        parts.append(replay(solver, jnp.float32(side), state, jnp.tile(command[None], (STEPS, 1, 1))))
        state = at(parts[-1], -1)
    return jax.tree.map(lambda *x: np.concatenate(x)[:steps], *parts)


def at(states, index):
    return jax.tree.map(lambda leaf: leaf[index], states)


def scene(solver, name):
    """Final state of a recorded scene."""
    record = GOLDEN["scenes"][name]
    start = world(record["discs"], record["boxes"], record["box_vel"])
    return at(run(solver, start, commands(record["cmd"]), record["steps"] // 10), -1)


def steady_speed(num_discs):
    """Of a box that discs push squarely."""
    return num_discs * 0.92 * MAX_SPEED / (num_discs + 0.08 * BOX_MASS)


def pushers(num_discs):
    return [[FACE, 0.035 * (i - (num_discs - 1) / 2), 0.0] for i in range(num_discs)]


@pytest.mark.parametrize("turn_rate", [0.0, 0.5, -math.pi / 2])
def test_free_discs_follow_the_closed_form(turn_rate):
    states = run(FAITHFUL, world([[0.0, 0.0, 0.3]], []), commands([(MAX_SPEED, turn_rate)]))
    heading = 0.3 + 0.092 * turn_rate * np.arange(10 * STEPS)
    path = 0.092 * MAX_SPEED * np.cumsum(np.stack([np.cos(heading), np.sin(heading)], -1), 0)
    np.testing.assert_allclose(states.position[:, 0], path[9::10], atol=1e-6)
    turned = 0.3 + 0.92 * turn_rate * np.arange(1, STEPS + 1)
    np.testing.assert_allclose(np.exp(1j * states.heading[:, 0]), np.exp(1j * turned), atol=1e-5)


def test_headings_stay_within_half_a_turn_and_exact_for_a_whole_episode():
    states = run(FAITHFUL, world([], []), commands([(0.0, 1.0)] * 4), steps=1000)
    assert np.abs(states.heading).max() <= np.float32(np.pi)
    np.testing.assert_allclose(np.exp(1j * states.heading[-1]), np.exp(920j), atol=2e-4)


@pytest.mark.parametrize("preset", rigid2d.PRESETS)
@pytest.mark.parametrize("num_discs", [1, 2, 3])
def test_discs_abreast_push_at_the_steady_speed(preset, num_discs):
    states = run(rigid2d.PRESETS[preset], world(pushers(num_discs), [[0.0, 0.0, 0.0]]), commands([GO] * num_discs))
    covered = (states.box_position[-1, 0] - states.box_position[-6, 0]) / 5
    np.testing.assert_allclose(covered[0], steady_speed(num_discs), rtol=1e-4)
    np.testing.assert_allclose(states.box_velocity[-1, 0, 0], steady_speed(num_discs), rtol=1e-4)
    np.testing.assert_allclose(covered[0], GOLDEN["steady_push_speed_m_s"][str(num_discs)], rtol=1e-4)
    np.testing.assert_allclose(covered[1], 0, atol=1e-6)


@pytest.mark.parametrize("name", [name for name, record in GOLDEN["scenes"].items() if record["boxes"]])
def test_boxes_end_where_box2d_leaves_them(name):
    state, expected = scene(FAITHFUL, name), np.array(GOLDEN["scenes"][name]["final_boxes"])
    np.testing.assert_allclose(state.box_position[: len(expected)], expected[:, :2], atol=5e-4)
    np.testing.assert_allclose(state.box_heading[: len(expected)], expected[:, 2], atol=0.006)


@pytest.mark.parametrize("name", [name for name, record in GOLDEN["scenes"].items() if record["boxes"]])
def test_boxes_end_close_to_there_without_friction_and_offsets(name):
    state, expected = scene(BARE, name), np.array(GOLDEN["scenes"][name]["final_boxes_frictionless"])
    np.testing.assert_allclose(state.box_position[: len(expected)], expected[:, :2], atol=1.5e-3)


@pytest.mark.parametrize("name", [name for name, record in GOLDEN["scenes"].items() if not record["boxes"]])
def test_discs_end_where_box2d_leaves_them(name):
    state, expected = scene(FAITHFUL, name), np.array(GOLDEN["scenes"][name]["final_discs"])
    np.testing.assert_allclose(state.position[: len(expected)], expected[:, :2], atol=5e-5)


@pytest.mark.slow
def test_ten_discs_and_four_boxes_move_as_in_box2d():
    record = GOLDEN["random"]
    start = bodies(record["discs"], record["boxes"], np.zeros((4, 3)), np.ones(4, bool))
    parts = []
    for part in np.split(np.array(record["cmd_per_env_step"], np.float32), 3):
        parts.append(replay(FAITHFUL, jnp.float32(record["world"]), start, jnp.array(part)))
        start = at(parts[-1], -1)
    positions = np.concatenate([part.box_position for part in parts])
    expected = np.array(record["every5env_boxes"])
    deviation = np.abs(positions[4::5] - expected[1:, :, :2]).max((1, 2))
    assert np.abs(expected[-1] - expected[0]).max() > 0.02  # boxes are moved
    assert deviation[1] < 1e-3  # after 10 s
    assert deviation[-1] < 3e-3


def test_what_touches_without_pushing_rests_for_ever():
    corner = [0.5 - HALF, 0.5 - HALF, 0.0]
    start = world([[0.5 - 4 * HALF - RADIUS - 1e-6, 0.45, 0.0]], [corner, [0.5 - 3 * HALF, 0.5 - HALF, 0.0]])
    states = run(BARE, start, commands([]), steps=100)
    np.testing.assert_array_equal(states.position[-1], start.position)
    np.testing.assert_array_equal(states.box_position[-1], start.box_position)
    np.testing.assert_allclose(states.box_heading[-1], start.box_heading, atol=1e-9)
    np.testing.assert_allclose(states.box_velocity, 0, atol=1e-9)


def test_bodies_inside_the_offsets_part_and_rest():
    corner = [0.5 - HALF, 0.5 - HALF, 0.0]
    start = world([[0.5 - 4 * HALF - RADIUS, 0.45, 0.0]], [corner, [0.5 - 3 * HALF, 0.5 - HALF, 0.0]])
    states = run(FAITHFUL, start, commands([]), steps=30)
    assert np.abs(states.box_velocity[20:]).max() < 1e-6
    assert np.abs(states.box_position - np.asarray(start.box_position)).max() < 2e-3


def crowd():
    """Ten discs around four boxes in a narrow world, and commands that drive them together."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * 0.2
    along = np.linspace(0.05, 3.95, 10)
    discs = np.stack([np.interp(along, range(5), corners[:, axis]) for axis in (0, 1)], -1)
    discs = np.concatenate([discs, np.arctan2(-discs[:, 1:], -discs[:, :1])], 1)
    boxes = [[-0.08, -0.08, 0.2], [0.08, -0.08, 0.5], [-0.08, 0.08, -0.3], [0.08, 0.08, 1.0]]
    speed_key, turn_key = jax.random.split(KEY)
    speed = jax.random.uniform(speed_key, (STEPS, 10), minval=0.5, maxval=1.0) * MAX_SPEED
    command = jnp.stack([speed, jax.random.uniform(turn_key, (STEPS, 10), minval=-0.1, maxval=0.1)], -1)
    return bodies(discs, boxes, np.zeros((4, 3)), np.ones(4, bool)), command


def permuted(state, command):
    discs, boxes = np.array([3, 1, 9, 0, 8, 2, 7, 4, 6, 5]), np.array([2, 0, 3, 1])
    order = {name: discs if name in ("position", "heading") else boxes for name in vars(state) if name != "time"}
    return state.replace(**{name: getattr(state, name)[index] for name, index in order.items()}), command[:, discs]


def mirrored(state, command):
    flip, flip_all = jnp.array([[1.0, -1.0]]), jnp.array([[1.0, -1.0, -1.0]])
    mirror_image = state.replace(
        position=state.position * flip,
        heading=-state.heading,
        box_position=state.box_position * flip,
        box_heading=-state.box_heading,
        box_velocity=state.box_velocity * flip_all,
    )
    return mirror_image, command * flip[None]


def rotated(state, command):
    """By a quarter turn."""

    def turn(vector):
        return jnp.stack([-vector[:, 1], vector[:, 0]], -1)

    image = state.replace(
        position=turn(state.position),
        heading=state.heading + np.pi / 2,
        box_position=turn(state.box_position),
        box_heading=state.box_heading + np.pi / 2,
        box_velocity=jnp.concatenate([turn(state.box_velocity), state.box_velocity[:, 2:]], -1),
    )
    return image, command


def relabelled(state, command):
    """With other faces of boxes called the first."""
    return state.replace(box_heading=state.box_heading + np.pi / 2), command


IMAGES = {
    f.__name__: (f, atol) for f, atol in ((permuted, 1e-6), (mirrored, 1e-6), (rotated, 1e-5), (relabelled, 1e-5))
}


@functools.cache
def crowd_and_images():
    """What becomes of a crowd and of its images, all in one batch."""
    start, command = crowd()
    images = [(start, command), *[image(start, command) for image, _ in IMAGES.values()]]
    states, command_of_each = jax.tree.map(lambda *x: jnp.stack(x), *images)
    return replay_worlds(FAITHFUL, jnp.float32(0.5), states, command_of_each)


@pytest.mark.slow
@pytest.mark.parametrize("name", IMAGES)
def test_images_of_a_world_stay_its_images(name):
    image, atol = IMAGES[name]
    ends = jax.tree.map(lambda leaf: leaf[:, -1], crowd_and_images())
    expected, _ = image(at(ends, 0), jnp.zeros((1, 10, 2)))
    end = at(ends, 1 + list(IMAGES).index(name))
    assert np.abs(at(ends, 0).box_position - crowd()[0].box_position).max() > 0.005  # boxes are moved
    np.testing.assert_allclose(end.position, expected.position, atol=atol)
    np.testing.assert_allclose(end.box_position, expected.box_position, atol=atol)
    np.testing.assert_allclose(np.exp(1j * end.box_heading), np.exp(1j * expected.box_heading), atol=20 * atol)


@pytest.mark.slow
def test_one_world_moves_as_among_many():
    start, command = crowd()
    alone, among = replay(FAITHFUL, jnp.float32(0.5), start, command), at(crowd_and_images(), 0)
    np.testing.assert_allclose(alone.position, among.position, atol=1e-5)
    np.testing.assert_allclose(alone.box_position, among.box_position, atol=1e-5)


@pytest.mark.slow
def test_more_worlds_than_a_block_move_as_few():
    start, command = crowd()
    num_envs = rigid2d.BLOCK + 3
    states, commands_of_all = (jax.tree.map(lambda x: jnp.stack([x] * num_envs), x) for x in (start, command))
    among = replay_worlds(FAITHFUL, jnp.float32(0.5), states, commands_of_all)
    alone = replay(FAITHFUL, jnp.float32(0.5), start, command)
    for name in ("position", "box_position", "box_heading"):
        expected = np.broadcast_to(getattr(alone, name), getattr(among, name).shape)
        np.testing.assert_allclose(getattr(among, name), expected, atol=1e-5)


def test_absent_boxes_touch_nothing_and_stay():
    start = world([[FACE - 0.001, 0.0, 0.0]], [[0.0, 0.0, 0.0], [0.1, 0.02, 0.5]])
    start = start.replace(box_present=jnp.array([True, False]))
    states = run(FAITHFUL, start, commands([GO]))
    expected = run(FAITHFUL, start.replace(box_position=jnp.array([[0.0, 0.0], [0.3, 0.3]])), commands([GO]))
    np.testing.assert_array_equal(states.box_position[:, 0], expected.box_position[:, 0])
    np.testing.assert_array_equal(states.position, expected.position)
    np.testing.assert_array_equal(states.box_position[-1, 1], start.box_position[1])


def test_colliding_boxes_keep_momentum_but_for_drag():
    velocity = np.array([[0.02, 0.004, 0.1], [-0.02, 0.002, -0.05]])
    start = world([], [[-0.055, 0.0, 0.3], [0.055, 0.03, 0.1]], velocity)
    states = run(BARE, start, commands([]), side=20.0)

    def momentum(position, velocity):
        position, velocity = np.float64(position), np.float64(velocity)
        cross = position[..., 0] * velocity[..., 1] - position[..., 1] * velocity[..., 0]
        angular = (BOX_MASS * cross + BOX_INERTIA * velocity[..., 2]).sum(-1)
        return BOX_MASS * velocity[..., :2].sum(-2), angular

    linear, angular = momentum(start.box_position, start.box_velocity)
    left = 0.92 ** (10 * np.arange(1, STEPS + 1))
    linear_after, angular_after = momentum(states.box_position, states.box_velocity)
    undisturbed = left[:, None, None] * velocity
    assert np.abs(states.box_velocity - undisturbed).max() > 1e-3  # they do collide
    np.testing.assert_allclose(linear_after, left[:, None] * linear, atol=1e-5)
    np.testing.assert_allclose(angular_after, left * angular, atol=1e-3)


def test_without_robots_no_energy_is_won():
    velocity = np.array([[0.02, 0.004, 0.3], [-0.02, 0.002, -0.3]])
    states = run(BARE, world([], [[-0.055, 0.0, 0.3], [0.055, 0.03, 0.1]], velocity), commands([]))
    mass = np.array([BOX_MASS, BOX_MASS, BOX_INERTIA])
    energy = (mass * np.float64(np.concatenate([velocity[None], states.box_velocity])) ** 2).sum((1, 2))
    assert (energy <= 0.92 ** (20 * np.arange(STEPS + 1)) * energy[0] * (1 + 1e-6) + 1e-12).all()


@pytest.mark.parametrize("faster", [1, 2, pytest.param(5, marks=pytest.mark.slow)])
def test_rammed_boxes_stay_inside_the_walls(faster):
    solver = FAITHFUL if faster <= 2 else Solver(max_speed=faster * MAX_SPEED)
    for phase in range(8):
        gap = 0.02 + phase / 8 * 1e-3 * faster
        wall = 0.5 - HALF - gap
        discs = [[wall + FACE - 0.001, y, 0.0] for y in (-0.035, 0.0, 0.035)]
        states = run(solver, world(discs, [[wall, 0.0, 0.0]]), commands([(faster * MAX_SPEED, 0.0)] * 3))
        seen = states.replace(box_position=states.box_position[:, :1], box_heading=states.box_heading[:, :1])
        depth = overlaps(seen, 1.0)
        assert states.box_position[-1, 0, 0] > wall + gap / 2  # it gets there
        assert max(depth["box_wall"], depth["disc_box"]) < 5e-4


def test_equal_boxes_pressed_face_to_face_do_not_overlap():
    record = GOLDEN["scenes"]["press_aligned"]
    states = run(FAITHFUL, world(record["discs"], record["boxes"]), commands(record["cmd"]))
    assert overlaps(states, 1.0)["box_box"] < 2e-4


@functools.cache
def settled():
    keys = jax.random.split(KEY, 4)
    discs = np.concatenate(
        [jax.random.uniform(keys[0], (16, 10, 2), minval=-0.48, maxval=0.48), np.zeros((16, 10, 1))], -1
    )
    boxes = np.concatenate(
        [0.7 * jax.random.uniform(keys[1], (16, 4, 2), minval=-0.5, maxval=0.5), np.zeros((16, 4, 1))], -1
    )
    boxes[..., 2] = jax.random.uniform(keys[2], (16, 4), maxval=6.0)
    starts = [bodies(d, b, np.zeros((4, 3)), np.ones(4, bool)) for d, b in zip(discs, boxes, strict=True)]
    starts = jax.tree.map(lambda *x: jnp.stack(x), *starts)
    settle = jax.jit(jax.vmap(functools.partial(rigid2d.settle, FAITHFUL), (None, 0)))
    return starts, settle(jnp.float32(1.0), starts)


@pytest.mark.slow
def test_settling_parts_whatever_overlaps():
    starts, states = settled()
    before, after = overlaps(starts, 1.0), overlaps(states, 1.0)
    assert before["box_box"] > 0.03
    assert before["disc_box"] > 0.02
    assert max(after.values()) < 1e-4 + 2e-4  # discs rest with an overlap of 0.2 mm with each other
    assert not states.box_velocity.any()


@pytest.mark.parametrize(
    ("discs", "boxes"),
    [
        ([[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.4]]),  # a disc at the center of a box
        ([[0.3, 0.0, 0.0]], [[0.0, 0.0, 0.4], [0.0, 0.0, 0.4]]),  # two boxes at one place
        ([[0.3, 0.0, 0.0], [0.3, 0.0, 0.0]], []),  # two discs at one place
        ([[0.3, 0.0, 0.0]], [[0.5, 0.1, 0.4]]),  # a box half through a wall
    ],
)
def test_odd_states_stay_finite_and_come_apart(discs, boxes):
    states = run(FAITHFUL, world(discs, boxes), commands([]))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(states))
    num_boxes = len(boxes)
    end = at(states, -1)
    end = end.replace(box_position=end.box_position[:num_boxes], box_heading=end.box_heading[:num_boxes])
    assert max(overlaps(end, 1.0).values()) < 5e-4


SIZES = [(1, 1), (0, 1), (1, 0), (2, 0), (0, 2), (3, 1), (1, 2)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("num_discs", "num_boxes"), [SIZES[0], *[pytest.param(*s, marks=pytest.mark.slow) for s in SIZES[1:]]]
)
def test_worlds_may_be_tiny(num_discs, num_boxes):
    discs, boxes = ([[0.02 * i, 0.1 * j, 0.1] for i in range(n)] for j, n in ((0, num_discs), (1, num_boxes)))
    start = bodies(
        np.reshape(discs, (-1, 3)), np.reshape(boxes, (-1, 3)), np.zeros((num_boxes, 3)), np.ones(num_boxes, bool)
    )
    states = replay(FAITHFUL, jnp.float32(1.0), start, jnp.tile(jnp.array([[[0.01, 0.5]]]), (2, num_discs, 1)))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(states))
    assert num_discs == 0 or np.linalg.norm(states.position[-1] - np.asarray(start.position), axis=-1).max() > 0.005


def chase(state):
    """Each disc drives at a box of its own."""
    goal = state.box_position[jnp.arange(len(state.heading)) % len(state.box_heading)]
    x, y = (goal - state.position).T
    error = jnp.atan2(y, x) - state.heading
    error = jnp.atan2(jnp.sin(error), jnp.cos(error))
    return jnp.stack([MAX_SPEED * jnp.clip(jnp.cos(error), 0, 1), jnp.clip(3 * error, -1.5, 1.5)], -1)


def gather(state):
    """All discs drive into one corner."""
    x, y = (0.5 - state.position).T
    error = jnp.atan2(y, x) - state.heading
    error = jnp.atan2(jnp.sin(error), jnp.cos(error))
    return jnp.stack([jnp.full_like(error, MAX_SPEED), jnp.clip(3 * error, -1.5, 1.5)], -1)


def wander(state):
    key = jax.random.key(jax.lax.bitcast_convert_type(state.position.sum(), jnp.int32))
    return jax.random.uniform(
        key, (len(state.heading), 2), minval=jnp.array([0.0, -1.5]), maxval=jnp.array([0.01, 1.5])
    )


@pytest.mark.slow
@pytest.mark.parametrize("policy", [wander, chase, gather])
def test_nothing_ever_gets_far_into_anything(policy):
    starts = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), settled()[1])

    @jax.jit
    @jax.vmap
    def soak(state):
        def body(state, _):
            state = rigid2d.move(FAITHFUL, 1.0, state, policy(state))
            return state, state

        return jax.lax.scan(body, state, length=512)[1]

    states = soak(starts.replace(heading=starts.heading + jnp.arange(32)[:, None]))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(states))
    limits = {"disc_disc": 3e-3, "disc_box": 1.5e-3, "box_box": 1e-3, "disc_wall": 0.0, "box_wall": 5e-4}
    found = overlaps(states, 1.0)
    assert {kind: depth for kind, depth in found.items() if depth > limits[kind]} == {}
    assert np.linalg.norm(states.box_velocity[..., :2], axis=-1).max() <= 0.92 * MAX_SPEED


@pytest.mark.parametrize(
    ("field", "value", "accepted"),
    [
        ("substeps", 0, "an integer >= 1"),
        ("iterations", -1, "an integer >= 1"),
        ("relaxation", 2.0, "a number above 0 and below 2"),
        ("recovery", -0.1, "a number above 0, up to 1"),
        ("max_speed", 0.0, "a positive number"),
        ("box_friction", -1.0, "a number >= 0"),
    ],
)
def test_impossible_settings_are_named_with_what_is_accepted(field, value, accepted):
    with pytest.raises(ValueError, match=f"{field}: must be {accepted}.*, got {value!r}"):
        Solver(**{field: value})
