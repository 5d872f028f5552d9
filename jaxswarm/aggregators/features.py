"""Aggregators of the features of entities, without an encoder: concatenation, histogram and radial basis functions."""

import math
from collections.abc import Callable
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from jaxswarm import checks
from jaxswarm.aggregators import sets
from jaxswarm.aggregators.monoids import Mean
from jaxswarm.aggregators.sets import Aggregator, DenseView
from jaxswarm.checks import require

MAX_SIZE = 10_000  # of bins, centers and slots, which are partly computed when the aggregator is traced


class Concat(Aggregator):
    """Concatenation of the features of the nearest entities, the nearest first, padded with zeros.

    This is the baseline without an aggregate, whose size grows with the group. The first feature must be the distance;
    the later features break ties.

    Attributes:
        max_entities: The vector holds the features of at most this many entities (an integer >= 1), and entities
            farther away are ignored.
    """

    max_entities: int = 10

    num_parts: ClassVar[int] = 1
    num_encoders: ClassVar[int] = 0

    def __post_init__(self) -> None:
        require(self, checks.size(1, MAX_SIZE), "max_entities")
        super().__post_init__()

    def pool(self, view: DenseView) -> Float[Array, "receivers all_features"]:
        """Return the features sorted by distance, absent entities last."""
        order = self._order(view)[..., None]
        nearest = jnp.take_along_axis(jnp.where(view.mask[..., None], view.messages, 0.0), order, axis=1)
        nearest = jnp.pad(nearest, ((0, 0), (0, self.max_entities - nearest.shape[1]), (0, 0)))
        return nearest.reshape(nearest.shape[0], self.max_entities * nearest.shape[2])

    def weights(self, view: DenseView) -> Float[Array, "receivers slots"]:
        """Return equal shares for the nearest `max_entities` entities and 0 for the others."""
        is_nearest = jax.nn.one_hot(self._order(view), view.mask.shape[1], dtype=bool).any(1)
        return sets.normalized_weights((is_nearest & view.mask)[..., None], view.mask)

    def _order(self, view: DenseView) -> Int[Array, "receivers nearest"]:
        keys = jnp.where(view.mask[..., None], jax.lax.stop_gradient(view.messages), jnp.inf)
        return jnp.lexsort(jnp.moveaxis(keys, -1, 0)[::-1])[:, : self.max_entities]


class Histogram(Aggregator):
    """Fractions of the entities in bins of distance and bearing (Hüttenrauch et al., 2019).

    The first feature must be the distance, the next two [cos, sin] (or [sin, cos]) of the bearing. The vector of an
    empty group is 0.

    Attributes:
        num_distances: The distances from 0 to `max_distance` are divided into this many equal bins (an integer >= 1).
        num_bearings: The circle of bearings is divided into this many equal bins (an integer >= 3).
        max_distance: The last bin of distance ends at this value (> 0, in the unit of the feature) and also counts all
            entities beyond it.
    """

    num_distances: int = 8
    num_bearings: int = 8
    max_distance: float = 1.0

    num_parts: ClassVar[int] = 1
    num_encoders: ClassVar[int] = 0
    reduction: ClassVar[str] = "add"

    def __post_init__(self) -> None:
        require(self, checks.size(1, MAX_SIZE), "num_distances")
        require(self, checks.size(3, MAX_SIZE), "num_bearings")
        require(self, checks.POSITIVE, "max_distance")
        super().__post_init__()

    def lift(self, features: Float[Array, "n dim"]) -> tuple[Array, Array]:
        """Return the one-hot bin and the count 1."""
        distance, bearing = _distance_and_bearing(features)
        inner_edges = np.arange(1, self.num_distances) * self.max_distance / self.num_distances
        beyond = distance >= jnp.asarray(inner_edges, jnp.float32)[None]
        ones = jnp.ones((features.shape[0], 1), bool)
        in_ring = jnp.concatenate([ones, beyond], 1) & ~jnp.concatenate([beyond, ~ones], 1)
        edge = jnp.asarray(_directions(self.num_bearings))
        is_left_of_edge = bearing[:, 1:] * edge[None, 0] >= bearing[:, :1] * edge[None, 1]
        in_sector = is_left_of_edge & ~jnp.roll(is_left_of_edge, -1, axis=1)
        return _outer(in_ring, in_sector, jnp.logical_and).astype(jnp.float32), ones.astype(jnp.float32)

    lower = Mean.lower
    weights = Mean.weights


