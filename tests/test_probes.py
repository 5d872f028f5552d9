"""Every learner finds the known values and best actions of the probe tasks."""

import jax
import pytest
from probes import CASES, OPTIONS, look, train_probes


@pytest.fixture(scope="module", params=CASES, ids=["-".join(filter(None, case)) for case in CASES])
def outputs(request):
    """Action and value by (probe, cue, time) after training all probes side by side."""
    results = train_probes(*request.param)

    def output(probe, cue, time):
        params = jax.tree.map(lambda x: x[-1], results[probe][0])
        policy, value = look(params, cue, time)
        return float(policy.mean()[0]), float(value)

    output.returns = {probe: returns for probe, (_, returns) in results.items()}
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
