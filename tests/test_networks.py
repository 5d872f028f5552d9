"""Networks reproduce recorded outputs and have the documented sizes and initial weights."""

import re
from functools import partial

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
    "optimized": {"encoder": (146, 120), "decoder": (19, 177, 162), "activation": "tanh"},
    "attentive": {"encoder": (72,), "decoder": (132, 200)},
    "single space": {"encoder": (120, 60), "decoder": (160,), "latent_space": "shared"},
}


def random_observation(num_rows=1, own=3, **groups):
    """Return an observation with groups of 3 entities; `groups` are their numbers of features."""

    def entities(i, dim):
        return Entities(jax.random.normal(jax.random.key(i), (num_rows, 3, dim)), jnp.ones((num_rows, 3), bool))

    own = jax.random.normal(jax.random.key(99), (num_rows, own))
    return Observation(own, {name: entities(i, dim) for i, (name, dim) in enumerate(groups.items())})


def rendezvous_like(num_rows=1):
    return random_observation(num_rows, neighbors=8)


def pursuit_like(num_rows=1):
    return random_observation(num_rows, own=1, neighbors=5, evaders=3)


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
    ("architecture", "observation", "aggregator", "options", "count"),
    [
        ("simple", rendezvous_like, "mean", {}, 10_053),
        ("simple", rendezvous_like, "bayesian", {}, 11_461),
        ("medium", rendezvous_like, "mean", {}, 37_645),
        ("medium", rendezvous_like, "bayesian", {}, 52_405),
        ("optimized", rendezvous_like, "mean", {}, 107_863),
        ("optimized", rendezvous_like, "bayesian", {}, 143_623),
        ("medium", pursuit_like, "max", {}, 70_965),
        ("medium", pursuit_like, "bayesian", {"output_variance": True}, 138_885),
        ("single space", pursuit_like, "bayesian", {}, 81_045),
        ("attentive", pursuit_like, "attentive", {}, 177_885),
    ],
)
def test_parameter_counts_of_the_thesis(architecture, observation, aggregator, options, count):
    model = ActorCritic(**ARCHITECTURES[architecture], aggregator=AGGREGATORS[aggregator](**options))
    tree = jax.eval_shape(model.init, jax.random.key(0), observation())
    assert sum(x.size for x in jax.tree.leaves(tree)) == count


def test_initial_weights_are_orthogonal_with_the_documented_gains():
    model = ActorCritic(encoder=(8, 6), decoder=(5,), aggregator=AGGREGATORS["bayesian"]())
    tree = jax.jit(model.init)(jax.random.key(0), rendezvous_like())["params"]

    def gain(kernel):
        singular_values = np.linalg.svd(kernel, compute_uv=False)
        np.testing.assert_allclose(singular_values, singular_values[0], rtol=1e-4)
        return singular_values[0]

    for tower in (tree["actor"], tree["critic"]):
        encoder = tower["neighbors_encoder"]
        assert encoder["kernel"].shape == (8, 12)  # both parts of a message, initialized as one matrix
        for kernel in (encoder["Dense_0"]["kernel"], encoder["kernel"], tower["Dense_0"]["kernel"]):
            assert gain(kernel) == pytest.approx(np.sqrt(2), rel=1e-4)
        np.testing.assert_array_equal(tower["neighbors_aggregator"]["prior_variance"], 1.0)
        np.testing.assert_array_equal(tower["neighbors_aggregator"]["prior_mean"], 1.0)
    assert gain(tree["action_mean"]["kernel"]) == pytest.approx(0.01, rel=1e-4)
    assert gain(tree["value_head"]["kernel"]) == pytest.approx(1.0, rel=1e-4)
    np.testing.assert_array_equal(tree["log_std"], 0.0)
    assert not np.allclose(tree["actor"]["Dense_0"]["kernel"], tree["critic"]["Dense_0"]["kernel"])


