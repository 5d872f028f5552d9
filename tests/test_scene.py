"""Tests of the scenes of tasks, and of `slots`, which maps the slots of observations to bodies of the scene."""

import ast
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxswarm import TASKS, scene

CASES = {
    "rendezvous, nearest only": ("rendezvous", {"num_agents": 6, "max_neighbors": 2, "visibility_radius": 50.0}),
    "rendezvous, some absent": ("rendezvous", {"num_agents": 6, "active_agents": (3, 3), "torus": True}),
    "pursuit": ("pursuit", {"num_agents": 4, "num_evaders": 3, "evader_visibility_radius": 40.0}),
    "assembly": ("assembly", {"num_agents": 3, "num_boxes": 4, "active_boxes": (2, 2)}),
    "clustering": ("clustering", {"num_agents": 3, "num_boxes": 5, "num_clusters": 3, "reward": "corners"}),
    "clustering, one-hot": ("clustering", {"num_agents": 3, "cluster_identity": "one-hot"}),
}
TASK = {case: TASKS[name](**fields) for case, (name, fields) in CASES.items()}
every_task = pytest.mark.parametrize("case", CASES)


@functools.cache
def observe_random_state(case):
    """Return the observation, the slots and the scene of a random state."""
    task = TASK[case]

    @jax.jit
    def describe(state):
        return task.observe(state), task.slots(state), task.scene(state)

    return describe(random_state(task))


def random_state(task):
    """Draw a state with random values and the smallest possible number of active entities."""
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


def positions(task_scene):
    return np.concatenate([np.asarray(kind.position) for kind in task_scene.kinds.values()])


def test_every_task_has_a_scene():
    assert {name for name, _ in CASES.values()} == set(TASKS)


def test_scenes_need_numpy_only():
    tree = ast.parse(Path(scene.__file__).read_text())
    imported = {node.module if isinstance(node, ast.ImportFrom) else node.names[0].name
                for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)}  # fmt: skip
    assert imported == {"math", "typing", "numpy"}


@every_task
def test_distances_perceived_are_those_to_the_bodies_in_the_slots(case):
    """The first feature is proportional to the distance, with one factor per group."""
    obs, slots, task_scene = observe_random_state(case)
    position, side = positions(task_scene), float(task_scene.high[0] - task_scene.low[0])
    assert slots.keys() == obs.groups.keys()
    for name, group in obs.groups.items():
        mask, index = np.asarray(group.mask), np.asarray(slots[name])
        assert index.shape == mask.shape
        assert mask.any()
        assert (index[mask] >= 0).all()
        displacement = position[index] - np.asarray(task_scene.agents.position)[:, None]
        if task_scene.is_torus:
            displacement -= side * np.round(displacement / side)
        factor = np.asarray(group.features)[..., 0][mask] / np.linalg.norm(displacement, axis=-1)[mask]
        np.testing.assert_allclose(factor, factor[0], rtol=1e-4)


@every_task
def test_no_agent_has_a_body_in_two_slots_or_itself(case):
    obs, slots, _ = observe_random_state(case)
    for agent in range(TASK[case].num_agents):
        seen = [
            int(i) for name, x in slots.items() for i in np.asarray(x[agent])[np.asarray(obs.groups[name].mask[agent])]
        ]
        assert len(set(seen)) == len(seen)
        assert agent not in seen


@every_task
def test_scenes_are_in_the_world(case):
    _, _, task_scene = observe_random_state(case)
    assert task_scene.num_bodies == len(positions(task_scene))
    assert (positions(task_scene) >= np.asarray(task_scene.low)).all()
    assert (positions(task_scene) <= np.asarray(task_scene.high)).all()


def test_those_who_take_no_part_are_absent():
    _, _, task_scene = observe_random_state("rendezvous, some absent")
    np.testing.assert_array_equal(task_scene.agents.is_present, [True] * 3 + [False] * 3)
    _, _, task_scene = observe_random_state("assembly")
    np.testing.assert_array_equal(task_scene.boxes.is_present, [True] * 2 + [False] * 2)


def test_clusters_have_groups_and_corners():
    _, _, task_scene = observe_random_state("clustering")
    np.testing.assert_array_equal(task_scene.boxes.group, [0, 0, 1, 1, 2])
    np.testing.assert_array_equal(task_scene.goals.group, [0, 1, 2])
    np.testing.assert_allclose(task_scene.goals.position, [[-0.5, -0.5], [0.5, 0.5], [0.5, -0.5]])
    assert observe_random_state("clustering, one-hot")[2].goals is None


def test_caught_evaders_are_marked():
    task = TASK["pursuit"]
    evaders = jnp.array([[10.5, 10.0], [60.0, 60.0], [11.5, 10.0]])
    state = random_state(task).replace(position=jnp.full((4, 2), 10.0), evader_position=evaders)
    np.testing.assert_array_equal(jax.jit(task.scene)(state).is_caught, [True, False, False])
