"""Aggregators return the same vectors in every layout and in any number of pieces; mismatched shapes are errors."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxswarm import AGGREGATORS
from jaxswarm.aggregators import sets
from jaxswarm.networks import Encoder, ParallelEncoders
from jaxswarm.types import Entities

WIDTH, DIM, SLOTS, RECEIVERS = 4, 3, (4, 2), 5
AGGREGATOR = {name: aggregator() for name, aggregator in AGGREGATORS.items()} | {
    "attentive, query": AGGREGATORS["attentive"](pooling="query")
}
MONOIDS = [name for name, aggregator in AGGREGATOR.items() if isinstance(aggregator, sets.Monoid)]
EACH_REDUCTION = {AGGREGATOR[name].reduction: name for name in MONOIDS[::-1]}.values()


class Groups(nn.Module):
    """Network that encodes two groups of entities and aggregates them together."""

    aggregator: nn.Module
    layout: str | None = None

    @nn.compact
    def __call__(self, groups, own):
        has_encoder = self.aggregator.num_encoders > 0
        encoders = [Encoder((WIDTH,), "tanh", self.aggregator.num_parts, name=name) for name in ("one", "two")]
        encoders = encoders if has_encoder else [ParallelEncoders(())] * 2
        aggregator = self.aggregator.copy(name="pooling")
        return sets.Pool(aggregator, tuple(encoders), WIDTH if has_encoder else DIM, self.layout)(groups, own)


def groups(seed, slots=SLOTS):
    rng = np.random.default_rng(seed)
    mask = rng.random((RECEIVERS, sum(slots))) < rng.choice([0.0, 0.5, 1.0], (RECEIVERS, 1))
    features = rng.normal(size=(*mask.shape, DIM)).astype(np.float32)
    parts = zip(np.split(features, slots[:1], 1), np.split(mask, slots[:1], 1), strict=True)
    pair = tuple(Entities(jnp.asarray(x), jnp.asarray(m)) for x, m in parts)
    return pair, jnp.asarray(rng.normal(size=(RECEIVERS, 2)), jnp.float32)


def output_and_gradient(name, layout=None):
    model = Groups(AGGREGATOR[name], layout)

    def loss(params, groups, own):
        out = model.apply(params, groups, own)
        return jnp.square(out).sum(), out

    return jax.jit(jax.value_and_grad(loss, has_aux=True))


@functools.cache
def params_of(name):
    return jax.jit(Groups(AGGREGATOR[name]).init)(jax.random.key(1), *groups(0))


FASTEST = {name: output_and_gradient(name) for name in AGGREGATOR}


def assert_close(one, two):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=2e-5, rtol=1e-4), one, two)


@pytest.mark.parametrize("layout", ["streaming", "dense", "segments"])
@pytest.mark.parametrize("name", MONOIDS)
def test_layouts_agree(name, layout):
    other = jax.jit(Groups(AGGREGATOR[name], layout).apply)
    for seed in range(10):
        assert_close(other(params_of(name), *groups(seed)), FASTEST[name](params_of(name), *groups(seed))[0][1])


@pytest.mark.parametrize("layout", ["streaming", "dense", "segments"])
@pytest.mark.parametrize("name", EACH_REDUCTION)
def test_layouts_agree_in_their_gradients(name, layout):
    other = output_and_gradient(name, layout)
    for seed in range(10):
        assert_close(other(params_of(name), *groups(seed)), FASTEST[name](params_of(name), *groups(seed)))


@pytest.mark.parametrize("name", ["bayesian", pytest.param("attentive, query", marks=pytest.mark.slow)])
def test_pieces_agree_with_the_whole(name, monkeypatch):
    monkeypatch.setattr(
        sets,
        "_PIECE_ELEMENTS",
        {"streaming": 2 * 2 * WIDTH, "dense": 2 * sum(SLOTS) * WIDTH, "segments": 2 * sum(SLOTS) * WIDTH},
    )
    pieces = output_and_gradient(name)
    for seed in range(5):
        assert_close(pieces(params_of(name), *groups(seed)), FASTEST[name](params_of(name), *groups(seed)))


@pytest.mark.parametrize("name", AGGREGATOR)
@pytest.mark.parametrize("scale", [1.0, 1e38])
def test_features_of_absent_entities_have_no_influence(name, scale):
    pair, own = groups(3)
    noise = np.random.default_rng(0).uniform(-3, 3, (RECEIVERS, max(SLOTS), DIM)).astype(np.float32) * scale
    noise = jnp.asarray(noise, jnp.float32)
    other = tuple(
        x.replace(features=jnp.where(x.mask[..., None], x.features, noise[:, : x.mask.shape[1]])) for x in pair
    )
    one, two = (FASTEST[name](params_of(name), x, own) for x in (pair, other))
    jax.tree.map(np.testing.assert_array_equal, one, two)


@pytest.mark.parametrize("name", [*EACH_REDUCTION, "attentive, query", "concat"])
def test_groups_without_slots_are_empty_groups(name):
    pair, own = groups(3)
    empty = tuple(x.replace(mask=jnp.zeros_like(x.mask)) for x in pair)
    (_, one), gradient = FASTEST[name](params_of(name), empty, own)
    (_, two), no_slots_gradient = FASTEST[name](params_of(name), groups(3, (0, 0))[0], own)
    np.testing.assert_array_equal(one, two)
    for leaf in jax.tree.leaves((one, gradient, no_slots_gradient)):
        assert np.isfinite(leaf).all()


dense_view = jax.jit(sets.dense_view)


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**31 - 1), bound=st.sampled_from([None, 1, 3]))
def test_a_dense_view_has_the_messages_of_each_receiver_in_order(seed, bound):
    rng = np.random.default_rng(seed)
    receiver = rng.choice([-(2**31), -1, 0, 1, 1, 3, 4, 7, 2**31 - 1], 8)
    is_present = rng.random(8) < 0.8
    segments = sets.Segments(jnp.asarray(receiver, jnp.int32), jnp.asarray(is_present), 5, bound)
    messages = 1.0 + jnp.arange(16.0).reshape(8, 2)
    lists = [[i for i in range(8) if receiver[i] == r and is_present[i]][:bound] for r in range(5)]

    view = sets.dense_view(messages, segments.replace(is_present=sets.is_received(segments)))
    np.testing.assert_array_equal(view.mask.sum(1), [len(x) for x in lists])
    for r, entries in enumerate(lists):
        np.testing.assert_array_equal(view.messages[r, : len(entries)], messages[np.array(entries, int)])
    np.testing.assert_array_equal(view.messages[~view.mask], 0.0)


MESSAGES = jnp.zeros((6, WIDTH))
SEGMENTS = sets.segments_of(jnp.ones((3, 2), bool))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("receiver", jnp.zeros(5, jnp.int32)),
        ("is_present", jnp.ones((3, 2), bool)),
        ("own", jnp.zeros((2, 1))),
    ],
)
def test_segments_that_do_not_fit_the_messages_are_named(field, value):
    with pytest.raises(ValueError, match=rf"segments\.{field}: must have the shape .*, got \({value.shape[0]},"):
        AGGREGATORS["mean"]().apply({}, MESSAGES, SEGMENTS.replace(**{field: value}))


def test_groups_of_other_receivers_are_named():
    pair, own = groups(0)
    short = jax.tree.map(lambda x: x[1:], pair[1])
    for wrong, name in (
        ((pair[0], short), "features"),
        ((pair[0], dataclasses.replace(pair[1], mask=short.mask)), "mask"),
    ):
        with pytest.raises(ValueError, match=rf"groups\[1\]\.{name}: must have the shape \(5, .*, got \(4, "):
            Groups(AGGREGATOR["mean"]).init(jax.random.key(0), wrong, own)


class LastMessage(nn.Module):
    """Linen module without the base class: the message in the last slot, present or not."""

    num_parts = 1
    num_encoders = 1

    def __call__(self, messages, segments):
        return sets.aggregate(self, messages, segments)

    def pool(self, view):
        return view.messages[:, -1]


class Largest(nn.Module):
    """Linen module without the base class: the maximum."""

    num_parts = 1
    num_encoders = 1
    reduction = "max"
    lift = AGGREGATORS["max"].lift
    lower = AGGREGATORS["max"].lower

    __call__ = sets.aggregate


def test_any_linen_module_with_the_methods_is_an_aggregator():
    messages = jnp.arange(12.0).reshape(6, 2)
    np.testing.assert_array_equal(LastMessage().apply({}, messages, SEGMENTS), messages[1::2])
    np.testing.assert_array_equal(Largest().apply({}, messages, SEGMENTS), messages[1::2])
    for model in (LastMessage(), Largest()):
        assert jax.eval_shape(lambda m=model: Groups(m).init_with_output(jax.random.key(0), *groups(0)))[0].shape == (
            5,
            4,
        )


def test_a_module_that_is_no_aggregator_is_named():
    with pytest.raises(ValueError, match=r"aggregator: must be a module with .*, got Dense"):
        sets.aggregate(nn.Dense(2), MESSAGES, SEGMENTS)
