"""Every learner finds the known values and best actions of the probe tasks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import PROBES, State

import jaxswarm
from jaxswarm import AGGREGATORS, LEARNERS, ActorCritic, Experiment

OPTIONS = {"num_epochs": 8, "batch_size": 64, "learning_rate": 3e-3, "discount": 0.5}
NETWORK = ActorCritic(encoder=(8,), decoder=(16,), aggregator=AGGREGATORS["mean"](), action_dim=1)


@pytest.fixture(scope="module", params=LEARNERS)
def outputs(request):
    """Action and value by (probe, cue, time) after training all probes side by side."""
    learner = LEARNERS[request.param](**OPTIONS)
    sizes = {"num_worlds": 64, "num_steps": 2, "eval_worlds": 8, "eval_every": 20}

    def train(task):
        experiment = Experiment(task, NETWORK, learner, **sizes)
        state, metrics = jaxswarm.train(experiment, jaxswarm.init(experiment, jax.random.key(0)), 40)
        return state.learner.params, metrics["eval/return"]

    tasks = jax.tree.map(lambda *x: jnp.array(x), *PROBES.values())
    params, returns = jax.jit(jax.vmap(train))(tasks)

    def look(params, cue, time):
        policy, value = NETWORK.apply(params, next(iter(PROBES.values())).observe(State(jnp.full((2,), cue), time)))
        return policy.mean()[0, 0], value[0]

    def output(probe, cue, time):
        one = jax.tree.map(lambda x: x[list(PROBES).index(probe)], params)
        return [float(x) for x in look(one, float(cue), jnp.int32(time))]

    output.returns = dict(zip(PROBES, np.asarray(returns), strict=True))
    return output


def test_value_of_a_constant_reward(outputs):
    assert outputs("constant reward", 1, 0)[1] == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("cue", [-1, 1])
def test_value_that_depends_on_the_observation(outputs, cue):
    assert outputs("reward that depends on the observation", cue, 0)[1] == pytest.approx(cue, abs=0.15)


@pytest.mark.parametrize(("time", "value"), [(0, OPTIONS["discount"]), (1, 1.0)])
def test_value_of_a_delayed_reward_is_discounted(outputs, time, value):
    assert outputs("delayed reward", 1, time)[1] == pytest.approx(value, abs=0.1)


def test_best_action(outputs):
    assert outputs("reward that depends on the action", 1, 0)[0] == pytest.approx(0.5, abs=0.15)
    returns = outputs.returns["reward that depends on the action"]
    assert returns[20] > returns[0]


@pytest.mark.parametrize("cue", [-1, 1])
def test_best_action_that_depends_on_the_observation(outputs, cue):
    assert outputs("reward that depends on both", cue, 0)[0] == pytest.approx(cue / 2, abs=0.15)
