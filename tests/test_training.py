"""The training program: equal bits for any chunks, vectorized seeds and numbers, separate evaluations."""

from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxswarm
from jaxswarm import AGGREGATORS, LEARNERS, ActorCritic, Experiment
from jaxswarm.host import manifest
from jaxswarm.learners.on_policy import LearnerState
from jaxswarm.training import train_chunk
from jaxswarm.types import pytree

TASK = jaxswarm.make("rendezvous", num_agents=3, episode_length=6)
NETWORK = ActorCritic(encoder=(4,), decoder=(4,), aggregator=AGGREGATORS["bayesian"]())
LEARNER = LEARNERS["ppo"](num_epochs=2, batch_size=12)
SIZES = {"num_envs": 2, "num_steps": 4, "num_eval_envs": 2, "eval_every": 2}
EXPERIMENT = Experiment(TASK, NETWORK, LEARNER, **SIZES)
init = jax.jit(jaxswarm.init)


@pytest.fixture(scope="module")
def run():
    state = init(EXPERIMENT, jax.random.key(0))
    return state, *jaxswarm.train(EXPERIMENT, state, 5)


def assert_same_bits(one, two):
    def check(a, b):
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)

    jax.tree.map(check, one, two)


@pytest.mark.slow
def test_single_updates_and_one_call_give_the_same_bits(run):
    state, expected, expected_metrics = run
    rows = []
    for _ in range(5):
        state, metrics = jaxswarm.train(EXPERIMENT, state, 1)
        rows.append(metrics)
    assert_same_bits(state, expected)
    assert_same_bits(jax.tree.map(lambda *x: jnp.concatenate(x), *rows), expected_metrics)


@pytest.mark.slow
def test_chunks_of_any_length_share_one_program_and_give_the_same_bits(run):
    state, expected, expected_metrics = run
    once = chex.assert_max_traces(train_chunk, n=1)
    chunk = jax.jit(once, static_argnames="size", donate_argnames="train_state")
    state, first = chunk(EXPERIMENT, jax.tree.map(jnp.copy, state), 3, size=3)
    state, second = chunk(EXPERIMENT, state, 2, size=3)
    assert_same_bits(state, expected)
    rows = {name: np.concatenate([first[name], second[name][:2]]) for name in first}
    assert_same_bits(rows, expected_metrics)
    assert all(np.isnan(x[2]) for x in second.values())


@pytest.mark.slow
def test_evaluations_are_due_before_every_second_update(run):
    _, _, metrics = run
    assert metrics.keys() >= {"eval/return", "eval/distance", "train/return", "learner/approx_kl"}
    np.testing.assert_array_equal(np.isfinite(metrics["eval/return"]), [True, False, True, False, True])


@pytest.mark.slow
def test_evaluation_does_not_change_training(run):
    state, expected, _ = run
    without = EXPERIMENT.replace(eval_every=1000)
    assert_same_bits(jaxswarm.train(without, state, 5)[0], expected)


@pytest.mark.slow
def test_the_program_evaluates_as_the_function_does(run):
    state, _, metrics = run
    for name, value in jax.jit(jaxswarm.evaluate)(EXPERIMENT, state).items():
        np.testing.assert_allclose(value, metrics[name][0], rtol=1e-5)


