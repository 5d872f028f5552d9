"""Aggregators of what is known of each entity as it is, without an encoder."""

import math
from collections.abc import Callable
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float, Int, Shaped

from jaxswarm import checks
from jaxswarm.aggregators import sets
from jaxswarm.aggregators.monoids import Mean
from jaxswarm.aggregators.sets import DenseView
from jaxswarm.checks import require


class Concat(nn.Module):
    """The features of the nearest entities one after the other, the nearest first, zeros where there are fewer.

    The baseline without an aggregate: its size grows with the group. The first feature is the distance; of equally
    distant entities the later features decide.
    """

    max_entities: int = 10

    num_parts: ClassVar[int] = 1
    num_encoders: ClassVar[int] = 0

    def __post_init__(self) -> None:
        require(self, checks.integer(1), "max_entities")
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
        return sets.shares((is_taken & view.mask)[..., None], view.mask)

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
        require(self, checks.integer(1), "num_distances")
        require(self, checks.integer(3), "num_bearings")
        require(self, checks.POSITIVE, "max_distance")
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
        require(self, checks.integer(2), "num_distances", "num_bearings")
        require(self, checks.POSITIVE, "max_distance", "distance_width", "bearing_width")
        super().__post_init__()

    __call__ = sets.aggregate  # pyright: ignore[reportAssignmentType]

    def lift(self, features: Float[Array, "n dim"]) -> tuple[Array, Array]:
        """Values of all basis functions, and count."""
        d, b = _distance_and_bearing(features)
        spacing = self.max_distance / (self.num_distances - 1)
        centers = jnp.linspace(0.0, self.max_distance, self.num_distances)
        near = jnp.exp(-0.5 * jnp.square((d - centers[None]) / (self.distance_width * spacing)))
        v = self.bearing_width * 2 * math.pi / self.num_bearings
        ahead = jnp.exp((b @ jnp.asarray(_directions(self.num_bearings)) - 1.0) / v**2)
        return _outer(near, ahead, jnp.multiply), jnp.ones((features.shape[0], 1))

    lower = Mean.lower
    weights = Mean.weights


def _distance_and_bearing(features: Float[Array, "n dim"]) -> tuple[Float[Array, "n 1"], Float[Array, "n 2"]]:
    """An entity at distance 0, whose bearing may be given as [0, 0], is ahead."""
    if features.shape[1] < 3:
        raise ValueError(f"features: must start with distance, cos and sin, got {features.shape[1]} features")
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
