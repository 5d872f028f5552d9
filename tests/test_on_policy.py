"""Advantages follow their definition, values hold across resets, samples are shuffled, and hyperparameters checked."""

import inspect
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from probes import PROBES

from jaxswarm import AGGREGATORS, LEARNERS, TASKS, ActorCritic, rollout
from jaxswarm.learners import on_policy
from jaxswarm.types import Observation, pytree, static


def advantages_by_definition(reward, is_terminal, is_done, value, next_value, discount, gae_lambda):
    """Return the sums of discounted temporal differences up to the end of the episode."""
    result = np.zeros_like(value)
    for t in range(len(reward)):
        weight = 1.0
        for u in range(t, len(reward)):
            bootstrap = np.where(is_terminal[u], 0.0, next_value[u])
            result[t] += weight * (reward[u] + discount * bootstrap - value[u])
            if is_done[u]:
                break
            weight *= discount * gae_lambda
    return result


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31 - 1), discount=st.floats(0, 1), gae_lambda=st.floats(0, 1))
def test_advantages_are_sums_of_temporal_differences(seed, discount, gae_lambda):
    rng = np.random.default_rng(seed)
    reward, value, next_value = rng.normal(size=(3, 12))
    is_done = rng.random(12) < 0.3
    is_terminal = is_done & (rng.random(12) < 0.5)
    args = (reward[:, None], is_terminal[:, None], is_done[:, None], value[:, None, None], next_value[:, None, None])
    result = ADVANTAGES(*[jnp.asarray(x, jnp.float32 if x.dtype != bool else bool) for x in args], discount, gae_lambda)
    expected = advantages_by_definition(reward, is_terminal, is_done, value, next_value, discount, gae_lambda)
    np.testing.assert_allclose(result[:, 0, 0], expected, atol=1e-4)


ADVANTAGES = jax.jit(on_policy.generalized_advantages)


def test_for_an_agent_that_dies_its_last_step_is_the_end():
    rng = np.random.default_rng(1)
    reward, never = rng.normal(size=(6, 1)).astype(np.float32), np.zeros((6, 1), bool)
    value, next_value = rng.normal(size=(2, 6, 1, 2)).astype(np.float32)
    is_next_absent = np.zeros((6, 1, 2), bool)
    is_next_absent[2:, :, 1] = True  # the second agent dies in the third step
    found = ADVANTAGES(reward, never, never, value, next_value, 0.9, 0.8, is_next_absent)
    is_over = np.arange(6) == 2
    parts = (reward[:, 0], never[:, 0], never[:, 0], value[:, 0, 0], next_value[:, 0, 0])
    np.testing.assert_allclose(found[:, 0, 0], advantages_by_definition(*parts, 0.9, 0.8), atol=1e-5)
    parts = (reward[:, 0], is_over, is_over, value[:, 0, 1], next_value[:, 0, 1])
    np.testing.assert_allclose(found[:3, 0, 1], advantages_by_definition(*parts, 0.9, 0.8)[:3], atol=1e-5)


@pytree
class Dying:
    """Task whose number of agents is 4 minus the state; `observe` returns the mask of present agents."""

    num_agents: int = static(default=4)

    def observe(self, state):
        mask = jnp.arange(self.num_agents) < self.num_agents - state
        return Observation(jnp.zeros((self.num_agents, 1)), {}, mask)


@pytest.mark.slow
def test_agents_are_gone_after_the_step_in_which_they_die():
    time = jnp.arange(3)[:, None]
    trajectory = random_trajectory(PROBES["delayed reward"])[2]
    trajectory = trajectory.replace(final_state=time + 1, reward=jnp.zeros((3, 1)), mask=jnp.ones((3, 1, 4), bool))
    absent = on_policy.next_absent(Dying(), trajectory)
    np.testing.assert_array_equal(absent[:, 0].sum(-1), [1, 2, 3])
    assert not on_policy.next_absent(Dying(), trajectory.replace(mask=None)).any()


@pytest.mark.parametrize(("rows", "columns"), [(1, 7), (4, 1), (2, 8), (164, 1000), (3, 5), (100, 1), (50, 3)])
def test_shuffling_is_a_permutation(rows, columns):
    order = on_policy.shuffled(jax.random.key(0), rows, columns)
    np.testing.assert_array_equal(np.sort(order.reshape(-1)), np.arange(rows * columns))


@pytest.mark.parametrize(("rows", "columns"), [(100, 1), (100, 2), (32, 8)])
def test_neighbors_do_not_follow_each_other(rows, columns):
    """Sample i + 1 is in the minibatch after that of sample i as often as any other sample."""
    keys = jax.random.split(jax.random.key(2), 500)
    order = jax.jit(jax.vmap(lambda key: on_policy.shuffled(key, rows, columns)))(keys).reshape(500, -1)
    minibatch = np.argsort(np.asarray(order), axis=1) // columns
    follows = (np.diff(minibatch, axis=1) == 1).mean()
    assert follows == pytest.approx((rows - 1) / rows**2 * (rows * columns) / (rows * columns - 1), rel=0.15)