class RadialBasis(Aggregator):
    """Mean of radial basis functions on a grid over distance and bearing (Hüttenrauch et al., 2019).

        phi_kl = exp(-(d - d_k)^2 / (2 u^2)) exp((cos(b - b_l) - 1) / v^2)

    The first feature must be the distance d, the next two [cos, sin] (or [sin, cos]) of the bearing b. The widths are
    u = `distance_width` spacings of the centers d_k, and v = `bearing_width` spacings of the centers b_l. Near b_l, the
    second factor is a Gaussian of width v. The vector of an empty group is 0.

    Attributes:
        num_distances: This many centers (an integer >= 2) are evenly spaced from distance 0 to `max_distance`.
        num_bearings: This many centers (an integer >= 2) are evenly spaced on the circle of bearings.
        max_distance: The last center of distance lies at this value (> 0, in the unit of the feature).
        distance_width: The functions of distance have this standard deviation (> 0, in spacings between the centers).
        bearing_width: The functions of bearing have this standard deviation near their centers (> 0, in spacings
            between the centers).
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
        require(self, checks.size(2, MAX_SIZE), "num_distances", "num_bearings")
        require(self, checks.POSITIVE, "max_distance", "distance_width", "bearing_width")
        super().__post_init__()

    def lift(self, features: Float[Array, "n dim"]) -> tuple[Array, Array]:
        """Return the values of all basis functions and the count 1."""
        d, b = _distance_and_bearing(features)
        spacing = self.max_distance / (self.num_distances - 1)
        centers = jnp.linspace(0.0, self.max_distance, self.num_distances)
        near = jnp.exp(-0.5 * jnp.square((d - centers[None]) / (self.distance_width * spacing)))
        v = self.bearing_width * 2 * math.pi / self.num_bearings
        in_direction = jnp.exp((b @ jnp.asarray(_directions(self.num_bearings)) - 1.0) / v**2)
        return _outer(near, in_direction, jnp.multiply), jnp.ones((features.shape[0], 1))

    lower = Mean.lower
    weights = Mean.weights


def _distance_and_bearing(features: Float[Array, "n dim"]) -> tuple[Float[Array, "n 1"], Float[Array, "n 2"]]:
    """Return the first feature and the next two; a bearing of [0, 0], as at distance 0, becomes [1, 0].

    Raises a `ValueError` if there are fewer than three features.
    """
    if features.shape[1] < 3:
        raise ValueError(f"features: must start with distance, cos and sin, got {features.shape[1]} features")
    distance, bearing = features[:, :1], features[:, 1:3]
    is_undefined = (bearing == 0).all(-1, keepdims=True)
    return distance, jnp.where(is_undefined, jnp.array([[1.0, 0.0]]), bearing)


def _outer(a: Shaped[Array, "n i"], b: Shaped[Array, "n j"], product: Callable) -> Shaped[Array, "n i_times_j"]:
    """Return the products of all pairs of a feature of `a` and a feature of `b`."""
    return product(a[:, :, None], b[:, None]).reshape(a.shape[0], a.shape[1] * b.shape[1])


def _directions(number: int) -> np.ndarray:
    """Return unit vectors [2, number], evenly spaced on the circle, the first along x."""
    angle = 2 * math.pi * np.arange(number) / number
    return np.stack([np.cos(angle), np.sin(angle)]).astype(np.float32)
