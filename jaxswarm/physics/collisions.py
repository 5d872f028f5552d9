"""Contacts of discs, squares and the walls of a square world.

The last axes are any number of environments: [..., *envs].
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxswarm.physics.contacts import (
    BOX_SIDE,
    DISC_RADIUS,
    Contact,
    Motion,
    Pose,
    Rows,
    Solver,
    ahead,
    of_other,
    of_own,
    total,
)
from jaxswarm.types import pytree

_HALF = BOX_SIDE / 2


def find_contacts(
    solver: Solver,
    side: Float[Array, "*envs"],
    disc: Pose,
    box: Pose,
    present: Float[Array, "boxes *envs"],
    stage: Callable,
) -> dict[str, Contact]:
    """Return all pairs that might touch, by kind, in solving order; `stage` calls the parts of the computation."""
    return {
        "box_wall": stage(partial(_box_wall, solver), box, present, side[None, None, None]),
        "box_box": stage(partial(_box_box, solver), stage(_facing, box), present),
        "disc_box": stage(partial(_disc_box, solver), disc, box, present),
        "disc_disc": stage(partial(_disc_disc, solver), disc),
    }


def hold_discs(solver: Solver, side: Float[Array, "*envs"], disc: Pose, motion: Motion) -> Motion:
    """Return the velocity of discs after the walls have stopped them."""

    def held(place: Array, velocity: Array) -> Array:
        gap = side[None] / 2 - (DISC_RADIUS + solver.offsets.disc_wall) - jnp.abs(place)
        bias = _bias(solver, gap, solver.recovery)
        return velocity - jnp.sign(place) * jnp.maximum(jnp.sign(place) * velocity - bias, 0)

    return Motion(held(disc.x, motion.x), held(disc.y, motion.y))


def no_impulses(disc: Float[Array, "discs *envs"], box: Float[Array, "boxes *envs"]) -> dict[str, Array]:
    """Return zeros for all contacts, computed from coordinates, so that environments can be spread over devices."""
    walls, points = np.zeros((1, 2, 1)), np.zeros((2, 1, 1))
    return {
        "disc_disc": 0 * ahead(disc),
        "disc_box": 0 * (of_own(disc) + of_other(box)),
        "box_box": 0 * ahead(box) + _table(points, box),
        "box_wall": 0 * of_own(box) + _table(points + walls, box),
    }


def _disc_disc(solver: Solver, disc: Pose) -> Contact:
    own, other = of_own(disc), ahead(disc)
    is_pair, is_first = _pairs(disc.x)
    x = own.x - other.x + 1e-9 * jnp.where(is_first, 1.0, -1.0)  # separates discs at the same place, too
    y = own.y - other.y
    squared = jnp.maximum(x**2 + y**2, 1e-18)
    inverse = jax.lax.rsqrt(squared)
    gap = squared * inverse - (2 * DISC_RADIUS + solver.offsets.disc_disc)
    near = (gap < solver.margin) * is_pair
    rows = Rows(x * inverse, y * inverse, None, None, near, own="disc", other="disc")
    return Contact(rows, gap, _bias(solver, gap, solver.recovery))


def _pairs(like: Float[Array, "bodies *envs"]) -> tuple[Array, Array]:
    """Return, in cyclic order, 1 for the first occurrence of a pair, and whether the own body comes first."""
    size = like.shape[0]
    row, own = np.indices((size // 2, size))
    is_repeated = (2 * (row + 1) == size) & (own >= size // 2)
    return _table(~is_repeated[None], like), _table((own + row + 1 < size)[None], like) > 0


def _table(values: np.ndarray, like: Array) -> Array:
    """Broadcast numbers of each pair to all environments of `like`, [bodies, *envs]."""
    return jnp.asarray(values.reshape(*values.shape, *[1] * (like.ndim - 1)), like.dtype)


def _bias(solver: Solver, gap: Array, recovery: float) -> Array:
    return jnp.where(gap > 0, gap, recovery * gap) * (1 / solver.duration)


def _disc_box(solver: Solver, disc: Pose, box: Pose, present: Array) -> Contact:
    """Return contacts of discs with the nearest point of boxes; a disc inside a box leaves by the nearest face."""
    box = of_other(box)
    dx, dy = of_own(disc.x) - box.x, of_own(disc.y) - box.y
    x, y = box.cos * dx + box.sin * dy, box.cos * dy - box.sin * dx
    out_x, out_y = jnp.abs(x) - _HALF, jnp.abs(y) - _HALF
    edge_x, edge_y = jnp.maximum(out_x, 0), jnp.maximum(out_y, 0)
    squared = jnp.maximum(edge_x**2 + edge_y**2, 1e-14)
    is_outside, by_x = squared > 1e-14, out_x > out_y
    inverse = jax.lax.rsqrt(squared)
    local_x = jnp.where(is_outside, edge_x * inverse, by_x) * jnp.where(x >= 0, 1, -1)
    local_y = jnp.where(is_outside, edge_y * inverse, ~by_x) * jnp.where(y >= 0, 1, -1)
    gap = jnp.where(is_outside, squared * inverse, jnp.maximum(out_x, out_y))
    gap = gap - (DISC_RADIUS + solver.offsets.disc_box)
    arm = jnp.clip(x, -_HALF, _HALF) * local_y - jnp.clip(y, -_HALF, _HALF) * local_x
    near = (gap < solver.margin) * of_other(present)
    normal = box.cos * local_x - box.sin * local_y, box.sin * local_x + box.cos * local_y
    rows = Rows(*normal, None, arm, near, own="disc", other="box")
    return Contact(rows, gap, _bias(solver, gap, solver.recovery))


@pytree
class _Facing:
    """The separating face of each pair of boxes, which belongs to the reference box, and the pose of the other box.

    In axes of the reference, u along the normal of that face and t along the face, the other box is at (u, t). Because
    the boxes are equal squares, its relative angle is reduced to at most 45 degrees in either direction.
    """

    is_own: Array  # the reference is the own box; like all others [1, row, own, *envs]
    x: Array  # the normal, from the reference to the other box, in world axes
    y: Array
    u: Array
    t: Array
    cos: Array
    sin: Array


def _facing(box: Pose) -> _Facing:
    """Choose as the reference the box from whose face the other box is farther away."""
    own, other = of_own(box), ahead(box)
    dx, dy = other.x - own.x, other.y - own.y

    def separation(pose: Pose) -> Array:
        return jnp.maximum(jnp.abs(pose.cos * dx + pose.sin * dy), jnp.abs(pose.cos * dy - pose.sin * dx))

    own_separation, other_separation = separation(own), separation(other)
    _, is_first = _pairs(box.x)
    is_own = (own_separation > other_separation) | ((own_separation == other_separation) & is_first)
    sign = jnp.where(is_own, 1.0, -1.0)
    cos, sin = jnp.where(is_own, own.cos, other.cos), jnp.where(is_own, own.sin, other.sin)
    x, y = sign * (cos * dx + sin * dy), sign * (cos * dy - sin * dx)
    by_x = jnp.abs(x) >= jnp.abs(y)
    side = jnp.where(jnp.where(by_x, x, y) >= 0, 1.0, -1.0)
    normal_x, normal_y = jnp.where(by_x, side, 0), jnp.where(by_x, 0, side)
    turn_cos = own.cos * other.cos + own.sin * other.sin
    turn_sin = sign * (own.cos * other.sin - own.sin * other.cos)
    is_small = jnp.abs(turn_cos) >= jnp.abs(turn_sin)
    return _Facing(
        is_own=is_own,
        x=cos * normal_x - sin * normal_y,
        y=sin * normal_x + cos * normal_y,
        u=jnp.where(by_x, jnp.abs(x), jnp.abs(y)),
        t=y * normal_x - x * normal_y,
        cos=jnp.where(is_small, jnp.abs(turn_cos), jnp.abs(turn_sin)),
        sin=jnp.where(is_small, turn_sin * jnp.sign(turn_cos), -turn_cos * jnp.sign(turn_sin)),
    )


def _box_box(solver: Solver, facing: _Facing, present: Array) -> Contact:
    """Return two points per pair: the facing edge of one box, clipped to the width of the other's face."""
    is_own, u, t = facing.is_own, facing.u, facing.t
    sign = jnp.where(is_own, 1.0, -1.0)
    edge_u, edge_t = u - _HALF * facing.cos, t - _HALF * facing.sin
    end = _table(np.array([-_HALF, _HALF])[:, None, None], present)
    point_t = jnp.clip(edge_t + end * facing.cos, -_HALF, _HALF)
    point_u = edge_u - (point_t - edge_t) * (facing.sin / facing.cos)
    gap = point_u - _HALF - solver.offsets.box_box
    is_pair, _ = _pairs(present)
    near = (gap < solver.margin) * is_pair * of_own(present) * ahead(present)
    own_t, other_t = (sign * jnp.where(x, point_t, point_t - t) for x in (is_own, ~is_own))
    normal = Rows(-sign * facing.x, -sign * facing.y, own_t, other_t, near, own="box", other="box")

    middle = _mean((point_u + _HALF) / 2, near)
    own_u, other_u = (sign * jnp.where(x, middle, middle - u) for x in (is_own, ~is_own))
    touching = jnp.minimum(total(near, 0), 1)[None]
    tangent = Rows(sign * facing.y, -sign * facing.x, -own_u, -other_u, touching, own="box", other="box")
    return Contact(normal, gap, _bias(solver, gap, 0.0), tangent, solver.box_friction)