@pytest.mark.slow
def test_seeds_side_by_side_equal_single_runs(run):
    _, expected, expected_metrics = run
    keys = jnp.stack([jax.random.key(0), jax.random.key(1)])
    states = jax.vmap(jaxswarm.init, (None, 0))(EXPERIMENT, keys)
    states, metrics = jax.vmap(lambda state: jaxswarm.train(EXPERIMENT, state, 5))(states)
    one, two = (jax.tree.leaves(x.learner.params) for x in (jax.tree.map(lambda x: x[0], states), expected))
    for a, b in zip(one, two, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    np.testing.assert_array_equal(np.isnan(metrics["eval/return"][0]), np.isnan(expected_metrics["eval/return"]))
    assert not np.allclose(metrics["eval/return"][0, 0], metrics["eval/return"][1, 0])


@pytest.mark.slow
def test_every_number_that_fixes_no_shape_can_be_swept():
    leaves = jax.tree.leaves(EXPERIMENT)
    assert all(isinstance(x, float) for x in leaves)
    state = init(EXPERIMENT, jax.random.key(0))

    def final_params(number, index):
        swept = [x if i != index else number for i, x in enumerate(leaves)]
        experiment = jax.tree.unflatten(jax.tree.structure(EXPERIMENT), swept)
        state_after, _ = jaxswarm.train(experiment, state, 1)
        return state_after.learner.params["params"]["actor"]["neighbors_encoder"]["kernel"]

    rate = leaves.index(LEARNER.learning_rate)
    params = jax.vmap(final_params, (0, None))(jnp.array([0.0, 1e-3]), rate)
    np.testing.assert_array_equal(params[0], state.learner.params["params"]["actor"]["neighbors_encoder"]["kernel"])
    assert not np.allclose(params[0], params[1])


@pytest.mark.parametrize("sampling_unit", ["agents", "envs"])
def test_a_swarm_of_one_trains(sampling_unit):
    task = jaxswarm.make("pursuit", num_agents=1, episode_length=5)
    learner = LEARNERS["ppo"](sampling_unit=sampling_unit, batch_size=4)
    experiment = Experiment(task, NETWORK, learner, num_envs=2, num_steps=4, num_eval_envs=2)
    state = jax.eval_shape(jaxswarm.init, experiment, jax.random.key(0))
    _, metrics = jax.eval_shape(partial(jaxswarm.train, num_updates=1), experiment, state)
    assert metrics["eval/return"].shape == (1,)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_envs": 0}, "num_envs: must be .*an integer >= 1, got 0"),
        ({"num_steps": 2.5}, r"num_steps: must be .* got 2.5"),
        ({"eval_every": -1}, r"eval_every: must be .* got -1"),
        ({"desynchronized_start": "no"}, r"desynchronized_start: must be .*true or false.*, got 'no'"),
        ({"learner": "ppo"}, r"learner: must be .*an object with `update`.*, got 'ppo'"),
        ({"task": jaxswarm.TASKS["pursuit"]}, r"task: must be .*an object with `reset`.*, got .*"),
        ({"network": ActorCritic(action_dim=3)}, r"action_dim: must be 2 for Rendezvous, got 3"),
        (
            {"learner": LEARNER.replace(batch_size=18)},
            r"batch_size: must divide .* = 24 and be a multiple of 3, .*, got 18",
        ),
        ({"learner": LEARNER.replace(batch_size=8)}, r"batch_size: must .*for example 3, 6, 12, 24, got 8"),
        ({"learner": LEARNER.replace(batch_size=48)}, r"batch_size: must .*, got 48"),
        (
            {"learner": LEARNER.replace(batch_size=9, sampling_unit="agents")},
            r"batch_size: must .*multiple of 1, .*, got 9",
        ),
    ],
)
def test_impossible_sizes_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        EXPERIMENT.replace(**changes)


def test_more_samples_than_can_be_numbered_are_an_error():
    with pytest.raises(ValueError, match=r"num_envs \* num_steps \* num_agents: must be at most"):
        EXPERIMENT.replace(num_envs=2**20, num_steps=2**20)


def test_every_episode_of_an_update_has_a_start_of_its_own():
    assert [EXPERIMENT.replace(num_steps=n, num_envs=12 // n).num_start_states for n in (4, 6, 12)] == [1, 1, 2]
    assert EXPERIMENT.replace(reset_pool=5).num_start_states == 5
    with pytest.raises(ValueError, match=r"reset_pool: must be .*an integer >= 1, got 0"):
        EXPERIMENT.replace(reset_pool=0)


@pytest.mark.slow
def test_a_learner_needs_no_more_than_init_and_update():
    """A learner without the hyperparameters that on-policy learners share."""

    @pytree
    class Idle:
        def init(self, params):
            return LearnerState(params, ())

        def update(self, key, state, network, task, trajectory):
            return state, {"loss": trajectory.reward.mean()}

    experiment = EXPERIMENT.replace(learner=Idle())
    state, metrics = jaxswarm.train(experiment, jaxswarm.init(experiment, jax.random.key(0)), 2)
    assert int(state.update) == 2
    assert np.isfinite(metrics["learner/loss"]).all()
    assert "gradient_steps" not in manifest.describe(experiment, 2, [0])["steps"]


@pytest.mark.slow
def test_desynchronized_environments_start_at_random_times():
    experiment = Experiment(
        TASK.replace(episode_length=1000), NETWORK, LEARNER, **SIZES | {"num_envs": 50, "num_steps": 12}
    )
    assert len(np.unique(init(experiment, jax.random.key(0)).envs.state.time)) > 40
    experiment = experiment.replace(desynchronized_start=False)
    np.testing.assert_array_equal(init(experiment, jax.random.key(0)).envs.state.time, 0)


@pytest.mark.slow
def test_train_traces_once_for_many_calls(run):
    state, _, _ = run
    before = jaxswarm.train._cache_size()
    for rate in (1e-3, 2e-3):
        jaxswarm.train(EXPERIMENT.replace(learner=LEARNER.replace(learning_rate=rate)), state, 5)
    assert jaxswarm.train._cache_size() == before