@pytest.mark.parametrize(("rows", "columns"), [(2, 16), (16, 16), (40, 10), (100, 1)])
def test_every_sample_is_as_likely_in_every_minibatch(rows, columns):
    num_draws = 2000
    keys = jax.random.split(jax.random.key(1), num_draws)
    order = jax.jit(jax.vmap(lambda key: on_policy.shuffled(key, rows, columns)))(keys).reshape(num_draws, -1)
    minibatch = np.argsort(np.asarray(order), axis=1) // columns  # of each sample
    assert np.abs((minibatch == 0).mean(0) - 1 / rows).max() < 5 / np.sqrt(rows * num_draws)
    is_with_first = (minibatch[:, :1] == minibatch).mean(0)[1:]  # the samples after the first are no exception
    assert np.abs(is_with_first - (columns - 1) / (rows * columns - 1)).max() < 5 / np.sqrt(rows * num_draws)


def random_trajectory(task, num_steps=6, num_envs=3, std="shared"):
    network = ActorCritic(
        encoder=(4,), decoder=(4,), aggregator=AGGREGATORS["mean"](), std=std, action_dim=task.action_dim
    )

    @jax.jit
    def play():
        params = network.init(jax.random.key(0), task.observe(task.reset(jax.random.key(0))))
        envs = rollout.start(jax.random.key(1), task, num_envs, is_desynchronized=False)
        policy = partial(network.apply, params, method="policy")
        _, trajectory, metrics = rollout.collect(jax.random.key(2), task, policy, envs, num_steps, reset_pool=2)
        return params, trajectory, metrics

    return network, *play()


def test_values_after_a_step_are_those_of_the_state_before_any_reset():
    task = PROBES["delayed reward"]
    network, params, trajectory, _ = random_trajectory(task)
    values, next_values = on_policy.trajectory_values(network, params, task, trajectory)
    observe = jax.vmap(jax.vmap(task.observe))
    expected = network.apply(params, observe(trajectory.state), method="value")
    np.testing.assert_allclose(values, expected, atol=1e-6)
    expected = network.apply(params, observe(trajectory.final_state), method="value")
    np.testing.assert_allclose(next_values, expected, atol=1e-6)


def test_fetched_samples_are_those_of_the_trajectory():
    task = PROBES["delayed reward"]
    _, _, trajectory, _ = random_trajectory(task)
    steps, envs, agents = trajectory.log_prob.shape
    number = jnp.arange(steps * envs * agents, dtype=jnp.float32).reshape(steps, envs, agents)
    samples = on_policy.stored_samples(task, trajectory, number, -number)
    batch = on_policy.fetch_agents(task, samples, jnp.array([5, 0, 33]))
    np.testing.assert_array_equal(batch.advantage, [5, 0, 33])
    np.testing.assert_array_equal(batch.log_prob, trajectory.log_prob.reshape(-1)[jnp.array([5, 0, 33])])
    obs = jax.vmap(jax.vmap(task.observe))(trajectory.state)
    np.testing.assert_allclose(batch.obs.own[2], obs.own.reshape(-1, 2)[33])
    batch = on_policy.fetch_envs(task, samples, jnp.array([7, 2]))
    np.testing.assert_array_equal(batch.target, [-14, -15, -4, -5])
    np.testing.assert_allclose(batch.obs.groups["neighbors"].features[1, 0], obs.own[2, 1, 0])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "std"), [("ppo", "shared"), ("trl", "state")])
def test_agents_that_do_not_exist_have_no_influence_on_an_update(name, std):
    task = TASKS["rendezvous"](num_agents=4, active_agents=(2, 3), episode_length=4)
    network, params, trajectory, _ = random_trajectory(task, std=std)
    learner = LEARNERS[name](batch_size=36, num_epochs=1)
    is_absent = jnp.arange(4)[None, None] >= trajectory.state.active_agents[..., None]
    assert is_absent.any()

    def garble(x):
        return jnp.where(is_absent.reshape(*is_absent.shape, *[1] * (x.ndim - 3)), 7.0 + x, x)

    def garbled(state):
        return state.replace(position=garble(state.position), heading=garble(state.heading))

    names = ("action", "log_prob", "action_mean", "action_std")
    other = trajectory.replace(**{field: garble(getattr(trajectory, field)) for field in names})
    other = other.replace(state=garbled(trajectory.state), final_state=garbled(trajectory.final_state))
    update = jax.jit(lambda x: learner.update(jax.random.key(0), learner.init(params), network, task, x))
    (state, metrics), (other_state, other_metrics) = update(trajectory), update(other)
    jax.tree.map(np.testing.assert_array_equal, state.params, other_state.params)
    jax.tree.map(np.testing.assert_array_equal, metrics, other_metrics)
    assert all(np.isfinite(metric) for metric in metrics.values())
    (changed, _) = update(trajectory.replace(action=trajectory.action + 0.1))
    assert any((a != b).any() for a, b in zip(*map(jax.tree.leaves, (state.params, changed.params)), strict=True))