def test_initial_weights_of_attention_are_those_of_the_thesis():
    model = ActorCritic(encoder=(72,), decoder=(5,), aggregator=AGGREGATORS["attentive"]())
    tree = jax.jit(model.init)(jax.random.key(0), rendezvous_like())["params"]
    for tower in ("actor", "critic"):
        weights = tree[tower]["neighbors_aggregator"]
        bound = np.sqrt(6 / (4 * 72))  # of the Xavier initialization, for a matrix from 72 to 3 * 72
        assert 0.99 * bound < np.abs(weights["in_kernel"]).max() <= bound
        assert np.std(weights["in_kernel"]) == pytest.approx(bound / np.sqrt(3), rel=0.02)
        np.testing.assert_allclose(np.linalg.svd(weights["out_kernel"], compute_uv=False), np.sqrt(2), rtol=1e-4)
        for bias in ("in_bias", "out_bias"):
            np.testing.assert_array_equal(weights[bias], 0.0)


def assert_same_values(one, one_tree, two, two_tree, obs):
    values = (
        jax.jit(partial(model.apply, method="value"))({"params": x}, obs)
        for model, x in ((one, one_tree), (two, two_tree))
    )
    np.testing.assert_allclose(*values, atol=1e-6)


@pytest.mark.slow
def test_separate_encoders_of_the_same_weights_are_a_shared_one():
    obs = pursuit_like(num_rows=4)
    shared, separate = (
        ActorCritic((4,), decoder=(5,), aggregator=AGGREGATORS["bayesian"](variance_encoder=kind))
        for kind in ("shared", "separate")
    )
    tree = jax.jit(shared.init)(jax.random.key(0), obs)["params"]

    def split(tower):
        halves = {}
        for name in obs.groups:
            for suffix, part in (("", slice(4)), ("_1", slice(4, 8))):
                halves[f"{name}_encoder{suffix}"] = {k: x[..., part] for k, x in tower[f"{name}_encoder"].items()}
        return tower | halves

    split_tree = tree | {name: split(tree[name]) for name in ("actor", "critic")}
    expected = jax.eval_shape(separate.init, jax.random.key(0), obs)["params"]
    assert jax.tree.map(jnp.shape, split_tree) == jax.tree.map(jnp.shape, expected)
    assert_same_values(shared, tree, separate, split_tree, obs)


@pytest.mark.slow
@pytest.mark.parametrize("variance_encoder", ["shared", "separate"])
def test_a_second_stage_is_further_layers_that_all_groups_share(variance_encoder):
    options = {"decoder": (5,), "aggregator": AGGREGATORS["bayesian"](variance_encoder=variance_encoder)}
    one_stage, two_stages = ActorCritic((6, 4), **options), ActorCritic((6,), shared_encoder=(4,), **options)
    obs = pursuit_like(num_rows=4)
    tree = jax.jit(two_stages.init)(jax.random.key(0), obs)["params"]

    def merge(tower):
        tower, numbers = dict(tower), ["", "_1"][: options["aggregator"].num_encoders]
        last = {number: tower.pop(f"second_stage{number}") for number in numbers}
        first = {f"{name}_encoder{number}": number for name in obs.groups for number in numbers}
        return tower | {name: {"Dense_0": tower[name]} | last[number] for name, number in first.items()}

    merged = tree | {name: merge(tree[name]) for name in ("actor", "critic")}
    expected = jax.eval_shape(one_stage.init, jax.random.key(0), obs)["params"]
    assert jax.tree.map(jnp.shape, merged) == jax.tree.map(jnp.shape, expected)
    assert_same_values(two_stages, tree, one_stage, merged, obs)


@pytest.mark.parametrize("name", AGGREGATORS)
def test_every_aggregator_makes_a_network(name):
    model = ActorCritic((4,), decoder=(5,), aggregator=AGGREGATORS[name]())
    obs = pursuit_like(num_rows=2)
    tree = jax.eval_shape(model.init, jax.random.key(0), obs)
    assert jax.eval_shape(model.apply, tree, obs)[1].shape == (2,)
    is_encoded = any("encoder" in key for key in tree["params"]["actor"])
    assert is_encoded == (AGGREGATORS[name]().num_encoders > 0)


