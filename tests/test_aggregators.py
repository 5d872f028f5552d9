"""Contracts of all aggregators for groups of any size, and the vector of each aggregator against a NumPy formula."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxswarm import AGGREGATORS
from jaxswarm.aggregators.monoids import softplus_precision
from jaxswarm.aggregators.sets import DenseView, Segments, segments_of

WIDTH, SLOTS, RECEIVERS, OWN = 4, 5, 3, 2
SMALL = {
    "concat": {"max_entities": 4},
    "histogram": {"num_distances": 2, "num_bearings": 5, "max_distance": 2.0},
    "rbf": {"num_distances": 2, "num_bearings": 3, "bearing_width": 0.5},
}
MODELS = {name: aggregator(**SMALL.get(name, {})) for name, aggregator in AGGREGATORS.items()} | {
    "bayesian, exp, no prior": AGGREGATORS["bayesian"](rectifier="exp", prior_variance=None, output_variance=True),
    "bayesian, scalar prior": AGGREGATORS["bayesian"](prior_mean="scalar", prior_variance="scalar"),
    "bayesian, fixed prior": AGGREGATORS["bayesian"](prior_mean="fixed", prior_variance="fixed"),
    "attentive, query": AGGREGATORS["attentive"](pooling="query"),
    "attentive, query, no residual": AGGREGATORS["attentive"](pooling="query", residual=False, num_heads=4),
}
MESSAGE_LENGTH = {name: model.num_parts * WIDTH for name, model in MODELS.items()}
OWN_FEATURES = np.random.default_rng(5).normal(size=(RECEIVERS, OWN)).astype(np.float32)


def segments(mask):
    return segments_of(jnp.asarray(mask)).replace(own=jnp.asarray(OWN_FEATURES))


@functools.cache
def params_of(name):
    """Return random parameters, as after some training."""
    rng = np.random.default_rng(3)
    messages, full = jnp.zeros((RECEIVERS * SLOTS, MESSAGE_LENGTH[name])), segments(np.ones((RECEIVERS, SLOTS), bool))
    params = jax.jit(MODELS[name].init)(jax.random.key(0), messages, full)
    return jax.tree.map(lambda x: x + jnp.asarray(0.5 * rng.normal(size=x.shape), jnp.float32), params)


def gradients_and_output(model):
    """Return the gradients of the sum of squares with respect to parameters and messages, and the output."""

    def loss(params, messages, segments):
        output = model.apply(params, messages, segments)
        return jnp.square(output).sum(), output

    return jax.jit(jax.grad(loss, (0, 1), has_aux=True))


GRADIENTS_AND_OUTPUT = {name: gradients_and_output(model) for name, model in MODELS.items()}
seeds = st.integers(0, 2**31 - 1)
every_aggregator = pytest.mark.parametrize("name", MODELS)


def random_messages(name, seed):
    """Return messages of groups of 0 to all slots; some messages occur several times."""
    rng = np.random.default_rng(seed)
    messages = rng.normal(size=(RECEIVERS, SLOTS, MESSAGE_LENGTH[name]))
    messages = messages[:, rng.integers(0, rng.integers(1, SLOTS + 1), SLOTS)]
    mask = rng.random((RECEIVERS, SLOTS)) < rng.choice([0.0, 0.3, 0.7, 1.0], (RECEIVERS, 1))
    return messages.astype(np.float32), mask, rng


def flat(messages):
    return jnp.asarray(messages.reshape(-1, messages.shape[-1]), jnp.float32)


# ---- Formulas from messages [entities, length] to a vector.


def softmax(x, axis=-1):
    e = np.exp(x - x.max(axis, keepdims=True))
    return e / e.sum(axis, keepdims=True)


def softplus(x):
    return np.logaddexp(0, x)


def conditioned_one_by_one(x, model, params):
    """Return the posterior of a Gaussian prior after one observation at a time."""
    rectify = softplus if model.rectifier == "softplus" else np.exp
    raw = params.get("prior_variance", np.ones(1))
    variance = np.full(WIDTH, np.inf) if model.prior_variance is None else np.broadcast_to(rectify(raw), WIDTH)
    mean = np.broadcast_to(params.get("prior_mean", np.ones(1)) if model.prior_variance else 0.0, WIDTH)
    for observation, noise in zip(x[:, :WIDTH], rectify(x[:, WIDTH:]), strict=True):
        mean = mean + (observation - mean) / (1 + noise / variance)
        variance = 1 / (1 / variance + 1 / noise)
    variance = np.where(np.isinf(variance), 0.0, variance)
    return np.concatenate([mean, variance]) if model.output_variance else mean


def attended(x, model, params, own):
    if not len(x):
        return np.zeros(WIDTH)
    q, k, v = np.split(x @ params["in_kernel"] + params["in_bias"], 3, -1)
    size = WIDTH // model.num_heads
    heads = [slice(i * size, (i + 1) * size) for i in range(model.num_heads)]
    context = [softmax(q[:, h] @ k[:, h].T / np.sqrt(size)) @ v[:, h] for h in heads]
    y = np.concatenate(context, -1) @ params["out_kernel"] + params["out_bias"] + model.residual * x
    if model.pooling == "mean":
        return y.mean(0)
    query = own @ params["query"]["kernel"] + params["query"]["bias"]
    return softmax(y @ query / np.sqrt(WIDTH)) @ y


def nearest(x, model):
    """Return the nearest rows; Python compares tuples by their first entries, then by the next."""
    rows = sorted(tuple(row) for row in x)[: model.max_entities]
    return np.array(rows + [(0.0,) * WIDTH] * (model.max_entities - len(rows))).reshape(-1)


def histogram(x, model):
    distance = np.clip(x[:, 0], 0, model.max_distance)
    angle = np.arctan2(x[:, 2], x[:, 1]) % (2 * np.pi)
    bins = (model.num_distances, model.num_bearings)
    counts, _, _ = np.histogram2d(distance, angle, bins, [[0, model.max_distance], [0, 2 * np.pi]])
    return counts.reshape(-1) / max(len(x), 1)


def radial_basis(x, model):
    distances = np.linspace(0, model.max_distance, model.num_distances)
    bearings = 2 * np.pi / model.num_bearings * np.arange(model.num_bearings)
    width = model.distance_width * distances[1], model.bearing_width * bearings[1]
    radius, angle = np.hypot(x[:, 1], x[:, 2]), np.arctan2(x[:, 2], x[:, 1])
    values = [
        np.exp(-((x[:, 0] - d) ** 2) / (2 * width[0] ** 2)) * np.exp((radius * np.cos(angle - b) - 1) / width[1] ** 2)
        for d, b in itertools.product(distances, bearings)
    ]
    return np.array(values).sum(-1) / max(len(x), 1)


FORMULAS = {
    "mean": lambda x, *_: x.mean(0) if len(x) else np.zeros(WIDTH),
    "max": lambda x, *_: x.max(0) if len(x) else np.zeros(WIDTH),
    "softmax": lambda x, *_: (softmax(x, 0) * x).sum(0) if len(x) else np.zeros(WIDTH),
    "bayesian": lambda x, model, params, own: conditioned_one_by_one(x, model, params),
    "attentive": attended,
    "concat": lambda x, model, *_: nearest(x, model),
    "histogram": lambda x, model, *_: histogram(x, model),
    "rbf": lambda x, model, *_: radial_basis(x, model),
}


@every_aggregator
@settings(max_examples=25, deadline=None)
@given(seed=seeds)
def test_groups_of_any_size_give_what_the_formula_says(name, seed):
    messages, mask, _ = random_messages(name, seed)
    if name == "rbf":
        messages[..., 1:3] /= np.linalg.norm(messages[..., 1:3], axis=-1, keepdims=True)
    _, result = GRADIENTS_AND_OUTPUT[name](params_of(name), flat(messages), segments(mask))
    assert result.dtype == jnp.float32
    params = jax.tree.map(np.float64, params_of(name).get("params", {}))
    formula = FORMULAS[name.partition(",")[0]]
    for row, group, present, own in zip(result, np.float64(messages), mask, OWN_FEATURES, strict=True):
        np.testing.assert_allclose(row, formula(group[present], MODELS[name], params, own), atol=1e-5, rtol=1e-4)


@every_aggregator
@settings(max_examples=25, deadline=None)
@given(seed=seeds, scale=st.sampled_from([1.0, 1e4, 1e38]))
def test_absent_entities_have_no_influence(name, seed, scale):
    messages, mask, rng = random_messages(name, seed)
    noise = np.clip(rng.normal(size=messages.shape), -3, 3).astype(np.float32) * np.float32(scale)
    other = np.where(mask[..., None], messages, noise)
    one = GRADIENTS_AND_OUTPUT[name](params_of(name), flat(messages), segments(mask))
    two = GRADIENTS_AND_OUTPUT[name](params_of(name), flat(other), segments(mask))
    jax.tree.map(np.testing.assert_array_equal, one, two)
    (_, gradient), _ = one
    np.testing.assert_array_equal(gradient[~mask.reshape(-1)], 0.0)


@every_aggregator
@settings(max_examples=25, deadline=None)
@given(seed=seeds)
def test_order_has_no_influence(name, seed):
    _, mask, rng = random_messages(name, seed)
    messages = rng.normal(size=(RECEIVERS, SLOTS, MESSAGE_LENGTH[name]))
    order = rng.permutation(RECEIVERS * SLOTS)
    regular = segments(mask)
    shuffled = regular.replace(receiver=regular.receiver[order], is_present=regular.is_present[order])
    (_, one_gradient), one = GRADIENTS_AND_OUTPUT[name](params_of(name), flat(messages), regular)
    (_, two_gradient), two = GRADIENTS_AND_OUTPUT[name](params_of(name), flat(messages)[order], shuffled)
    np.testing.assert_allclose(two, one, atol=2e-6, rtol=1e-5)
    rounding = 4e-6 * np.abs(one_gradient).max()  # large terms of a gradient can cancel
    np.testing.assert_allclose(two_gradient, one_gradient[order], atol=2e-5 + rounding, rtol=1e-4)


@every_aggregator
@pytest.mark.parametrize("missing_receiver", [-(2**31), -1, RECEIVERS, 2**31 - 1])
def test_messages_to_receivers_that_do_not_exist_are_absent(name, missing_receiver):
    messages, mask, _ = random_messages(name, 2)
    regular = segments(mask)
    receiver = jnp.where(regular.is_present, regular.receiver, missing_receiver)
    other = regular.replace(receiver=receiver, is_present=jnp.ones_like(regular.is_present))
    one, two = (GRADIENTS_AND_OUTPUT[name](params_of(name), flat(messages), x) for x in (regular, other))
    jax.tree.map(np.testing.assert_array_equal, one, two)


@every_aggregator
def test_gradients_are_those_of_the_output(name):
    _, mask, rng = random_messages(name, 11)
    mask[0], mask[1, 0] = True, True
    messages, direction = rng.normal(size=(2, RECEIVERS * SLOTS, MESSAGE_LENGTH[name]))
    (_, gradient), _ = GRADIENTS_AND_OUTPUT[name](params_of(name), flat(messages), segments(mask))
    outputs = [
        np.float64(GRADIENTS_AND_OUTPUT[name](params_of(name), flat(messages + step * direction), segments(mask))[1])
        for step in (-1e-3, 1e-3)
    ]
    numeric = (np.square(outputs[1]).sum() - np.square(outputs[0]).sum()) / 2e-3
    assert (gradient * direction).sum() == pytest.approx(numeric, rel=5e-3, abs=2e-3)


@every_aggregator
@pytest.mark.parametrize("num_slots", [0, SLOTS])
def test_empty_groups_give_finite_output_and_gradient(name, num_slots):
    messages = jnp.ones((RECEIVERS * num_slots, MESSAGE_LENGTH[name]))
    empty = segments(np.zeros((RECEIVERS, num_slots), bool))
    for leaf in jax.tree.leaves(GRADIENTS_AND_OUTPUT[name](params_of(name), messages, empty)):
        assert np.isfinite(leaf).all()


@every_aggregator
def test_no_receivers_give_no_vectors(name):
    none = segments_of(jnp.zeros((0, SLOTS), bool)).replace(own=jnp.zeros((0, OWN)))
    assert MODELS[name].apply(params_of(name), jnp.zeros((0, MESSAGE_LENGTH[name])), none).shape[0] == 0


def test_softmax_of_large_messages_is_finite_and_exact():
    messages = jnp.array([[1e30, 300.0, -300.0], [2e30, 301.0, -301.0], [-3e38, -1e30, -1e30]])
    one = segments_of(jnp.ones((1, 3), bool))
    share = 1 / (1 + np.exp(-1.0))
    result = AGGREGATORS["softmax"]().apply({}, messages, one)
    np.testing.assert_allclose(result, [[2e30, 300 + share, -301 + share]], rtol=1e-6)


def test_query_pooling_needs_what_receivers_know():
    with pytest.raises(ValueError, match=r"own: must be .* with pooling='query', got None"):
        jax.eval_shape(
            MODELS["attentive, query"].init, jax.random.key(0), jnp.ones((2, 4)), segments_of(jnp.ones((1, 2), bool))
        )


def test_a_histogram_counts_entities_on_the_border_once():
    angle = np.linspace(-np.pi, np.pi, 81)
    features = np.stack([np.tile([0.0, 0.5, 1.0], 27), np.cos(angle), np.sin(angle)], -1)
    features = np.concatenate([features, np.zeros((3, 3))])  # at distance 0, without a bearing
    model = AGGREGATORS["histogram"](num_distances=4, num_bearings=8)
    result = model.apply({}, jnp.asarray(features, jnp.float32), Segments(jnp.arange(84), jnp.ones(84, bool), 84))
    np.testing.assert_array_equal(result.sum(-1), 1.0)
    np.testing.assert_array_equal(result[-1].reshape(4, 8)[0, 0], 1.0)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("bayesian", {"rectifier": "relu"}, r"rectifier: must be .*softplus, exp.*, got 'relu'"),
        (
            "bayesian",
            {"prior_mean": "vector"},
            r"prior_mean: must be .*one of feature, scalar, fixed, null.*, got 'vector'",
        ),
        ("bayesian", {"variance_encoder": True}, r"variance_encoder: must be .*shared, separate.*, got True"),
        ("bayesian", {"output_variance": "no"}, r"output_variance: must be .*true or false.*, got 'no'"),
        ("attentive", {"residual": 1}, r"residual: must be .*true or false.*, got 1"),
        ("attentive", {"num_heads": 0}, r"num_heads: must be .*an integer >= 1.*, got 0"),
        ("attentive", {"pooling": "max"}, r"pooling: must be .*mean, query.*, got 'max'"),
        ("concat", {"max_entities": -1}, r"max_entities: must be .*an integer >= 1.*, got -1"),
        ("histogram", {"num_bearings": 2}, r"num_bearings: must be .*an integer >= 3.*, got 2"),
        ("histogram", {"max_distance": 0.0}, r"max_distance: must be .*a positive number.*, got 0.0"),
        ("rbf", {"num_distances": 1}, r"num_distances: must be .*an integer >= 2.*, got 1"),
        ("rbf", {"bearing_width": -1.0}, r"bearing_width: must be .*a positive number.*, got -1.0"),
    ],
)
def test_impossible_options_are_named(name, options, message):
    with pytest.raises(ValueError, match=message):
        AGGREGATORS[name](**options)


def test_heads_divide_the_features():
    with pytest.raises(ValueError, match=r"num_heads: must divide the message width 4, got 3"):
        AGGREGATORS["attentive"](num_heads=3).init(jax.random.key(0), jnp.ones((6, 4)), segments(np.ones((3, 2), bool)))


def test_raw_features_have_a_distance_and_a_bearing():
    with pytest.raises(ValueError, match=r"features: must start with .*, got 2 features"):
        AGGREGATORS["histogram"]().apply({}, jnp.ones((2, 2)), segments_of(jnp.ones((1, 2), bool)))


def test_precision_of_softplus_and_its_gradient_over_the_whole_range():
    x = jnp.concatenate([jnp.linspace(-60, 100, 401), jnp.array([0.0])])
    variance = np.logaddexp(0, np.float64(x))
    np.testing.assert_allclose(softplus_precision(x), 1 / variance, rtol=1e-5)
    gradient = jax.vmap(jax.grad(softplus_precision))(x)
    np.testing.assert_allclose(gradient, -1 / (1 + np.exp(-np.float64(x))) / variance**2, rtol=1e-5, atol=1e-37)


@pytest.mark.parametrize("rectifier", ["softplus", "exp"])
@pytest.mark.parametrize("raw", [-1e30, -89.0, 1e30])
def test_no_variance_is_too_extreme(rectifier, raw):
    model = AGGREGATORS["bayesian"](rectifier=rectifier)
    segments = segments_of(jnp.ones((1, 3), bool))
    messages = jnp.array([[1.0, raw], [2.0, raw], [4.0, raw]])
    params = model.init(jax.random.key(0), messages, segments)
    output, gradient = jax.value_and_grad(lambda x: model.apply(params, x, segments).sum())(messages)
    assert np.isfinite(output)
    assert np.isfinite(gradient).all()
    assert raw > 0 or output == pytest.approx(7 / 3, rel=1e-5)


MASK = np.array([[True, False, True, True, False], [False] * SLOTS, [False, False, False, True, False]])


def weights_and_messages(name):
    """Return the weights of a model for random messages with positive distances, and these messages."""
    messages = np.random.default_rng(8).normal(size=(RECEIVERS, SLOTS, MESSAGE_LENGTH[name])).astype(np.float32)
    messages[..., 0] = np.abs(messages[..., 0])
    view = DenseView(jnp.asarray(messages), jnp.asarray(MASK), jnp.asarray(OWN_FEATURES))
    weights = jax.jit(lambda params, view: MODELS[name].apply(params, view, method="weights"))(params_of(name), view)
    return np.asarray(weights), messages


@every_aggregator
def test_shares_sum_to_one_over_present_entities(name):
    weights, _ = weights_and_messages(name)
    assert (weights[~MASK] == 0).all()
    assert (weights >= 0).all()
    np.testing.assert_allclose(weights.sum(1), [1, 0, 1], rtol=1e-5)


def _softmax(x):
    return np.exp(x) / np.exp(x).sum(0)


def _attention(x, name="attentive"):
    """Return the attention, mean over heads and queries; the kernel concatenates queries, keys and values."""
    kernel, bias = (np.asarray(params_of(name)["params"][part]) for part in ("in_kernel", "in_bias"))
    q, k, _ = (part.reshape(len(x), 2, -1) for part in np.split(x @ kernel + bias, 3, -1))
    score = np.einsum("ihd,jhd->jhi", q, k) / np.sqrt(q.shape[-1])
    return _softmax(score).mean((1, 2))


SHARES = {
    "mean": lambda x: np.full(len(x), 1 / len(x)),
    "max": lambda x: (x == x.max(0)).mean(1),
    "softmax": lambda x: _softmax(x).mean(1),
    "bayesian": lambda x: (1 / np.log1p(np.exp(x[:, 4:])) / (1 / np.log1p(np.exp(x[:, 4:]))).sum(0)).mean(1),
    "bayesian, exp, no prior": lambda x: _softmax(-x[:, 4:]).mean(1),
    "attentive": _attention,
    "histogram": lambda x: np.full(len(x), 1 / len(x)),
    "rbf": lambda x: np.full(len(x), 1 / len(x)),
}


@pytest.mark.parametrize("name", SHARES)
def test_shares_are_those_of_the_formula(name):
    weights, messages = weights_and_messages(name)
    for receiver in (0, 2):
        present = MASK[receiver]
        np.testing.assert_allclose(weights[receiver, present], SHARES[name](messages[receiver, present]), rtol=1e-4)


def test_entities_that_concat_has_no_room_for_have_no_share():
    weights, messages = weights_and_messages("concat")
    np.testing.assert_allclose(weights[0, MASK[0]], 1 / 3, rtol=1e-6)
    view = DenseView(jnp.asarray(messages), jnp.asarray(MASK))
    (nearest,) = np.flatnonzero(AGGREGATORS["concat"](max_entities=1).weights(view)[0])
    assert nearest == np.where(MASK[0], messages[0, :, 0], np.inf).argmin()


def test_entities_that_are_equal_share_a_maximum():
    view = DenseView(jnp.ones((1, 2, 3)), jnp.ones((1, 2), bool))
    np.testing.assert_allclose(AGGREGATORS["max"]().weights(view), [[0.5, 0.5]])