def _mean(values: Array, near: Array) -> Array:
    """Average over the points of each pair that are in contact, which leaves one point."""
    return (total(values * near, 0) / jnp.maximum(total(near, 0), 1))[None]


def _box_wall(solver: Solver, box: Pose, present: Array, side: Array) -> Contact:
    """Return contacts of the two foremost corners of boxes with the nearer walls of x = +-side/2 and y = +-side/2."""
    is_x = _table(np.array([True, False])[None, :, None], box.x) > 0
    flip = _table(np.array([1, -1])[:, None, None], box.x)
    box = of_own(box)
    place = jnp.where(is_x, box.x, box.y)
    outward = jnp.where(place < 0, -1.0, 1.0)
    along_x, along_y = jnp.where(is_x, box.cos, box.sin), jnp.where(is_x, -box.sin, box.cos)  # the wall's normal
    is_front_x = jnp.abs(along_x) >= jnp.abs(along_y)  # the face in front is the box's x face; the corners differ in y
    corner_x = _HALF * _sign(outward * along_x) * jnp.where(is_front_x, 1, flip)
    corner_y = _HALF * _sign(outward * along_y) * jnp.where(is_front_x, flip, 1)
    arm_x, arm_y = box.cos * corner_x - box.sin * corner_y, box.sin * corner_x + box.cos * corner_y
    gap = side / 2 - solver.offsets.box_wall - outward * (place + jnp.where(is_x, arm_x, arm_y))
    near = (gap < solver.margin) * of_own(present)
    zero = jnp.zeros_like(gap)
    inward_x, inward_y = jnp.where(is_x, -outward, zero), jnp.where(is_x, zero, -outward)
    normal_arm = jnp.where(is_x, arm_y, -arm_x) * outward
    normal = Rows(inward_x, inward_y, normal_arm, None, near, own="box", other="wall")
    tangent_arm = _mean(jnp.where(is_x, arm_x, -arm_y), near)
    tangent_x, tangent_y = jnp.where(is_x, zero[:1], 1.0), jnp.where(is_x, 1.0, zero[:1])
    touching = jnp.minimum(total(near, 0), 1)[None]
    tangent = Rows(tangent_x, tangent_y, tangent_arm, None, touching, own="box", other="wall")
    return Contact(normal, gap, _bias(solver, gap, 0.0), tangent, solver.wall_friction)


def _sign(x: Array) -> Array:
    return jnp.where(x < 0, -1.0, 1.0)
