"""Tests of the contract that every registered task fulfills."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxswarm.tasks import TASKS
from jaxswarm.types import Observation

NUM_AGENTS, EPISODE_LENGTH, NUM_ENVS = 4, 6, 3
KEY = jax.random.key(1)
VARIANTS = {
    "defaults": {},
    "numbers vary, nearest only": {"active_agents": (2, 3), "max_neighbors": 2, "visibility_radius": 60.0},
    "boxes vary": {"active_boxes": (1, 3)},
}


def has_fields(cls, fields):
    return fields.keys() <= {field.name for field in dataclasses.fields(cls)}


def case(name, variant):
    is_slow = has_fields(TASKS[name], {"physics": None})  # rigid-body steps take long to compile
    return pytest.param((name, variant), marks=[pytest.mark.slow] if is_slow else [], id=f"{name} {variant}")


@pytest.fixture(params=[case(name, x) for name in TASKS for x in VARIANTS if has_fields(TASKS[name], VARIANTS[x])])
def task(request):
    name, variant = request.param
    return TASKS[name](num_agents=NUM_AGENTS, episode_length=EPISODE_LENGTH, **VARIANTS[variant])


@jax.jit
def reset(task, key):
    return task.reset(key)


@jax.jit
def step(task, key, state, action):
    return task.step(key, state, action)


@jax.jit
def observe(task, state):
    return task.observe(state)


def random_actions(task, *axes):
    return jax.random.uniform(KEY, (*axes, task.num_agents, task.action_dim), minval=-1)


def shapes_and_types(tree):
    return jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree)


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def assert_close(a, b, atol=1e-6):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5, atol=atol), a, b)


def number_fields(task):
    return [field.name for field in dataclasses.fields(task) if isinstance(getattr(task, field.name), float)]


def test_states_keep_their_shapes_and_types(task):
    state = reset(task, KEY)
    next_state, _ = step(task, KEY, state, random_actions(task))
    assert shapes_and_types(next_state) == shapes_and_types(state)
    assert state.time == 0
    assert next_state.time == 1


def test_in_double_precision_states_keep_their_types_too(task):
    with jax.enable_x64(True):
        start, (next_state, outcome), obs = jax.eval_shape(
            lambda key, action: (state := task.reset(key), task.step(key, state, action), task.observe(state)),
            KEY,
            jax.ShapeDtypeStruct((NUM_AGENTS, task.action_dim), jnp.float64),
        )
    assert shapes_and_types(next_state) == shapes_and_types(start)
    assert start.position.dtype == outcome.reward.dtype == obs.own.dtype == jnp.float64


@pytest.mark.slow
def test_steps_outside_of_any_program_compile_once(task):
    """The grid of cells is an exception: it serves large swarms, whose steps are always compiled."""
    if getattr(task, "max_neighbors", None):
        pytest.skip("lists of nearest neighbors compile at every step outside of a compiled function")
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **_: compiled.append(event) if "backend_compile" in event else None
    )
    state, action = task.reset(KEY), jnp.zeros((NUM_AGENTS, task.action_dim))
    jax.jit(lambda x: x + len(compiled))(1)
    assert compiled  # the listener receives compile events
    state, _ = task.step(KEY, state, action)
    compiled.clear()
    task.step(KEY, state, action)
    assert not compiled


def test_steps_are_scalars(task):
    _, outcome = step(task, KEY, reset(task, KEY), random_actions(task))
    assert shapes_and_types(outcome.reward) == ((), jnp.float32)
    assert shapes_and_types(outcome.terminated) == shapes_and_types(outcome.truncated) == ((), jnp.bool)
    assert outcome.metrics
    assert all(metric.shape == () for metric in outcome.metrics.values())


def test_observations_have_an_own_part_and_masked_groups(task):
    obs = observe(task, reset(task, KEY))
    assert isinstance(obs, Observation)
    assert obs.own.shape[0] == NUM_AGENTS
    assert obs.own.dtype == jnp.float32
    for group in obs.groups.values():
        assert group.features.shape[:2] == group.mask.shape
        assert group.features.shape[0] == NUM_AGENTS
        assert group.features.dtype == jnp.float32
        assert group.mask.dtype == jnp.bool


@pytest.mark.parametrize("num_agents", [3, 9])
def test_any_number_of_agents_gives_features_of_the_same_size(task, num_agents):
    other = task.replace(num_agents=num_agents)
    obs, other_obs = observe(task, reset(task, KEY)), observe(other, reset(other, KEY))
    assert other_obs.own.shape == (num_agents, obs.own.shape[1])
    sizes, other_sizes = (
        {name: group.features.shape[-1] for name, group in o.groups.items()} for o in (obs, other_obs)
    )
    assert other_sizes == sizes


def test_everything_stays_finite(task):
    """Metrics are an exception: they are NaN at steps without a value."""
    state, actions = reset(task, KEY), random_actions(task, 50)
    for action in actions:
        state, outcome = step(task, KEY, state, action)
        finite = (state, outcome.reward, observe(task, state))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(finite))
        assert not any(np.isinf(metric) for metric in outcome.metrics.values())


def test_the_time_limit_truncates_at_exactly_the_episode_length(task):
    state, truncated = reset(task, KEY), []
    for _ in range(EPISODE_LENGTH):
        state, outcome = step(task, KEY, state, random_actions(task))
        truncated.append(bool(outcome.truncated))
    assert truncated == [False] * (EPISODE_LENGTH - 1) + [True]


def test_one_agent_perceives_what_all_observe(task):
    state = reset(task, KEY)
    view, obs, perceive = jax.jit(task.view)(state), observe(task, state), jax.jit(task.perceive)
    for agent in range(NUM_AGENTS):
        assert_close(perceive(view, jnp.array(agent)), jax.tree.map(lambda leaf, i=agent: leaf[i], obs))


def test_views_grow_no_faster_than_the_number_of_agents(task):
    few, many = (jax.eval_shape(lambda t: t.view(t.reset(KEY)), task.replace(num_agents=n)) for n in (5, 10))
    for small, large in zip(jax.tree.leaves(few), jax.tree.leaves(many), strict=True):
        assert large.size in (small.size, 2 * small.size)  # leaves of other entities, or of agents


def test_observations_are_functions_of_the_state(task):
    state, _ = step(task, KEY, reset(task, KEY), random_actions(task))
    assert_equal(observe(task, state), observe(task, state.replace(time=state.time + 3)))


def test_environments_are_batched_by_vmap(task):
    keys = jax.random.split(KEY, NUM_ENVS)
    actions = random_actions(task, NUM_ENVS)
    starts = jax.vmap(reset, (None, 0))(task, keys)
    states, steps = jax.vmap(step, (None, 0, 0, 0))(task, keys, starts, actions)
    all_obs = jax.vmap(observe, (None, 0))(task, states)
    for env in range(NUM_ENVS):
        state, outcome = step(task, keys[env], reset(task, keys[env]), actions[env])
        expected = state, outcome, observe(task, state)
        assert_close(jax.tree.map(lambda leaf, i=env: leaf[i], (states, steps, all_obs)), expected, atol=1e-5)


@pytest.mark.slow
def test_compiled_steps_are_those_of_plain_python(task):
    if hasattr(task, "physics"):
        pytest.skip("a rigid-body step takes a minute without jit; test_rigid2d compares it to closed forms and Box2D")
    start, action = reset(task, KEY), random_actions(task)
    with jax.disable_jit():
        plain = task.step(KEY, start, action)
    assert_close(step(task, KEY, start, action), plain, atol=1e-5)


@pytest.mark.slow
def test_numbers_are_leaves_to_be_mapped_over(task):
    names = number_fields(task)
    assert "side" in names
    assert len(jax.tree.leaves(task)) == len(names)

    def play(task):
        state, outcome = step(task, KEY, reset(task, KEY), random_actions(task))
        return outcome, observe(task, state)

    others = [task.replace(**{name: 0.5 * getattr(task, name)}) for name in names]
    tasks = jax.tree.map(lambda *leaves: jnp.array(leaves), task, *others)
    outcomes = jax.vmap(play)(tasks)
    assert_close(jax.tree.map(lambda leaf: leaf[0], outcomes), play(task), atol=1e-5)
    leaves = [np.asarray(leaf, float) for leaf in jax.tree.leaves(outcomes)]
    for index in range(1, len(names) + 1):
        assert any(not np.array_equal(leaf[0], leaf[index], equal_nan=True) for leaf in leaves)


def test_trees_of_tasks_can_be_rebuilt(task):
    assert jax.tree.map(lambda leaf: leaf, task) == task
    assert jax.eval_shape(lambda task: task, task).num_agents == NUM_AGENTS


@jax.jit
def slope(task, position, offset):
    """Return the gradient of all observations and rewards with agents at `position + offset`, and one step later."""

    def total(offset):
        start = task.reset(KEY).replace(position=position + offset)
        next_state, outcome = task.step(KEY, start, random_actions(task))
        floats = (task.observe(start), task.observe(next_state), outcome.reward)
        return sum(leaf.astype(jnp.float32).sum() for leaf in jax.tree.leaves(floats))

    return jax.grad(total)(offset)


@pytest.mark.slow
@pytest.mark.parametrize("distance", [0.0, 1e-20, 1e-3])
@pytest.mark.parametrize("corner", [0.0, 1.0])
def test_gradients_are_finite_even_between_agents_at_one_place(task, distance, corner):
    shape = (NUM_AGENTS, 2)
    offset = distance * jnp.broadcast_to(jnp.arange(NUM_AGENTS, dtype=jnp.float32)[:, None], shape)
    assert jnp.isfinite(slope(task, jnp.full(shape, corner), offset)).all()


def test_comparable_metrics_exist_and_depend_on_fields_of_the_task(task):
    fields = {field.name for field in dataclasses.fields(task)}
    _, outcome = step(task, KEY, reset(task, KEY), random_actions(task))
    for metric, settings, _ in task.comparable_metrics:
        assert metric in outcome.metrics
        assert set(settings) <= fields
