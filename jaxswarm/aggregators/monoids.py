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
from jaxswarm.aggregators.sets import DenseView
from jaxswarm.checks import require

# log(1 + t) / t on [0, 1], to 2e-7; `jnp.log1p` takes several times as long on CPU
_LOG1P = Chebyshev.interpolate(lambda t: np.log1p(t) / t, 9, [0, 1]).convert(kind=Polynomial).coef


@jax.custom_jvp
def softplus_precision(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """1 / log(1 + exp(x)), to 1e-6; with its derivative many times faster on CPU than by way of `jax.nn.softplus`."""
    decay = jnp.exp(-jnp.abs(x))
    ratio = functools.reduce(lambda total, c: total * decay + c, _LOG1P[::-1].tolist())
    return 1.0 / (jnp.maximum(x, 0.0) + decay * ratio)


@softplus_precision.defjvp
def _softplus_precision_jvp(primals: tuple, tangents: tuple) -> tuple:
    (x,), (dx,) = primals, tangents
    precision = softplus_precision(x)
    decay = jnp.exp(-jnp.abs(x))  # shared with the line above once compiled
    sigmoid = jnp.where(x > 0, 1.0, decay) / (1.0 + decay)
    return precision, -precision * (precision * sigmoid) * dx


def _bounded(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Above where sums of precisions, and their products with messages, would overflow."""
    return jnp.maximum(x, -60.0)


PRECISION = {  # of what a rectifier makes of a number
    "softplus": lambda x: softplus_precision(_bounded(x)),
    "exp": lambda x: jnp.exp(-_bounded(x)),
}


class Mean(nn.Module):
    """Arithmetic mean; the vector of an empty group is 0."""

    num_parts: ClassVar[int] = 1
    num_encoders: ClassVar[int] = 1
    reduction: ClassVar[str] = "add"

    __call__ = sets.aggregate  # pyright: ignore[reportAssignmentType]

    def lift(self, message: Float[Array, "n features"]) -> tuple[Array, Array]:
        """Message and count."""
        return message, jnp.ones((message.shape[0], 1))

    def lower(self, summary: tuple[Array, Array]) -> Float[Array, "receivers features"]:
        """Sum over count."""
        total, count = summary
        return total / jnp.maximum(count, 1.0)

    def weights(self, view: DenseView) -> Float[Array, "receivers slots"]:
        """1 / n each."""
        return sets.shares(view.mask[..., None], view.mask)


class Max(nn.Module):
    """Largest value of each feature; the vector of an empty group is 0."""

    num_parts: ClassVar[int] = 1
    num_encoders: ClassVar[int] = 1
    reduction: ClassVar[str] = "max"

    __call__ = sets.aggregate  # pyright: ignore[reportAssignmentType]

    def lift(self, message: Float[Array, "n features"]) -> Array:
        """The message."""
        return message

    def lower(self, summary: Array) -> Float[Array, "receivers features"]:
        """The maximum, if there is one."""
        return jnp.where(summary > sets.LOWEST, summary, 0.0)

    def weights(self, view: DenseView) -> Float[Array, "receivers slots"]:
        """Share of the features in which an entity has the largest value; those that are equal share one."""
        x = jnp.where(view.mask[..., None], view.messages, sets.LOWEST)
        return sets.shares(x == x.max(1, keepdims=True, initial=sets.LOWEST), view.mask)


class Softmax(nn.Module):
    """Mean of each feature, weighted by its own exponential; the vector of an empty group is 0.

    z = sum_n x_n exp(x_n) / sum_n exp(x_n)
    """

    num_parts: ClassVar[int] = 1
    num_encoders: ClassVar[int] = 1
    reduction: ClassVar[str] = "scaled_add"

    __call__ = sets.aggregate  # pyright: ignore[reportAssignmentType]

    def lift(self, message: Float[Array, "n features"]) -> tuple[Array, tuple[Array, Array]]:
        """Numerator x exp(x) and denominator exp(x), both in units of exp(x)."""
        return message, (message, jnp.ones_like(message))

    def lower(self, summary: tuple[Array, tuple[Array, Array]]) -> Float[Array, "receivers features"]:
        """Numerator over denominator."""
        _, (weighted, weight) = summary
        return weighted / jnp.where(weight > 0, weight, 1.0)

    def weights(self, view: DenseView) -> Float[Array, "receivers slots"]:
        """exp(x_n) / sum_n exp(x_n), mean over the features."""
        x = jnp.where(view.mask[..., None], view.messages, sets.LOWEST)
        return sets.shares(jnp.exp(x - x.max(1, keepdims=True, initial=sets.LOWEST)), view.mask)


class Bayesian(nn.Module):
    """Gaussian conditioning of a latent vector z on one observation per entity (Volpp et al., 2021, eq. 8).

        1 / s_z = 1 / s_0 + sum_n 1 / s_n
        mu_z = mu_0 + s_z sum_n (r_n - mu_0) / s_n

    A message has two parts: the observations r_n and what the rectifier turns into their variances s_n; one encoder
    makes both, or each has its own. The prior mean mu_0 and the (rectified) prior variance s_0 are learned per feature
    or as one scalar, fixed to where these begin (1, and the rectified 1), or absent (0 and infinity). The vector of an
    empty group is the prior mean, or 0 where there is no prior variance. With `output_variance` the vector is
    [mu_z, s_z]; an empty group without prior then has variance 0.
    """

    prior_mean: Literal["feature", "scalar", "fixed"] | None = "feature"
    prior_variance: Literal["feature", "scalar", "fixed"] | None = "feature"
    rectifier: Literal["softplus", "exp"] = "softplus"
    variance_encoder: Literal["shared", "separate"] = "shared"
    output_variance: bool = False

    __no_type_check__ = True  # checked below, with a message for users

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
        """One encoder makes both parts of a message, or each has its own."""
        return 1 if self.variance_encoder == "shared" else 2

    __call__ = sets.aggregate  # pyright: ignore[reportAssignmentType]

    def lift(self, observation: Float[Array, "n features"], raw_variance: Float[Array, "n features"]) -> tuple:
        """Natural parameters of the Gaussian likelihood: r / s and 1 / s."""
        precision = PRECISION[self.rectifier](raw_variance)
        return observation * precision, precision

    @nn.compact
    def lower(self, summary: tuple[Array, Array]) -> Float[Array, "receivers features"]:
        """Adds the prior and turns natural parameters into mean and variance."""
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
        """(1 / s_n) / sum_n (1 / s_n), mean over the features; what the prior adds is left out."""
        raw_variance = jnp.split(view.messages, 2, -1)[1]
        return sets.shares(PRECISION[self.rectifier](raw_variance), view.mask)

    def _prior(self, name: str, kind: str, num_features: int) -> Array:
        if kind == "fixed":
            return jnp.ones(1)
        return self.param(name, nn.initializers.ones, (num_features if kind == "feature" else 1,))
