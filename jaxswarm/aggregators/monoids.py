"""Aggregators that are commutative monoids of encoded entities: mean, max, softmax and Bayesian."""

import functools
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float
from numpy.polynomial import Chebyshev, Polynomial

from jaxswarm import checks
from jaxswarm.aggregators import sets
from jaxswarm.aggregators.sets import Aggregator, DenseView
from jaxswarm.checks import require

# Coefficients of log(1 + t) / t on [0, 1], exact to 2e-7; `jnp.log1p` takes several times as long on a CPU.
_LOG1P = Chebyshev.interpolate(lambda t: np.log1p(t) / t, 9, [0, 1]).convert(kind=Polynomial).coef


@jax.custom_jvp
def softplus_precision(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return 1 / log(1 + exp(x)), exact to 1e-6.

    Together with its derivative it is many times faster on a CPU than `1 / jax.nn.softplus(x)`.
    """
    decay = jnp.exp(-jnp.abs(x))
    ratio = functools.reduce(lambda total, c: total * decay + c, _LOG1P[::-1].tolist())
    return 1.0 / (jnp.maximum(x, 0.0) + decay * ratio)


@softplus_precision.defjvp
def _softplus_precision_jvp(primals: tuple, tangents: tuple) -> tuple:
    (x,), (dx,) = primals, tangents
    precision = softplus_precision(x)
    decay = jnp.exp(-jnp.abs(x))  # XLA shares it with the call above
    sigmoid = jnp.where(x > 0, 1.0, decay) / (1.0 + decay)
    return precision, -precision * (precision * sigmoid) * dx


def _bounded(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Clip x to >= -60, so that sums of precisions and their products with messages do not overflow."""
    return jnp.maximum(x, -60.0)


PRECISION = {  # 1 / s of the variance s that the rectifier makes of a number
    "softplus": lambda x: softplus_precision(_bounded(x)),
    "exp": lambda x: jnp.exp(-_bounded(x)),
}


class Mean(Aggregator):
    """Arithmetic mean of the messages; the vector of an empty group is 0."""

    num_parts: ClassVar[int] = 1
    num_encoders: ClassVar[int] = 1
    reduction: ClassVar[str] = "add"

    def lift(self, message: Float[Array, "n features"]) -> tuple[Array, Array]:
        """Return the message and the count 1."""
        return message, jnp.ones((message.shape[0], 1))

    def lower(self, summary: tuple[Array, Array]) -> Float[Array, "receivers features"]:
        """Return the sum over the count."""
        total, count = summary
        return total / jnp.maximum(count, 1.0)

    def weights(self, view: DenseView) -> Float[Array, "receivers slots"]:
        """Return 1 / n for each of n entities."""
        return sets.normalized_weights(view.mask[..., None], view.mask)


class Max(Aggregator):
    """Largest value of each feature; the vector of an empty group is 0."""

    num_parts: ClassVar[int] = 1
    num_encoders: ClassVar[int] = 1
    reduction: ClassVar[str] = "max"

    def lift(self, message: Float[Array, "n features"]) -> Array:
        """Return the message, which is its own summary."""
        return message

    def lower(self, summary: Array) -> Float[Array, "receivers features"]:
        """Return the maximum, and 0 for empty groups."""
        return jnp.where(summary > sets.LOWEST, summary, 0.0)

    def weights(self, view: DenseView) -> Float[Array, "receivers slots"]:
        """Return the share of features in which an entity has the largest value; equal entities share a feature."""
        x = jnp.where(view.mask[..., None], view.messages, sets.LOWEST)
        return sets.normalized_weights(x == x.max(1, keepdims=True, initial=sets.LOWEST), view.mask)


class Softmax(Aggregator):
    """Mean of each feature, weighted by the exponential of the feature.

        z = sum_n x_n exp(x_n) / sum_n exp(x_n)

    The vector of an empty group is 0.
    """

    num_parts: ClassVar[int] = 1
    num_encoders: ClassVar[int] = 1
    reduction: ClassVar[str] = "scaled_add"

    def lift(self, message: Float[Array, "n features"]) -> tuple[Array, tuple[Array, Array]]:
        """Return the numerator x exp(x) and the denominator exp(x), both in units of exp(x)."""
        return message, (message, jnp.ones_like(message))

    def lower(self, summary: tuple[Array, tuple[Array, Array]]) -> Float[Array, "receivers features"]:
        """Return the numerator over the denominator."""
        _, (weighted, weight) = summary
        return weighted / jnp.where(weight > 0, weight, 1.0)

    def weights(self, view: DenseView) -> Float[Array, "receivers slots"]:
        """Return exp(x_n) / sum_n exp(x_n), mean over the features."""
        x = jnp.where(view.mask[..., None], view.messages, sets.LOWEST)
        return sets.normalized_weights(jnp.exp(x - x.max(1, keepdims=True, initial=sets.LOWEST)), view.mask)


class Bayesian(Aggregator):
    """Gaussian conditioning of a latent vector z on one observation per entity (Volpp et al., 2021, eq. 8).

        1 / s_z = 1 / s_0 + sum_n 1 / s_n
        mu_z = mu_0 + s_z sum_n (r_n - mu_0) / s_n

    A message has two parts: the observations r_n, and numbers that the rectifier turns into their variances s_n. The
    prior has mean mu_0 and variance s_0. The vector is mu_z, or [mu_z, s_z] with `output_variance`. The vector of an
    empty group is the prior mean, or 0 if the prior variance is infinite; then s_z is 0, too.

    Attributes:
        prior_mean: The prior mean is learned per feature (`feature`) or as one scalar (`scalar`), both starting at 1,
            or it is fixed to 1 (`fixed`) or to 0 (null).
        prior_variance: The prior variance is learned per feature (`feature`) or as one scalar (`scalar`), both starting
            at the rectified 1, or it is fixed to the rectified 1 (`fixed`) or infinite (null).
        rectifier: The rectifier makes variances positive by log(1 + exp(x)) (`softplus`) or by exp(x) (`exp`).
        variance_encoder: One encoder computes observations and variances (`shared`), or each has its own encoder
            (`separate`).
        output_variance: The vector also contains the variance of the posterior if true, which doubles its length.
    """

    prior_mean: Literal["feature", "scalar", "fixed"] | None = "feature"
    prior_variance: Literal["feature", "scalar", "fixed"] | None = "feature"
    rectifier: Literal["softplus", "exp"] = "softplus"
    variance_encoder: Literal["shared", "separate"] = "shared"
    output_variance: bool = False

    __no_type_check__ = True  # `__post_init__` checks the fields, with a message for users

    num_parts: ClassVar[int] = 2
    reduction: ClassVar[str] = "add"

    def __post_init__(self) -> None:
        priors = ("feature", "scalar", "fixed", None)
        require(self, checks.choice(priors), "prior_mean", "prior_variance")
        require(self, checks.choice(PRECISION), "rectifier")
        require(self, checks.choice(("shared", "separate")), "variance_encoder")
        require(self, checks.BOOL, "output_variance")
        super().__post_init__()

    @property
    def num_encoders(self) -> int:
        """Number of encoders: 1 for both parts of a message, or 2, one for each part."""
        return 1 if self.variance_encoder == "shared" else 2

    def lift(self, observation: Float[Array, "n features"], raw_variance: Float[Array, "n features"]) -> tuple:
        """Return the natural parameters r / s and 1 / s of the Gaussian likelihood."""
        precision = PRECISION[self.rectifier](raw_variance)
        return observation * precision, precision

    @nn.compact
    def lower(self, summary: tuple[Array, Array]) -> Float[Array, "receivers features"]:
        """Add the prior and convert the natural parameters to mean and variance."""
        weighted, precision = summary
        if self.prior_variance is not None:
            raw = self._prior("prior_variance", self.prior_variance, weighted.shape[-1])
            prior_precision = PRECISION[self.rectifier](raw)
            precision = precision + prior_precision[None]
            if self.prior_mean is not None:
                mean = self._prior("prior_mean", self.prior_mean, weighted.shape[-1])
                weighted = weighted + (mean * prior_precision)[None]
        variance = jnp.where(precision > 0, 1.0 / jnp.where(precision > 0, precision, 1.0), 0.0)
        return jnp.concatenate([weighted * variance, variance], -1) if self.output_variance else weighted * variance

    def weights(self, view: DenseView) -> Float[Array, "receivers slots"]:
        """Return (1 / s_n) / sum_n (1 / s_n), mean over the features, without the share of the prior."""
        raw_variance = jnp.split(view.messages, 2, -1)[1]
        return sets.normalized_weights(PRECISION[self.rectifier](raw_variance), view.mask)

    def _prior(self, name: str, kind: str, num_features: int) -> Array:
        if kind == "fixed":
            return jnp.ones(1)
        return self.param(name, nn.initializers.ones, (num_features if kind == "feature" else 1,))
