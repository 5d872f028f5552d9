"""What every aggregator promises, over groups of any size; and what each one computes, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxswarm import AGGREGATORS, sets
from jaxswarm.aggregators import softplus_precision
from jaxswarm.networks import Encoder
from jaxswarm.types import Entities

WIDTH, DIM, SLOTS, RECEIVERS = 4, 3, 5, 3


class Dense(nn.Module):
    """An encoder and an aggregator, in the two layouts that must agree."""

    aggregator: nn.Module

    def setup(self):
        self.encoder = Encoder((6, WIDTH), "tanh", self.aggregator.num_parts)
        self.reduction = self.aggregator.copy()

    def streamed(self, group):
        return sets.encode_and_reduce(self.reduction, [self.encoder], [group], WIDTH)

    def by_segments(self, group):
        messages = jnp.concatenate(self.encoder(group.features.reshape(-1, DIM)), -1)
        return self.reduction(messages, sets.segments_of(group.mask))


MODELS = {name: Dense(aggregator()) for name, aggregator in AGGREGATORS.items()}
PARAMS = {
    name: model.init(jax.random.key(3), Entities(jnp.zeros((1, 1, DIM)), jnp.ones((1, 1), bool)), method="streamed")
    for name, model in MODELS.items()
}
STREAMED = {name: jax.jit(lambda p, g, m=model: m.apply(p, g, method="streamed")) for name, model in MODELS.items()}
LOSS = {
    name: jax.jit(
        jax.value_and_grad(
            lambda p, g, m=model: jnp.square(m.apply(p, g, method="streamed")).sum(), (0, 1), allow_int=True
        )
    )
    for name, model in MODELS.items()
}
seeds = st.integers(0, 2**31 - 1)
every_aggregator = pytest.mark.parametrize("name", AGGREGATORS)


def random_group(seed):
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(RECEIVERS, SLOTS, DIM)).astype(np.float32)
    mask = rng.random((RECEIVERS, SLOTS)) < rng.random((RECEIVERS, 1))  # from empty to full
    return Entities(jnp.asarray(features), jnp.asarray(mask)), rng


@every_aggregator
@settings(max_examples=25, deadline=None)
@given(seed=seeds)
def test_masked_entities_have_no_influence(name, seed):
    group, rng = random_group(seed)
    noise = jnp.asarray(rng.normal(size=group.features.shape).astype(np.float32) * 100)
    other = group.replace(features=jnp.where(group.mask[..., None], group.features, noise))
    one, (one_params_gradient, one_gradient) = LOSS[name](PARAMS[name], group)
    two, (two_params_gradient, _) = LOSS[name](PARAMS[name], other)
    assert one == two
    jax.tree.map(np.testing.assert_array_equal, one_params_gradient, two_params_gradient)
    np.testing.assert_array_equal(jnp.where(group.mask[..., None], 0.0, one_gradient.features), 0.0)


@every_aggregator
@settings(max_examples=25, deadline=None)
@given(seed=seeds)
def test_order_has_no_influence(name, seed):
    group, rng = random_group(seed)
    order = rng.permutation(SLOTS)
    other = Entities(group.features[:, order], group.mask[:, order])
    np.testing.assert_allclose(STREAMED[name](PARAMS[name], group), STREAMED[name](PARAMS[name], other), atol=2e-6)


@every_aggregator
@settings(max_examples=25, deadline=None)
@given(seed=seeds)
def test_layouts_agree(name, seed):
    group, _ = random_group(seed)
    by_segments = MODELS[name].apply(PARAMS[name], group, method="by_segments")
    np.testing.assert_allclose(STREAMED[name](PARAMS[name], group), by_segments, atol=2e-6, rtol=1e-5)


@every_aggregator
def test_segments_may_come_in_any_order(name):
    group, rng = random_group(7)
    model = AGGREGATORS[name]()
    segments = sets.segments_of(group.mask)
    messages = jnp.asarray(rng.normal(size=(RECEIVERS * SLOTS, model.num_parts * WIDTH)), jnp.float32)
    order = rng.permutation(RECEIVERS * SLOTS)
    shuffled = segments.replace(receiver=segments.receiver[order], is_present=segments.is_present[order])
    params = model.init(jax.random.key(0), messages, segments)
    one = model.apply(params, messages, segments)
    np.testing.assert_allclose(model.apply(params, messages[order], shuffled), one, atol=1e-6)


@every_aggregator
def test_empty_groups_give_finite_output_and_gradient(name):
    group, _ = random_group(1)
    empty = group.replace(mask=jnp.zeros_like(group.mask))
    loss, (params_gradient, gradient) = LOSS[name](PARAMS[name], empty)
    for leaf in jax.tree.leaves((loss, params_gradient, gradient.features)):
        assert np.isfinite(leaf).all()


@every_aggregator
def test_a_group_without_slots_is_an_empty_group(name):
    group, _ = random_group(1)
    empty = group.replace(mask=jnp.zeros_like(group.mask))
    none = Entities(jnp.zeros((RECEIVERS, 0, DIM)), jnp.zeros((RECEIVERS, 0), bool))
    np.testing.assert_array_equal(STREAMED[name](PARAMS[name], none), STREAMED[name](PARAMS[name], empty))


def test_mean_is_the_mean_of_those_present():
    messages = jnp.arange(12.0).reshape(6, 2)
    segments = sets.Segments(jnp.array([0, 0, 1, 1, 1, 2]), jnp.array([True, True, True, False, True, False]), 3)
    result = AGGREGATORS["mean"]().apply({}, messages, segments)
    np.testing.assert_allclose(result, [[1.0, 2.0], [6.0, 7.0], [0.0, 0.0]])


def conditioned_one_by_one(observations, variances, mean, variance):
    """Posterior of a Gaussian prior after one observation at a time."""
    for observation, noise in zip(observations, variances, strict=True):
        gain = variance / (variance + noise)
        mean, variance = mean + gain * (observation - mean), (1 - gain) * variance
    return mean, variance


@pytest.mark.parametrize("rectifier", ["softplus", "exp"])
def test_bayesian_is_conditioning_on_one_observation_after_the_other(rectifier):
    rng = np.random.default_rng(0)
    messages = rng.normal(size=(5, 6))
    rectify = (lambda x: np.log1p(np.exp(x))) if rectifier == "softplus" else np.exp
    mean, variance = conditioned_one_by_one(messages[:, :3], rectify(messages[:, 3:]), np.full(3, 0.3), rectify(-0.2))
    model = AGGREGATORS["bayesian"](rectifier=rectifier, output_variance=True)
    params = {"params": {"prior_mean": jnp.full(3, 0.3), "prior_variance": jnp.full(3, -0.2)}}
    segments = sets.segments_of(jnp.ones((1, 5), bool))
    result = model.apply(params, jnp.asarray(messages, jnp.float32), segments)
    np.testing.assert_allclose(result[0], np.concatenate([mean, variance]), rtol=1e-5)


def test_bayesian_without_evidence_is_the_prior():
    segments = sets.segments_of(jnp.zeros((1, 2), bool))
    params = {"params": {"prior_mean": jnp.full(3, 0.3), "prior_variance": jnp.zeros(3)}}
    model = AGGREGATORS["bayesian"](output_variance=True)
    result = model.apply(params, jnp.ones((2, 6)), segments)
    np.testing.assert_allclose(result[0], [0.3] * 3 + [np.log(2)] * 3, rtol=1e-6)
    no_prior = AGGREGATORS["bayesian"](prior_mean=None, prior_variance=None)
    np.testing.assert_array_equal(no_prior.apply({}, jnp.ones((2, 6)), segments), 0.0)


def test_precision_of_softplus_and_its_gradient_over_the_whole_range():
    x = jnp.concatenate([jnp.linspace(-60, 100, 401), jnp.array([0.0])])
    variance = np.logaddexp(0, np.float64(x))
    np.testing.assert_allclose(softplus_precision(x), 1 / variance, rtol=1e-5)
    gradient = jax.vmap(jax.grad(softplus_precision))(x)
    np.testing.assert_allclose(gradient, -1 / (1 + np.exp(-np.float64(x))) / variance**2, rtol=1e-5, atol=1e-37)
