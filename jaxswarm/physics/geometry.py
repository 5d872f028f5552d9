"""The two spaces that points move in, and bearings without inverse trigonometry."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxswarm.types import pytree


@pytree
class Plane:
    """A square with walls; both coordinates in [0, side]."""

    side: float

    def displacement(self, a: Float[Array, "*#n 2"], b: Float[Array, "*#n 2"]) -> Float[Array, "*n 2"]:
        """Vector from `a` to `b`."""
        return b - a

    def confine(self, position: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
        """The nearest point inside the walls."""
        return jnp.clip(position, 0, self.side)

    def slide(self, position: Float[Array, "*n 2"], path: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
        """As much of a path, a vector from `position`, as the walls allow."""
        return jnp.clip(path, -position, self.side - position)


@pytree
class Torus:
    """A square whose opposite sides are glued; both coordinates in [0, side], where 0 and side are one place."""

    side: float

    def displacement(self, a: Float[Array, "*#n 2"], b: Float[Array, "*#n 2"]) -> Float[Array, "*n 2"]:
        """Shortest vector from `a` to `b`; half a world apart, the one that does not cross the seam."""
        across = b - a
        return across - self.side * jnp.round(across / self.side)

    def confine(self, position: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
        """The same place in the square."""
        is_inside = (position >= 0) & (position <= self.side)
        return jnp.where(is_inside, position, position - self.side * jnp.floor(position / self.side))

    def slide(self, position: Float[Array, "*n 2"], path: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
        """The whole path: nothing is in its way."""
        return path


Space = Plane | Torus


def norm(vector: Float[Array, "*n 2"]) -> Float[Array, "*n"]:
    """Length of a vector; below 1e-15, where its gradient would soon overflow, it is 0 and so is the gradient."""
    squared = vector[..., 0] ** 2 + vector[..., 1] ** 2
    is_long = squared > 1e-30
    return jnp.where(is_long, jnp.sqrt(jnp.where(is_long, squared, 1)), 0)


def unit(vector: Float[Array, "*n 2"], length: Float[Array, "*n"]) -> Float[Array, "*n 2"]:
    """The vector over its `norm`; short of 1e-15 the vector itself."""
    return vector / jnp.where(length > 0, length, 1)[..., None]


def unit_vector(vector: Float[Array, "*n 2"], length: Float[Array, "*n"]) -> Float[Array, "*n 2"]:
    """The vector over its `norm`; short of 1e-15 [1, 0], the direction of atan2(0, 0)."""
    is_long = length > 0
    along_x = jnp.where(is_long, vector[..., 0], 1)
    return jnp.stack([along_x, vector[..., 1]], -1) / jnp.where(is_long, length, 1)[..., None]


def direction(heading: Float[Array, "*n"]) -> Float[Array, "*n 2"]:
    """Unit vector [cos, sin] of an angle in rad, counter-clockwise from x."""
    return jnp.stack([jnp.cos(heading), jnp.sin(heading)], -1)


def bearing(ahead: Float[Array, "*#n 2"], toward: Float[Array, "*#n 2"]) -> Float[Array, "*n 2"]:
    """[cos, sin] of the angle, clockwise, from the unit vector `ahead` to the unit vector `toward`.

    A positive sine means "to my right".
    """
    cos = ahead[..., 0] * toward[..., 0] + ahead[..., 1] * toward[..., 1]
    sin = ahead[..., 1] * toward[..., 0] - ahead[..., 0] * toward[..., 1]
    return jnp.stack([cos, sin], -1)
