"""Tests of policies with changing numbers of agents, and of swarms of ten thousand agents."""

from functools import partial

import jax
import jax.numpy as jnp
import pytest

import jaxswarm
from jaxswarm import LEARNERS, TASKS, ActorCritic, Experiment, rollout


@pytest.mark.slow
def test_ten_thousand_agents_step_and_act_in_little_memory():
    """The compiled program reports its memory without running. One matrix of all pairs would need 400 MB."""
    radius = 100 * (30 / jnp.pi / 10_000) ** 0.5  # about 30 neighbors are visible
    for name in ("rendezvous", "pursuit"):
        task = TASKS[name](num_agents=10_000, visibility_radius=float(radius), max_neighbors=48)
        network = ActorCritic()

        def act(params, key, state, task=task, network=network):
            action = network.apply(params, task.observe(state), method="policy").mean()
            return task.step(key, state, action)

        state, key = jax.eval_shape(task.reset, jax.random.key(0)), jax.random.key(0)
        params = network.init(key, TASKS[name](num_agents=3).observe(TASKS[name](num_agents=3).reset(key)))
        memory = jax.jit(act).lower(params, key, state).compile().memory_analysis()
        assert memory.temp_size_in_bytes < 500e6, name


@pytest.mark.slow
def test_a_policy_trained_with_10_agents_gathers_40():
    network, learner = ActorCritic(), LEARNERS["ppo"]()
    experiment = Experiment(TASKS["rendezvous"](num_agents=10), network, learner)
    state = jaxswarm.init(experiment, jax.random.key(0))

    @jax.jit
    def score(params):
        policy = partial(network.apply, params, method="policy")
        return rollout.evaluate(jax.random.key(1), TASKS["rendezvous"](num_agents=40), policy, 10)["return"]

    untrained = score(state.learner.params)
    state, _ = jaxswarm.train(experiment, state, 40)
    trained = score(state.learner.params)
    assert untrained < -300
    assert trained > -60


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("rendezvous", {"visibility_radius": 60.0}),
        ("pursuit", {"visibility_radius": 30.0, "evader_visibility_radius": 50.0}),
        ("rendezvous", {"active_agents": (5, 20)}),
    ],
)
def test_swarms_with_limited_sight_and_of_changing_size_learn(name, fields):
    experiment = Experiment(TASKS[name](**fields), ActorCritic(), LEARNERS["ppo"]())
    _, metrics = jaxswarm.train(experiment, jaxswarm.init(experiment, jax.random.key(0)), 31)
    untrained, *_, trained = metrics["eval/return"][::10]
    assert trained > 0.7 * untrained  # returns are negative distances: training removes at least 30 %
