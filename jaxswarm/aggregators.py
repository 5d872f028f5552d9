"""Aggregators: the messages of a group of any size, in any order, become one vector of fixed size.

An aggregator is a linen module that is called with a flat list of messages and their `Segments`. The ones below are
commutative monoids (see `sets`), which is why they can also be computed without ever holding all messages at once.
"""

from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from jaxswarm import sets
from jaxswarm.sets import Segments


@jax.custom_jvp
def softplus_precision(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """1 / log(1 + exp(x)); with its derivative several times faster on CPU than by way of `jax.nn.softplus`."""
    return 1.0 / (jnp.maximum(x, 0.0) + jnp.log1p(jnp.exp(-jnp.abs(x))))


@softplus_precision.defjvp
def _softplus_precision_jvp(primals: tuple, tangents: tuple) -> tuple:
    (x,), (dx,) = primals, tangents
    precision = softplus_precision(x)
    decay = jnp.exp(-jnp.abs(x))  # shared with the line above once compiled
    sigmoid = jnp.where(x > 0, 1.0, decay) / (1.0 + decay)
    return precision, -precision * (precision * sigmoid) * dx


PRECISION = {"softplus": softplus_precision, "exp": lambda x: jnp.exp(-x)}  # of what a rectifier makes of a number


class Mean(nn.Module):
    """Arithmetic mean; the vector of an empty group is 0."""

    num_parts: ClassVar[int] = 1
    reduction: ClassVar[str] = "add"

    def __call__(
        self, messages: Float[Array, "messages features"], segments: Segments
    ) -> Float[Array, "receivers features"]:
        """Mean of the messages of each receiver."""
        return sets.reduce_segments(self, messages, segments)

    def lift(self, message: Float[Array, "n features"]) -> tuple[Array, Array]:
        """Message and count."""
        return message, jnp.ones((message.shape[0], 1))

    def lower(self, summary: tuple[Array, Array]) -> Float[Array, "receivers features"]:
        """Sum over count."""
        total, count = summary
        return total / jnp.maximum(count, 1.0)


class Bayesian(nn.Module):
    """Gaussian conditioning of a latent vector z on one observation per entity (Volpp et al., 2021, eq. 8).

        1 / s_z = 1 / s_0 + sum_n 1 / s_n
        mu_z = mu_0 + s_z sum_n (r_n - mu_0) / s_n

    A message has two parts: the observations r_n and what the rectifier turns into their variances s_n. The prior
    mean mu_0 and the (rectified) prior variance s_0 are learned per feature, as one scalar, or are absent (0 and
    infinity). The vector of an empty group is the prior mean, or 0 where there is no prior variance. With
    `output_variance` the vector is [mu_z, s_z]; an empty group without prior then has variance 0.
    """

    prior_mean: Literal["feature", "scalar"] | None = "feature"
    prior_variance: Literal["feature", "scalar"] | None = "feature"
    rectifier: Literal["softplus", "exp"] = "softplus"
    output_variance: bool = False

    num_parts: ClassVar[int] = 2
    reduction: ClassVar[str] = "add"

    @nn.compact
    def __call__(
        self, messages: Float[Array, "messages parts"], segments: Segments
    ) -> Float[Array, "receivers features"]:
        """Posterior of each receiver; the first half of a message is r, the second the raw variance."""
        return sets.reduce_segments(self, messages, segments)

    def lift(self, observation: Float[Array, "n features"], raw_variance: Float[Array, "n features"]) -> tuple:
        """Natural parameters of the Gaussian likelihood: r / s and 1 / s."""
        precision = PRECISION[self.rectifier](raw_variance)
        return observation * precision, precision

    @nn.compact
    def lower(self, summary: tuple[Array, Array]) -> Float[Array, "receivers features"]:
        """Adds the prior and turns natural parameters into mean and variance."""
        weighted, precision = summary
        shape = {"feature": weighted.shape[-1:], "scalar": (1,)}
        if self.prior_variance is not None:
            raw = self.param("prior_variance", nn.initializers.ones, shape[self.prior_variance])
            prior_precision = PRECISION[self.rectifier](raw)
            precision = precision + prior_precision[None]
            if self.prior_mean is not None:
                mean = self.param("prior_mean", nn.initializers.ones, shape[self.prior_mean])
                weighted = weighted + (mean * prior_precision)[None]
        variance = jnp.where(precision > 0, 1.0 / jnp.where(precision > 0, precision, 1.0), 0.0)
        return jnp.concatenate([weighted * variance, variance], -1) if self.output_variance else weighted * variance


AGGREGATORS = {"mean": Mean, "bayesian": Bayesian}