@pytest.mark.parametrize("name", AGGREGATORS)
def test_a_group_may_have_no_slots(name):
    model = ActorCritic((4,), decoder=(5,), aggregator=AGGREGATORS[name]())
    obs = pursuit_like(num_rows=2)
    alone = obs.replace(groups=obs.groups | {"neighbors": jax.tree.map(lambda x: x[:, :0], obs.groups["neighbors"])})
    tree = jax.eval_shape(model.init, jax.random.key(0), alone)
    assert jax.eval_shape(model.apply, tree, alone)[1].shape == (2,)
    weights = jax.eval_shape(partial(model.apply, method="weights"), tree, alone)
    assert weights["neighbors"].shape == (2, 0)


def test_pooling_by_a_query_gets_what_agents_know_of_themselves():
    model = ActorCritic((4,), decoder=(5,), aggregator=AGGREGATORS["attentive"](pooling="query"))
    tree = jax.eval_shape(model.init, jax.random.key(0), rendezvous_like())["params"]["actor"]
    assert tree["neighbors_aggregator"]["query"]["kernel"].shape == (3, 4)


@pytest.mark.parametrize("name", [name for name, x in AGGREGATORS.items() if x().num_encoders == 0])
def test_features_of_several_groups_cannot_be_aggregated_together(name):
    model = ActorCritic(aggregator=AGGREGATORS[name](), latent_space="shared")
    with pytest.raises(
        ValueError, match="latent_space: must be separate for the groups evaders, neighbors, got 'shared'"
    ):
        jax.eval_shape(model.init, jax.random.key(0), pursuit_like())
    jax.eval_shape(model.init, jax.random.key(0), rendezvous_like())


def test_leading_axes_are_free():
    model = ActorCritic(encoder=(8,), decoder=(5,), aggregator=AGGREGATORS["mean"]())
    obs = rendezvous_like(num_rows=6)
    tree = jax.jit(model.init)(jax.random.key(0), obs)
    policy, value = model.apply(tree, obs)
    reshaped = jax.tree.map(lambda x: x.reshape(2, 3, *x.shape[1:]), obs)
    other_policy, other_value = model.apply(tree, reshaped)
    np.testing.assert_allclose(other_policy.mean().reshape(6, 2), policy.mean(), atol=1e-6)
    np.testing.assert_allclose(other_value.reshape(6), value, atol=1e-6)


@pytest.mark.parametrize("widths", [{}, {"encoder": (6, 4)}, {"decoder": (6, 5)}, {"shared_encoder": (6,)}])
def test_with_linear_output_layers_only_hidden_layers_bend(widths):
    model = ActorCritic(**{"encoder": (4,), "decoder": (5,)} | widths, linear_output_layers=True)
    one, two = rendezvous_like(num_rows=3), jax.tree.map(lambda x: x[::-1], rendezvous_like(num_rows=3))
    between = jax.tree.map(lambda x, y: x if x.dtype == bool else 0.3 * x + 0.7 * y, one, two)
    tree = jax.jit(model.init)(jax.random.key(0), one)
    straight = 0.3 * model.apply(tree, one)[1] + 0.7 * model.apply(tree, two)[1]
    off = np.abs(model.apply(tree, between)[1] - straight)[[0, 2]]  # reversing does not move the middle row
    assert (off < 1e-5).all() if not widths else (off > 1e-4).all()


@pytest.mark.parametrize(
    ("field", "value", "accepted"),
    [
        ("encoder", (), "a list of at least one layer, like [64]"),
        ("encoder", (8, 0), "a tuple of integers from 1 to 65536"),
        ("aggregator", "mean", "an aggregator, like Mean()"),
        ("aggregator", AGGREGATORS["mean"], "an aggregator, like Mean()"),
        ("linear_output_layers", "no", "true or false"),
        ("action_dim", 0, "an integer >= 1"),
    ],
)
def test_impossible_options_are_named(field, value, accepted):
    with pytest.raises(ValueError, match=re.escape(f"{field}: must be {accepted}, got {value!r}")):
        ActorCritic(**{field: value})


def test_equal_networks_are_equal_as_compilation_keys():
    one, two = (ActorCritic(aggregator=AGGREGATORS["bayesian"](output_variance=True)) for _ in range(2))
    assert one == two
    assert hash(one) == hash(two)
    assert one != ActorCritic(aggregator=AGGREGATORS["bayesian"]())


