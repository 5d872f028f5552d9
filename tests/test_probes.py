"""Every learner finds the known values and best actions of the probe tasks; trust regions bound its updates."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import CASES, OPTIONS, PROBES, policy_and_value, train_probes
from test_projections import cov_distance, mean_distance

from jaxswarm import LEARNERS
from jaxswarm.learners.projections import PROJECTIONS


@pytest.fixture(scope="module", params=CASES)
def outputs(request):
    """Action and value as a function of (probe, cue, time), after the vectorized training of all probes."""
    results = train_probes(*request.param)

    def output(probe, cue, time):
        params = jax.tree.map(lambda x: x[-1], results[probe][0])
        policy, value = policy_and_value(params, cue, time)
        return float(policy.mean()[0]), float(value)

    output.returns = {probe: returns for probe, (_, returns) in results.items()}
    return output


@pytest.mark.slow
def test_value_of_a_constant_reward(outputs):
    assert outputs("constant reward", 1, 0)[1] == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("cue", [-1, 1])
def test_value_that_depends_on_the_observation(outputs, cue):
    assert outputs("reward that depends on the observation", cue, 0)[1] == pytest.approx(cue, abs=0.15)


@pytest.mark.slow
@pytest.mark.parametrize(("time", "value"), [(0, OPTIONS["discount"]), (1, 1.0)])
def test_value_of_a_delayed_reward_is_discounted(outputs, time, value):
    assert outputs("delayed reward", 1, time)[1] == pytest.approx(value, abs=0.1)


@pytest.mark.slow
def test_best_action(outputs):
    assert outputs("reward that depends on the action", 1, 0)[0] == pytest.approx(0.5, abs=0.15)
    returns = outputs.returns["reward that depends on the action"]
    assert returns[20] > returns[0]


@pytest.mark.slow
@pytest.mark.parametrize("cue", [-1, 1])
def test_best_action_that_depends_on_the_observation(outputs, cue):
    assert outputs("reward that depends on both", cue, 0)[0] == pytest.approx(cue / 2, abs=0.15)


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, 0))
@partial(jax.vmap, in_axes=(0, None, None))
def mean_and_std(params, cue, time):
    policy, _ = policy_and_value(params, cue, time)
    return policy.mean(), policy.stddev()


@pytest.mark.slow
@pytest.mark.parametrize("probe", PROBES)
@pytest.mark.parametrize("name", PROJECTIONS)
def test_successive_policies_are_within_the_bounds(name, probe):
    """The standard deviation is exactly within its bound, the mean on average within twice its bound.

    Only the regression loss draws the mean back.
    """
    params, _ = train_probes("trl", name)[probe]
    mean_bound, cov_bound = LEARNERS["trl"]().mean_bound, LEARNERS["trl"]().cov_bound
    states = jnp.array([-1, -1, 1, 1]), jnp.array([0, 1, 0, 1])
    mean, std = (np.asarray(x, np.float64) for x in mean_and_std(params, *states))
    (mean, old_mean), (std, old_std) = ((x[:, 1:], x[:, :-1]) for x in (mean, std))
    assert cov_distance(name, std, old_std).max() <= cov_bound * 1.001
    assert mean_distance(name, mean, old_mean, old_std).mean(0).max() <= mean_bound * 2
    if name in ("kl", "wasserstein"):  # only their bounds limit the divergence for any standard deviation
        divergence = mean_distance("kl", mean, old_mean, old_std) + cov_distance("kl", std, old_std)
        assert divergence.mean(0).max() <= mean_bound * 2 + cov_bound * 1.1
