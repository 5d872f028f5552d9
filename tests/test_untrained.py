"""Tests that untrained policies score as in the thesis, which requires correct tasks, networks and evaluation."""

from functools import partial

import jax
import pytest

from jaxswarm import TASKS, ActorCritic, rollout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "fields", "score", "num_policies"),
    [
        ("rendezvous", {"relative_velocity": "thesis"}, -337.6, 32),
        ("pursuit", {}, -237.7, 64),
        ("pursuit", {"num_agents": 50, "num_evaders": 5, "reward": "catches"}, 0.378, 16),
    ],
    ids=["rendezvous", "one evader", "five evaders"],
)
def test_untrained_policies_score_what_those_of_the_thesis_did(name, fields, score, num_policies):
    """Expected scores are means of 117, 155 and 815 runs of the thesis; the tolerance is 3 standard errors of ours."""
    task, network = TASKS[name](**fields), ActorCritic()

    @jax.jit
    def mean_return(key):
        params_key, obs_key, eval_key = jax.random.split(key, 3)
        params = network.init(params_key, task.observe(task.reset(obs_key)))
        policy = partial(network.apply, params, method="policy")
        return rollout.evaluate(eval_key, task, policy, num_envs=8)["return"]

    returns = jax.lax.map(mean_return, jax.random.split(jax.random.key(0), num_policies))
    standard_error = returns.std() / num_policies**0.5
    assert abs(returns.mean() - score) < 3 * standard_error
    assert standard_error < 0.2 * abs(score)
