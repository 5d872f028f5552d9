"""Tasks describe what is to be seen, and which body is in which slot of what agents perceive."""

import ast
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxswarm import TASKS, scene

CASES = {
    "rendezvous, the nearest": ("rendezvous", {"num_agents": 6, "max_neighbors": 2, "visibility_radius": 50.0}),
    "rendezvous, some absent": ("rendezvous", {"num_agents": 6, "active_agents": (3, 3), "torus": True}),
    "pursuit": ("pursuit", {"num_agents": 4, "num_evaders": 3, "evader_visibility_radius": 40.0}),
    "assembly": ("assembly", {"num_agents": 3, "num_boxes": 4, "active_boxes": (2, 2)}),
    "clustering": ("clustering", {"num_agents": 3, "num_boxes": 5, "num_clusters": 3, "reward": "corners"}),
    "clustering, one-hot": ("clustering", {"num_agents": 3, "cluster_identity": "one-hot"}),
}
TASK = {case: TASKS[name](**fields) for case, (name, fields) in CASES.items()}
every_task = pytest.mark.parametrize("case", CASES)


@functools.cache
def look(case):
    """In a random state: what agents perceive, the bodies in the slots, and the scene."""
    task = TASK[case]

    @jax.jit
    def look(state):
        return task.observe(state), task.slots(state), task.scene(state)

    return look(random_state(task))


def random_state(task):
    """All that is drawn at random is anywhere; as few take part as the task allows."""
    rng, low = np.random.default_rng(3), -0.5 if hasattr(task, "physics") else 0.0
    state = jax.eval_shape(task.reset, jax.random.key(0))
    values = {}
    for name, leaf in vars(state).items():
        kind = name.removeprefix("active_").removeprefix("box_")
        if name.startswith("active_"):
            bounds = getattr(task, name)
            values[name] = jnp.int32(bounds[0] if bounds else getattr(task, f"num_{kind}"))
        elif kind == "present":
            values[name] = jnp.arange(leaf.shape[0]) < (task.active_boxes or leaf.shape)[0]
        elif "position" in name:
            values[name] = jnp.asarray(rng.uniform(low, low + task.side, leaf.shape), jnp.float32)
        else:
            values[name] = jnp.asarray(rng.uniform(0, 3, leaf.shape), leaf.dtype)
    return state.replace(**values)


def bodies(picture):
    return np.concatenate([np.asarray(kind.position) for kind in picture.kinds.values()])


def test_every_task_has_a_scene():
    assert {name for name, _ in CASES.values()} == set(TASKS)


def test_scenes_need_numpy_only():
    tree = ast.parse(Path(scene.__file__).read_text())
    imported = {node.module if isinstance(node, ast.ImportFrom) else node.names[0].name
                for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)}  # fmt: skip
    assert imported == {"math", "typing", "numpy"}


@every_task
def test_distances_perceived_are_those_to_the_bodies_in_the_slots(case):
    """The first feature is the distance, up to a factor for each group."""
    obs, slots, picture = look(case)
    place, side = bodies(picture), float(picture.high[0] - picture.low[0])
    assert slots.keys() == obs.groups.keys()
    for name, group in obs.groups.items():
        mask, index = np.asarray(group.mask), np.asarray(slots[name])
        assert index.shape == mask.shape
        assert mask.any()
        assert (index[mask] >= 0).all()
        way = place[index] - np.asarray(picture.agents.position)[:, None]
        if picture.is_torus:
            way -= side * np.round(way / side)
        factor = np.asarray(group.features)[..., 0][mask] / np.linalg.norm(way, axis=-1)[mask]
        np.testing.assert_allclose(factor, factor[0], rtol=1e-4)


@every_task
def test_no_agent_has_a_body_in_two_slots_or_itself(case):
    obs, slots, _ = look(case)
    for agent in range(TASK[case].num_agents):
        seen = [
            int(i) for name, x in slots.items() for i in np.asarray(x[agent])[np.asarray(obs.groups[name].mask[agent])]
        ]
        assert len(set(seen)) == len(seen)
        assert agent not in seen


@every_task
def test_scenes_are_in_the_world(case):
    _, _, picture = look(case)
    assert picture.num_bodies == len(bodies(picture))
    assert (bodies(picture) >= np.asarray(picture.low)).all()
    assert (bodies(picture) <= np.asarray(picture.high)).all()


def test_those_who_take_no_part_are_absent():
    _, _, picture = look("rendezvous, some absent")
    np.testing.assert_array_equal(picture.agents.is_present, [True] * 3 + [False] * 3)
    _, _, picture = look("assembly")
    np.testing.assert_array_equal(picture.boxes.is_present, [True] * 2 + [False] * 2)


def test_clusters_have_groups_and_corners():
    _, _, picture = look("clustering")
    np.testing.assert_array_equal(picture.boxes.group, [0, 0, 1, 1, 2])
    np.testing.assert_array_equal(picture.goals.group, [0, 1, 2])
    np.testing.assert_allclose(picture.goals.position, [[-0.5, -0.5], [0.5, 0.5], [0.5, -0.5]])
    assert look("clustering, one-hot")[2].goals is None


def test_caught_evaders_are_marked():
    task = TASK["pursuit"]
    place = jnp.array([[10.5, 10.0], [60.0, 60.0], [11.5, 10.0]])
    state = random_state(task).replace(position=jnp.full((4, 2), 10.0), evader_position=place)
    np.testing.assert_array_equal(jax.jit(task.scene)(state).is_caught, [True, False, False])
