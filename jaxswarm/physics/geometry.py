"""Bounded and periodic squares in which points move, and bearings without inverse trigonometry."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxswarm.types import pytree


@pytree
class Plane:
    """A square with walls, with both coordinates in [0, side]."""

    side: float  # world units

    def displacement(self, a: Float[Array, "*#n 2"], b: Float[Array, "*#n 2"]) -> Float[Array, "*n 2"]:
        """Return the vector from `a` to `b`, in world units."""
        return b - a

    def confine(self, position: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
        """Return the nearest point inside the walls."""
        return jnp.clip(position, 0, self.side)

    def slide(self, position: Float[Array, "*n 2"], path: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
        """Clip the vector `path`, which starts at `position`, so that it ends inside the walls."""
        return jnp.clip(path, -position, self.side - position)


@pytree
class Torus:
    """A square whose opposite sides are connected.

    Both coordinates are in [0, side]; 0 and `side` are the same place.
    """

    side: float  # world units

    def displacement(self, a: Float[Array, "*#n 2"], b: Float[Array, "*#n 2"]) -> Float[Array, "*n 2"]:
        """Return the shortest vector from `a` to `b`, in world units.

        At a distance of exactly half a side two vectors are shortest; the result then does not cross the seam.
        """
        across = b - a
        return across - self.side * jnp.round(across / self.side)

    def confine(self, position: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
        """Return the same place with coordinates in [0, side]."""
        is_inside = (position >= 0) & (position <= self.side)
        return jnp.where(is_inside, position, position - self.side * jnp.floor(position / self.side))

    def slide(self, position: Float[Array, "*n 2"], path: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
        """Return `path` unchanged, because a torus has no walls."""
        return path


Space = Plane | Torus


def norm(vector: Float[Array, "*n 2"]) -> Float[Array, "*n"]:
    """Return the length of a vector.

    Lengths below 1e-15 and their gradients are 0, because the gradient would overflow near 0.
    """
    squared = vector[..., 0] ** 2 + vector[..., 1] ** 2
    is_long = squared > 1e-30
    return jnp.where(is_long, jnp.sqrt(jnp.where(is_long, squared, 1)), 0)


def unit(vector: Float[Array, "*n 2"], length: Float[Array, "*n"]) -> Float[Array, "*n 2"]:
    """Return the vector divided by `length`, its `norm`; a vector shorter than 1e-15 is returned unchanged."""
    return vector / jnp.where(length > 0, length, 1)[..., None]


def unit_vector(vector: Float[Array, "*n 2"], length: Float[Array, "*n"]) -> Float[Array, "*n 2"]:
    """Return the vector divided by `length`, its `norm`.

    A vector shorter than 1e-15 becomes [1, 0], the direction of atan2(0, 0).
    """
    is_long = length > 0
    along_x = jnp.where(is_long, vector[..., 0], 1)
    return jnp.stack([along_x, vector[..., 1]], -1) / jnp.where(is_long, length, 1)[..., None]


def direction(heading: Float[Array, "*n"]) -> Float[Array, "*n 2"]:
    """Return the unit vector [cos, sin] of an angle in rad, counter-clockwise from x."""
    return jnp.stack([jnp.cos(heading), jnp.sin(heading)], -1)


def bearing(forward: Float[Array, "*#n 2"], toward: Float[Array, "*#n 2"]) -> Float[Array, "*n 2"]:
    """Return [cos, sin] of the clockwise angle from the unit vector `forward` to the unit vector `toward`.

    The sine is positive for directions to the right of `forward`.
    """
    cos = forward[..., 0] * toward[..., 0] + forward[..., 1] * toward[..., 1]
    sin = forward[..., 1] * toward[..., 0] - forward[..., 0] * toward[..., 1]
    return jnp.stack([cos, sin], -1)
