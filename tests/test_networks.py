"""Networks reproduce recorded outputs, have the documented sizes and initial weights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from golden_weights import cases, network, observation, params, weights

from jaxswarm import AGGREGATORS, ActorCritic
from jaxswarm.types import Entities, Observation

POLICY_CASES = list(cases("policy.npz"))
ARCHITECTURES = {
    "simple": {"encoder": (64,), "decoder": (64,)},
    "medium": {"encoder": (120, 60), "decoder": (160,)},
    "optimised": {"encoder": (146, 120), "decoder": (19, 177, 162), "activation": "tanh"},
}


def rendezvous_like(num_rows=1, num_slots=3):
    features = jax.random.normal(jax.random.key(1), (num_rows, num_slots, 8))
    group = Entities(features, jnp.ones((num_rows, num_slots), bool))
    return Observation(jax.random.normal(jax.random.key(2), (num_rows, 3)), {"neighbors": group})


@pytest.mark.parametrize(
    ("meta", "arrays"), POLICY_CASES, ids=[f"{m['case']}-{m['variant']}-{m['task']}" for m, _ in POLICY_CASES]
)
def test_outputs_of_recorded_weights(meta, arrays):
    tree = params(meta, weights(arrays, "w/"))
    model, obs = network(meta), observation(meta, arrays["obs"])
    expected = jax.eval_shape(model.init, jax.random.key(0), obs)
    assert jax.tree.map(jnp.shape, tree) == jax.tree.map(jnp.shape, expected)

    @jax.jit
    def outputs(tree, obs, action):
        policy, value = model.apply(tree, obs)
        return {
            "action_mean": policy.mean(),
            "value": value,
            "log_prob": policy.log_prob(action),
            "entropy": policy.entropy(),
        }

    for name, output in outputs(tree, obs, arrays["actions"]).items():
        np.testing.assert_allclose(output, arrays[name], atol=1e-5, rtol=1e-5, err_msg=name)


@pytest.mark.parametrize(
    ("architecture", "aggregator", "count"),
    [
        ("simple", "mean", 10_053),
        ("simple", "bayesian", 11_461),
        ("medium", "mean", 37_645),
        ("medium", "bayesian", 52_405),
        ("optimised", "mean", 107_863),
        ("optimised", "bayesian", 143_623),
    ],
)
def test_parameter_counts_of_the_thesis(architecture, aggregator, count):
    model = ActorCritic(**ARCHITECTURES[architecture], aggregator=AGGREGATORS[aggregator]())
    tree = jax.eval_shape(model.init, jax.random.key(0), rendezvous_like())
    assert sum(x.size for x in jax.tree.leaves(tree)) == count


def test_initial_weights_are_orthogonal_with_the_documented_gains():
    model = ActorCritic(encoder=(8, 6), decoder=(5,), aggregator=AGGREGATORS["bayesian"]())
    tree = model.init(jax.random.key(0), rendezvous_like())["params"]

    def gain(kernel):
        singular_values = np.linalg.svd(kernel, compute_uv=False)
        np.testing.assert_allclose(singular_values, singular_values[0], rtol=1e-4)
        return singular_values[0]

    for tower in (tree["actor"], tree["critic"]):
        encoder = tower["neighbors_encoder"]
        assert encoder["kernel"].shape == (8, 12)  # both parts of a message, initialised as one matrix
        for kernel in (encoder["Dense_0"]["kernel"], encoder["kernel"], tower["Dense_0"]["kernel"]):
            assert gain(kernel) == pytest.approx(np.sqrt(2), rel=1e-4)
        np.testing.assert_array_equal(tower["neighbors_aggregator"]["prior_variance"], 1.0)
        np.testing.assert_array_equal(tower["neighbors_aggregator"]["prior_mean"], 1.0)
    assert gain(tree["action_mean"]["kernel"]) == pytest.approx(0.01, rel=1e-4)
    assert gain(tree["value_head"]["kernel"]) == pytest.approx(1.0, rel=1e-4)
    np.testing.assert_array_equal(tree["log_std"], 0.0)
    assert not np.allclose(tree["actor"]["Dense_0"]["kernel"], tree["critic"]["Dense_0"]["kernel"])


def test_leading_axes_are_free():
    model = ActorCritic(encoder=(8,), decoder=(5,), aggregator=AGGREGATORS["mean"]())
    obs = rendezvous_like(num_rows=6)
    tree = model.init(jax.random.key(0), obs)
    policy, value = model.apply(tree, obs)
    reshaped = jax.tree.map(lambda x: x.reshape(2, 3, *x.shape[1:]), obs)
    other_policy, other_value = model.apply(tree, reshaped)
    np.testing.assert_allclose(other_policy.mean().reshape(6, 2), policy.mean(), atol=1e-6)
    np.testing.assert_allclose(other_value.reshape(6), value, atol=1e-6)


def test_equal_networks_are_equal_as_compilation_keys():
    one, two = (ActorCritic(aggregator=AGGREGATORS["bayesian"](output_variance=True)) for _ in range(2))
    assert one == two
    assert hash(one) == hash(two)
    assert one != ActorCritic(aggregator=AGGREGATORS["bayesian"]())


def test_a_standard_deviation_of_the_state_starts_near_1_and_differs_between_states():
    model = ActorCritic(encoder=(8,), decoder=(5,), aggregator=AGGREGATORS["mean"](), std="state")
    obs = rendezvous_like(num_rows=6)
    tree = model.init(jax.random.key(0), obs)
    assert "log_std" not in tree["params"]
    std = np.asarray(model.apply(tree, obs, method="policy").stddev())
    assert std.shape == (6, 2)
    assert 0 < np.abs(std - 1).max() < 0.1
    assert (std.std(0) > 0).all()
    shared = ActorCritic(encoder=(8,), decoder=(5,), aggregator=AGGREGATORS["mean"]())
    assert (np.asarray(shared.apply(shared.init(jax.random.key(0), obs), obs, method="policy").stddev()) == 1).all()