def test_statistics_are_those_of_the_rows_that_exist():
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 20)).astype(np.float32)
    mask = rng.random(20) < 0.5
    present, present_y = x[mask], y[mask]
    expected = (present - present.mean()) / present.std(ddof=1)
    np.testing.assert_allclose(on_policy.standardized(jnp.array(x), jnp.array(mask))[mask], expected, atol=1e-5)
    np.testing.assert_allclose(on_policy.mean(jnp.array(x), jnp.array(mask)), present.mean(), atol=1e-6)
    np.testing.assert_allclose(on_policy.maximum(jnp.array(x**2), jnp.array(mask)), (present**2).max())
    explained = on_policy.explained_variance(jnp.array(x), jnp.array(y), jnp.array(mask))
    np.testing.assert_allclose(explained, 1 - (present_y - present).var() / present_y.var(), rtol=1e-5)
    everywhere = np.ones(20, bool)
    for function in (on_policy.standardized, on_policy.mean):
        np.testing.assert_allclose(
            function(jnp.array(x), None), function(jnp.array(x), jnp.array(everywhere)), atol=1e-6
        )


@pytest.mark.parametrize(("num_agents", "batch_size"), [(20, 1280), (10, 1280), (50, 1600), (7, 896), (3000, 3000)])
def test_the_batch_size_nearest_to_the_usual_one_is_chosen(num_agents, batch_size):
    learner = LEARNERS["ppo"]()
    assert on_policy.batch_size(learner, 32 * 128 * num_agents, num_agents) == batch_size


def test_without_samples_for_a_minibatch_there_is_a_clear_error():
    with pytest.raises(ValueError, match=r"batch_size: must divide .* = 1 and .*, for example none, got None"):
        on_policy.batch_size(LEARNERS["ppo"](), 1, 1)


def test_targets_without_variance_leave_nothing_to_explain():
    assert np.isnan(on_policy.explained_variance(jnp.array([0.0, 1.0]), jnp.array([2.0, 2.0]), None))


@pytest.mark.parametrize("learner", LEARNERS)
def test_hyper_parameters_may_be_arrays(learner):
    rates = np.logspace(-4, -2, 3)
    np.testing.assert_array_equal(LEARNERS[learner](learning_rate=rates).learning_rate, rates)


@pytest.mark.parametrize("learner", LEARNERS)
def test_impossible_hyper_parameters_are_named(learner):
    for field, value in {
        "learning_rate": -1.0,
        "discount": 1.5,
        "num_epochs": 0,
        "batch_size": 0,
        "sampling_unit": "x",
        "bootstrap_truncation": "false",
    }.items():
        with pytest.raises(ValueError, match=f"{field}: must be .*, got {value!r}"):
            LEARNERS[learner](**{field: value})


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("terminated", lambda x: x[1:]),
        ("log_prob", lambda x: x[..., 1:]),
        ("action_std", lambda x: x[..., :0]),
        ("state", lambda x: jax.tree.map(lambda leaf: leaf[:, 1:], x)),
    ],
)
def test_trajectories_with_other_leading_axes_are_refused(field, change):
    task = PROBES["delayed reward"]
    axes, state = (6, 3, 2), jax.eval_shape(jax.vmap(jax.vmap(task.reset)), jax.random.split(jax.random.key(0), (6, 3)))
    actions, flags = jax.ShapeDtypeStruct((*axes, 1), jnp.float32), jax.ShapeDtypeStruct(axes[:2], bool)
    reward, log_prob = (jax.ShapeDtypeStruct(shape, jnp.float32) for shape in (axes[:2], axes))
    right = rollout.Trajectory(state, actions, log_prob, actions, actions, reward, flags, flags, state, None)
    jax.eval_shape(on_policy.check_trajectory, right)

    def check(trajectory):
        on_policy.check_trajectory(trajectory.replace(**{field: change(getattr(trajectory, field))}))

    with pytest.raises(ValueError, match=r"trajectory: must have .* axes|trajectory: must have actions"):
        jax.eval_shape(check, right)


def test_agents_of_advantages_have_next_values():
    flags, value = jnp.zeros((6, 1), bool), jnp.zeros((6, 1, 2))
    args = (jnp.zeros((6, 1)), flags, flags, value)
    unchecked = inspect.unwrap(on_policy.generalized_advantages)  # without the run-time types of the tests
    with pytest.raises(ValueError, match="different shapes"):
        unchecked(*args, value[..., :1], 0.9, 0.8)
    with pytest.raises(ValueError, match=r"expected \(6, 1, None\)"):
        unchecked(*args, value[1:], 0.9, 0.8)
