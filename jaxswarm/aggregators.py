"""Aggregators: the messages of a group of any size, in any order, become one vector of fixed size.

An aggregator is a linen module that is called with a list of messages and their `Segments`, and gives the vector of
each receiver. Most are commutative monoids (see `sets`), which is why they can also be computed without ever holding
all messages at once; `Attentive` and `Concat` need the whole group and have `pool` instead.

Each tells by `weights` which share each entity has in the vector of its group, for those who look at a trained policy:
shares of present entities sum to 1, absent ones have exactly 0.

A message has `num_parts` parts of equal length. `num_encoders` says what makes them: one encoder all parts, as many
encoders one part each, or, if 0, the message is the features of an entity as they are.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Bool, Float, Int, Shaped
from numpy.polynomial import Chebyshev, Polynomial

from jaxswarm import sets
from jaxswarm.sets import DenseView
from jaxswarm.types import is_whole, require

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


def _shares(
    importance: Shaped[Array, "receivers slots features"], mask: Bool[Array, "receivers slots"]
) -> Float[Array, "receivers slots"]:
    """Importance over its sum over the entities that are present, mean over the features."""
    importance = jnp.where(mask[..., None], importance, 0).astype(jnp.float32)
    total = importance.sum(1, keepdims=True)
    return (importance / jnp.where(total > 0, total, 1.0)).mean(-1)


PRECISION = {"softplus": softplus_precision, "exp": lambda x: jnp.exp(-x)}  # of what a rectifier makes of a number


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
        return _shares(view.mask[..., None], view.mask)


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
        return _shares(x == x.max(1, keepdims=True, initial=sets.LOWEST), view.mask)


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
        return _shares(jnp.exp(x - x.max(1, keepdims=True, initial=sets.LOWEST)), view.mask)


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
        require(self, "feature, scalar, fixed, None", lambda x: x in priors, "prior_mean", "prior_variance")
        require(self, "softplus, exp", lambda x: x in PRECISION, "rectifier")
        require(self, "shared, separate", lambda x: x in ("shared", "separate"), "variance_encoder")
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
        return _shares(PRECISION[self.rectifier](raw_variance), view.mask)

    def _prior(self, name: str, kind: str, num_features: int) -> Array:
        if kind == "fixed":
            return jnp.ones(1)
        return self.param(name, nn.initializers.ones, (num_features if kind == "feature" else 1,))


class Attentive(nn.Module):
    """Multi-head self-attention over the group (Vaswani et al., 2017), a residual, then a weighted mean.

        p_hij = softmax_j (q_hi . k_hj / sqrt(d)),   y_i = x_i + W_o [sum_j p_hij v_hj]_h + b_o,   z = sum_i w_i y_i

    With `pooling="mean"` all w_i are equal, as in the thesis; with "query", w = softmax_i (q_0 . y_i / sqrt(D)), where
    q_0 is a linear function of what the receiver knows of itself. Parameters and their initialisation are those of
    PyTorch's `MultiheadAttention`, but the output projection's is orthogonal with gain sqrt(2). The vector of an empty
    group is 0.
    """

    num_heads: int = 2
    residual: bool = True
    pooling: Literal["mean", "query"] = "mean"

    __no_type_check__ = True  # checked below, with a message for users

    num_parts: ClassVar[int] = 1
    num_encoders: ClassVar[int] = 1

    def __post_init__(self) -> None:
        require(self, "whole numbers from 1", is_whole(1), "num_heads")
        require(self, "mean, query", lambda x: x in ("mean", "query"), "pooling")
        super().__post_init__()

    __call__ = sets.aggregate  # pyright: ignore[reportAssignmentType]

    def pool(self, view: DenseView) -> Float[Array, "receivers features"]:
        """The vector z of each receiver."""
        return self._attend(view)[0]

    def weights(self, view: DenseView) -> Float[Array, "receivers slots"]:
        """sum_i w_i p_hij, mean over the heads; without what entity j adds by the residual."""
        return jnp.stack(self._attend(view)[1]).mean(0)

    @nn.compact
    def _attend(self, view: DenseView) -> tuple[Float[Array, "receivers features"], list[Array]]:
        """The z, and sum_i w_i p_hij of each head.

        As y is linear in the values, only one weighted mean of the x_j is taken to values, by receiver and head.
        """
        x, size = view.messages, view.messages.shape[-1]
        if size % self.num_heads:
            raise ValueError(f"num_heads = {self.num_heads} is not possible; accepted: divisors of {size} features")
        W_in = self.param("in_kernel", nn.initializers.xavier_uniform(), (size, 3 * size))
        b_in = self.param("in_bias", nn.initializers.zeros, (3 * size,))
        W_o = self.param("out_kernel", nn.initializers.orthogonal(math.sqrt(2.0)), (size, size))
        b_o = self.param("out_bias", nn.initializers.zeros, (size,))
        W_q, W_k, W_v = jnp.moveaxis(W_in.reshape(size, 3, self.num_heads, -1), 0, 2)  # [heads, size, d] each
        b_q, _, b_v = b_in.reshape(3, self.num_heads, -1)  # that of the keys adds the same to the scores of all j

        attention = [_attention(view, *head) for head in zip(W_q, W_k, b_q, strict=True)]
        if self.pooling == "mean":
            w = view.mask / jnp.maximum(view.mask.sum(-1, keepdims=True), 1)
        else:
            w = self._query_weights(view, attention, W_v @ W_o.reshape(self.num_heads, -1, size))
        weights = [jnp.einsum("ri,rij->rj", w / total, e) for e, total in attention]
        *means, mean = jnp.moveaxis(jnp.einsum("rhj,rje->rhe", jnp.stack([*weights, w], 1), x), 1, 0)
        values = [mean_h @ W + b[None] for mean_h, W, b in zip(means, W_v, b_v, strict=True)]
        z = jnp.concatenate(values, -1) @ W_o + b_o[None]
        if self.residual:
            z = z + mean
        return jnp.where(view.mask.any(-1, keepdims=True), z, 0.0), weights

    def _query_weights(
        self, view: DenseView, attention: list, value_output: Float[Array, "heads size size"]
    ) -> Float[Array, "receivers slots"]:
        """The w_i of a learned query: q_0 . y_i but for what is the same for all i; `value_output` is W_v W_o."""
        if view.own is None:
            raise ValueError("own = None is not possible with pooling = 'query'; accepted: features of the receivers")
        x = view.messages
        query = nn.Dense(x.shape[-1], name="query")(view.own) / math.sqrt(x.shape[-1])
        score = jnp.einsum("re,rie->ri", query, x) if self.residual else jnp.zeros(view.mask.shape)
        for (e, total), W_vo in zip(attention, value_output, strict=True):
            score = score + jnp.einsum("rij,rj->ri", e, jnp.einsum("re,rje->rj", query @ W_vo.T, x)) / total
        e, total = _exponentials(score, view.mask)
        return jnp.where(view.mask, e / total[:, None], 0.0)


def _attention(
    view: DenseView, queries: Float[Array, "size d"], keys: Float[Array, "size d"], query_bias: Float[Array, " d"]
) -> tuple[Float[Array, "receivers slots slots"], Float[Array, "receivers slots"]]:
    """p_ij of one head as `_exponentials`."""
    x, (size, d) = view.messages, keys.shape
    scale = 1 / math.sqrt(d)

    def project(kernel: Array) -> Array:
        return x.reshape(-1, size) @ kernel

    query = (project(queries * scale) + (query_bias * scale)[None]).reshape(*x.shape[:2], d)
    key = project(keys).reshape(*x.shape[:2], d)
    return _exponentials(jnp.einsum("rid,rjd->rij", query, key), view.mask[:, None])


def _exponentials(score: Float[Array, "*n slots"], mask: Bool[Array, "*#n slots"]) -> tuple[Array, Array]:
    """Numerators of a softmax over the last axis, and their sums; absent entities have 0 where there are others."""
    score = jnp.where(mask, score, sets.LOWEST)
    top = jax.lax.stop_gradient(score.max(-1, initial=sets.LOWEST, keepdims=True))
    e = jnp.exp(score - top)
    return e, e.sum(-1)


class Concat(nn.Module):
    """The features of the nearest entities one after the other, the nearest first, zeros where there are fewer.

    The baseline without an aggregate: its size grows with the group. The first feature is the distance; of equally
    distant entities the later features decide.
    """

    max_entities: int = 10

    num_parts: ClassVar[int] = 1
    num_encoders: ClassVar[int] = 0

    def __post_init__(self) -> None:
        require(self, "whole numbers from 1", is_whole(1), "max_entities")
        super().__post_init__()

    __call__ = sets.aggregate  # pyright: ignore[reportAssignmentType]

    def pool(self, view: DenseView) -> Float[Array, "receivers all_features"]:
        """Sorts by distance, absent entities last."""
        order = self._order(view)[..., None]
        nearest = jnp.take_along_axis(jnp.where(view.mask[..., None], view.messages, 0.0), order, axis=1)
        nearest = jnp.pad(nearest, ((0, 0), (0, self.max_entities - nearest.shape[1]), (0, 0)))
        return nearest.reshape(nearest.shape[0], self.max_entities * nearest.shape[2])

    def weights(self, view: DenseView) -> Float[Array, "receivers slots"]:
        """Equal for those that there is room for, 0 for the others."""
        is_taken = jax.nn.one_hot(self._order(view), view.mask.shape[1], dtype=bool).any(1)
        return _shares((is_taken & view.mask)[..., None], view.mask)

    def _order(self, view: DenseView) -> Int[Array, "receivers nearest"]:
        keys = jnp.where(view.mask[..., None], jax.lax.stop_gradient(view.messages), jnp.inf)
        return jnp.lexsort(jnp.moveaxis(keys, -1, 0)[::-1])[:, : self.max_entities]


class Histogram(nn.Module):
    """Fractions of the entities in bins of distance and bearing (Hüttenrauch et al., 2019).

    The first feature is the distance, the next two are [cos, sin] (or [sin, cos]) of the bearing. Entities beyond
    `max_distance` (in the unit of the feature) count in the outermost bins. The vector of an empty group is 0.
    """

    num_distances: int = 8
    num_bearings: int = 8
    max_distance: float = 1.0

    num_parts: ClassVar[int] = 1
    num_encoders: ClassVar[int] = 0
    reduction: ClassVar[str] = "add"

    def __post_init__(self) -> None:
        require(self, "whole numbers from 1", is_whole(1), "num_distances")
        require(self, "whole numbers from 3", is_whole(3), "num_bearings")
        require(self, "positive numbers", lambda x: x > 0, "max_distance")
        super().__post_init__()

    __call__ = sets.aggregate  # pyright: ignore[reportAssignmentType]

    def lift(self, features: Float[Array, "n dim"]) -> tuple[Array, Array]:
        """One-hot bin and count."""
        distance, bearing = _distance_and_bearing(features)
        inner_edges = np.arange(1, self.num_distances) * self.max_distance / self.num_distances
        beyond = distance >= jnp.asarray(inner_edges, jnp.float32)[None]
        ones = jnp.ones((features.shape[0], 1), bool)
        in_ring = jnp.concatenate([ones, beyond], 1) & ~jnp.concatenate([beyond, ~ones], 1)
        edge = jnp.asarray(_directions(self.num_bearings))
        is_left = bearing[:, 1:] * edge[None, 0] >= bearing[:, :1] * edge[None, 1]  # of an edge between sectors
        in_sector = is_left & ~jnp.roll(is_left, -1, axis=1)
        return _outer(in_ring, in_sector, jnp.logical_and).astype(jnp.float32), ones.astype(jnp.float32)

    lower = Mean.lower
    weights = Mean.weights


class RadialBasis(nn.Module):
    """Mean of radial basis functions on a grid over distance and bearing (Hüttenrauch et al., 2019).

        phi_kl = exp(-(d - d_k)^2 / (2 u^2)) exp((cos(b - b_l) - 1) / v^2)

    The first feature is the distance d, the next two are [cos, sin] (or [sin, cos]) of the bearing b. The d_k are
    evenly spaced from 0 to `max_distance` (in the unit of the feature), the b_l on the circle; near b_l the second
    factor is a Gaussian of width v. Widths are in units of the spacing. The vector of an empty group is 0.
    """

    num_distances: int = 8
    num_bearings: int = 8
    max_distance: float = 1.0
    distance_width: float = 1.0
    bearing_width: float = 1.0

    num_parts: ClassVar[int] = 1
    num_encoders: ClassVar[int] = 0
    reduction: ClassVar[str] = "add"

    def __post_init__(self) -> None:
        require(self, "whole numbers from 2", is_whole(2), "num_distances", "num_bearings")
        require(self, "positive numbers", lambda x: x > 0, "max_distance", "distance_width", "bearing_width")
        super().__post_init__()

    __call__ = sets.aggregate  # pyright: ignore[reportAssignmentType]

    def lift(self, features: Float[Array, "n dim"]) -> tuple[Array, Array]:
        """Values of all basis functions, and count."""
        d, b = _distance_and_bearing(features)
        spacing = self.max_distance / (self.num_distances - 1)
        centres = jnp.linspace(0.0, self.max_distance, self.num_distances)
        near = jnp.exp(-0.5 * jnp.square((d - centres[None]) / (self.distance_width * spacing)))
        v = self.bearing_width * 2 * math.pi / self.num_bearings
        ahead = jnp.exp((b @ jnp.asarray(_directions(self.num_bearings)) - 1.0) / v**2)
        return _outer(near, ahead, jnp.multiply), jnp.ones((features.shape[0], 1))

    lower = Mean.lower
    weights = Mean.weights


def _distance_and_bearing(features: Float[Array, "n dim"]) -> tuple[Float[Array, "n 1"], Float[Array, "n 2"]]:
    """An entity at distance 0, whose bearing may be given as [0, 0], is ahead."""
    if features.shape[1] < 3:
        raise ValueError(f"{features.shape[1]} features are not possible; accepted: distance, cos and sin of bearing")
    distance, bearing = features[:, :1], features[:, 1:3]
    is_ahead = (bearing == 0).all(-1, keepdims=True)
    return distance, jnp.where(is_ahead, jnp.array([[1.0, 0.0]]), bearing)


def _outer(a: Shaped[Array, "n i"], b: Shaped[Array, "n j"], product: Callable) -> Shaped[Array, "n i_times_j"]:
    """All products of a feature of each."""
    return product(a[:, :, None], b[:, None]).reshape(a.shape[0], a.shape[1] * b.shape[1])


def _directions(number: int) -> np.ndarray:
    """Unit vectors [2, number], evenly spaced on the circle, the first along x."""
    angle = 2 * math.pi * np.arange(number) / number
    return np.stack([np.cos(angle), np.sin(angle)]).astype(np.float32)


AGGREGATORS: dict[str, Any] = {
    "mean": Mean,
    "max": Max,
    "softmax": Softmax,
    "bayesian": Bayesian,
    "attentive": Attentive,
    "concat": Concat,
    "histogram": Histogram,
    "rbf": RadialBasis,
}