def test_a_standard_deviation_of_the_state_starts_near_1_and_differs_between_states():
    model = ActorCritic(encoder=(8,), decoder=(5,), aggregator=AGGREGATORS["mean"](), std="state")
    obs = rendezvous_like(num_rows=6)
    tree = jax.jit(model.init)(jax.random.key(0), obs)
    assert "log_std" not in tree["params"]
    std = np.asarray(model.apply(tree, obs, method="policy").stddev())
    assert std.shape == (6, 2)
    assert 0 < np.abs(std - 1).max() < 0.1
    assert (std.std(0) > 0).all()
    shared = ActorCritic(encoder=(8,), decoder=(5,), aggregator=AGGREGATORS["mean"]())
    assert (
        np.asarray(shared.apply(jax.jit(shared.init)(jax.random.key(0), obs), obs, method="policy").stddev()) == 1
    ).all()


@pytest.mark.parametrize("latent_space", ["separate", "shared"])
def test_shares_of_entities_by_group(latent_space):
    """The shares of one aggregate sum to 1; with a mean, all present entities have equal shares."""
    obs = pursuit_like(2)
    neighbors, evaders = obs.groups["neighbors"], obs.groups["evaders"]
    obs = obs.replace(
        groups={"neighbors": neighbors, "evaders": evaders.replace(mask=evaders.mask.at[1, 0].set(False))}
    )
    model = ActorCritic((4,), (4,), latent_space=latent_space)
    tree = jax.jit(model.init)(jax.random.key(0), obs)
    shares = jax.jit(partial(model.apply, method="weights"))(tree, jax.tree.map(lambda x: x[:, None], obs))
    near, far = ([1 / 3] * 3, [0, 0.5, 0.5]) if latent_space == "separate" else ([0.2] * 3, [0, 0.2, 0.2])
    np.testing.assert_allclose(shares["neighbors"][1, 0], near, rtol=1e-6)
    np.testing.assert_allclose(shares["evaders"][1, 0], far, rtol=1e-6)


def test_shares_are_those_of_the_actor():
    obs = pursuit_like(2)
    model = ActorCritic((4,), (4,), aggregator=AGGREGATORS["softmax"]())
    tree = jax.jit(model.init)(jax.random.key(0), obs)
    layer = tree["params"]["actor"]["evaders_encoder"]
    x = np.asarray(obs.groups["evaders"].features) @ np.asarray(layer["kernel"]) + np.asarray(layer["bias"])
    e = np.exp(np.where(x > 0, x, 0.01 * x))
    expected = (e / e.sum(1, keepdims=True)).mean(-1)
    shares = jax.jit(partial(model.apply, method="weights"))(tree, obs)
    np.testing.assert_allclose(shares["evaders"], expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("features", lambda x: x[:1]),
        ("features", lambda x: x[0]),
        ("mask", lambda x: x[:, 1:]),
    ],
)
def test_groups_that_do_not_fit_the_receivers_are_named(field, change):
    obs = pursuit_like(2)
    group = obs.groups["evaders"]
    wrong = obs.replace(groups=obs.groups | {"evaders": group.replace(**{field: change(getattr(group, field))})})
    with pytest.raises(ValueError, match=rf"obs\.groups\['evaders'\]\.{field}: must have the shape \(2, .*, got"):
        jax.eval_shape(ActorCritic().init, jax.random.key(0), wrong)


def test_a_mask_of_other_receivers_is_named():
    obs = pursuit_like(2)
    with pytest.raises(ValueError, match=r"obs\.mask: must have the shape \(2,\), got \(3,\)"):
        jax.eval_shape(ActorCritic().init, jax.random.key(0), obs.replace(mask=jnp.ones(3, bool)))


def test_the_observation_of_a_single_agent_has_no_leading_axes():
    obs = jax.tree.map(lambda x: x[0], pursuit_like(2))

    def outputs():
        (policy, value), _ = ActorCritic().init_with_output(jax.random.key(0), obs)
        return policy.mean(), value

    mean, value = jax.eval_shape(outputs)
    assert (mean.shape, value.shape) == ((2,), ())
