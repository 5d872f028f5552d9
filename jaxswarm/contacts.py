"""Which discs and boxes touch in a walled square, and the impulses that keep them apart.

Contacts of one kind form `Rows`, dense arrays over all pairs: to compute all pairs of a few bodies is cheaper than to
select those that touch. Worlds, any number of them, are the last axes: [..., *worlds].
"""

import dataclasses
import functools
import math
import operator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxswarm.types import is_whole, pytree, require, static

DURATION = 1.0  # s, of one step
DISC_RADIUS = 0.0165  # m
BOX_SIDE = 0.1  # m
MAX_SPEED = 0.01  # m / s, that a disc is told to drive
MAX_TURN_RATE = math.pi / 2  # rad / s

DISC_MASS = 1.0
BOX_MASS = BOX_SIDE**2 / (math.pi * DISC_RADIUS**2)  # of the same density
BOX_INERTIA = BOX_MASS * BOX_SIDE**2 / 6

TICK = 0.1  # s; drag acts, and motors reset the velocity of discs, once in this time
DRAG = 0.92  # share of a velocity that is left after a tick, whatever moves

_HALF = BOX_SIDE / 2
_CORNERS = _HALF * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]], np.float32)


class Offsets(NamedTuple):
    """Distances at which bodies rest, beyond touching, in metres; the defaults are those of Box2D 2.3."""

    disc_disc: float = -2e-4
    disc_box: float = 2e-4
    box_box: float = 6e-4
    disc_wall: float = 2e-4
    box_wall: float = 6e-4


BOX2D_OFFSETS = Offsets()


@dataclasses.dataclass(frozen=True)
class Solver:
    """How finely a step is solved; a step of 1 s has `substeps`."""

    substeps: int = 10
    iterations: int = 6
    relaxation: float = 1.5  # of impulses, in (0, 2); the last sweep has 1, which is exact for what one sweep can solve
    recovery: float = 0.3  # share of an overlap with a disc that is removed per substep, by its velocity
    box_recovery: float = 0.5  # share of an overlap without discs that is removed per substep, by displacement
    max_speed: float = MAX_SPEED  # m / s, of the fastest disc: how far ahead contacts are seen
    box_friction: float = 0.01  # coefficient between boxes; discs are frictionless
    wall_friction: float = 0.0447  # between boxes and walls
    offsets: Offsets = BOX2D_OFFSETS

    def __post_init__(self) -> None:
        require(self, "whole numbers from 1", is_whole(1), "substeps", "iterations")
        require(self, "numbers above 0 and below 2", lambda x: 0 < x < 2, "relaxation")
        require(self, "numbers above 0, up to 1", lambda x: 0 < x <= 1, "recovery", "box_recovery")
        require(self, "positive numbers", lambda x: x > 0, "max_speed")
        require(self, "numbers from 0", lambda x: x >= 0, "box_friction", "wall_friction")

    @property
    def duration(self) -> float:
        """Of a substep, in seconds."""
        return DURATION / self.substeps

    @property
    def drag(self) -> float:
        """Share of a velocity that is left after a substep."""
        return DRAG ** (self.duration / TICK)

    @property
    def disc_mass(self) -> float:
        """Motors act once a substep, not once a tick; this mass keeps the speed of pushing that of ticks."""
        return DISC_MASS * (1 - self.drag) / (1 - DRAG)

    @property
    def margin(self) -> float:
        """Gap in metres up to which a pair counts as being in contact."""
        return 2 * self.max_speed * self.duration


@pytree
class Motion:
    """Velocities, or displacements, of the bodies of one kind; discs do not turn by being pushed."""

    x: Float[Array, "bodies *worlds"]
    y: Float[Array, "bodies *worlds"]
    turn: Float[Array, "bodies *worlds"] | None = None


Motions = dict[str, Motion]  # "disc", "box"


@pytree
class Pose:
    """Of discs or boxes, `cos` and `sin` those of their headings."""

    x: Float[Array, "bodies *worlds"]
    y: Float[Array, "bodies *worlds"]
    cos: Float[Array, "bodies *worlds"]
    sin: Float[Array, "bodies *worlds"]


@pytree
class Rows:
    """Directions in which pairs of bodies push each other, at some points each; walls are bodies that do not move.

    `x, y` is the unit vector along which the own body is pushed; an arm is the torque of a unit force. `is_mutual` rows
    list each pair once, and push the other body, too; else each pair is there twice, or the other is a wall.
    """

    x: Float[Array, "points other own *worlds"]
    y: Float[Array, "points other own *worlds"]
    own_arm: Float[Array, "points other own *worlds"] | None
    other_arm: Float[Array, "points other own *worlds"] | None
    near: Float[Array, "points other own *worlds"]  # 1 in contact, else 0
    own: str = static()
    other: str = static()
    is_mutual: bool = static(default=False)
    mass: Float[Array, "points other own *worlds"] | None = None  # effective mass in contact, else 0; see `weighted`

    def weighted(self, solver: Solver) -> "Rows":
        """With masses 1 / (n_a (1 / m_a + arm_a^2 / I_a) + n_b (...)), n the number of contacts of a body."""

        def mobility(kind: str, arm: Array | None) -> Array | float:
            linear, angular = _inverse_mass(kind, solver)
            return linear if arm is None else linear + angular * arm**2

        total = _own(jnp.maximum(_sum(self.near, 1), 1)) * mobility(self.own, self.own_arm)
        if self.other != "wall":
            total = total + _other(jnp.maximum(_sum(self.near, 2), 1)) * mobility(self.other, self.other_arm)
        return self.replace(mass=self.near / total)

    def velocity(self, motions: Motions) -> Float[Array, "points other own *worlds"]:
        """At which pairs separate."""
        result = _along(self.x, self.y, self.own_arm, _own(motions[self.own]))
        if self.other != "wall":
            result = result - _along(self.x, self.y, self.other_arm, _other(motions[self.other]))
        return result

    def push(self, motions: Motions, impulse: Float[Array, "points other own *worlds"], solver: Solver) -> Motions:
        """The motions after these impulses."""
        x, y = impulse * self.x, impulse * self.y
        kicked = {self.own: _kick(motions[self.own], self.own, x, y, _times(impulse, self.own_arm), 1, solver)}
        if self.is_mutual:
            torque = _times(-impulse, self.other_arm)
            kicked[self.other] = _kick(motions[self.other], self.other, -x, -y, torque, 2, solver)
        return motions | kicked


def _own(bodies: Any) -> Any:
    """Arrays [bodies, *worlds] as those of the own body of each pair."""
    return jax.tree.map(lambda v: v[None, None], bodies)


def _other(bodies: Any) -> Any:
    """Arrays [bodies, *worlds] as those of the other body of each pair."""
    return jax.tree.map(lambda v: v[None, :, None], bodies)


def _times(impulse: Array, arm: Array | None) -> Array | None:
    return None if arm is None else impulse * arm


def _along(x: Array, y: Array, arm: Array | None, motion: Motion) -> Array:
    """Velocity of the points of contact along a direction."""
    result = x * motion.x + y * motion.y
    return result if arm is None else result + arm * motion.turn


def _inverse_mass(kind: str, solver: Solver) -> tuple[float, float]:
    return (1 / solver.disc_mass, 0.0) if kind == "disc" else (1 / BOX_MASS, 1 / BOX_INERTIA)


def _kick(motion: Motion, kind: str, x: Array, y: Array, torque: Array | None, axis: int, solver: Solver) -> Motion:
    linear, angular = _inverse_mass(kind, solver)
    turn = None if torque is None else motion.turn + angular * _sum(torque, axis)
    return Motion(motion.x + linear * _sum(x, axis), motion.y + linear * _sum(y, axis), turn)


def _sum(rows: Float[Array, "points other own *worlds"], axis: int) -> Float[Array, "bodies *worlds"]:
    """Over all points and, with axis 1, all others of each body, or with axis 2, all own ones.

    XLA on a CPU does not vectorise loops over a few leading rows; written out they take a third of the time.
    """
    num_points, num_rows = rows.shape[0], rows.shape[axis]
    if not 0 < num_points * num_rows <= 16:
        return rows.sum((0, axis))
    terms = [
        jax.lax.index_in_dim(rows[point], row, axis - 1, False)
        for point in range(num_points)
        for row in range(num_rows)
    ]
    return functools.reduce(operator.add, terms)


@pytree
class Contact:
    """All pairs of one kind.

    The impulse of each point is at least 0; friction acts once for all points of a pair.
    """

    normal: Rows
    gap: Float[Array, "points other own *worlds"]  # in metres, negative where bodies overlap
    bias: Float[Array, "points other own *worlds"]  # m / s, by which a pair may close; negative where it has to part
    tangent: Rows | None = None
    friction: float = static(default=0.0)

    def weighted(self, solver: Solver) -> "Contact":
        """With effective masses."""
        tangent = None if self.tangent is None else self.tangent.weighted(solver)
        return self.replace(normal=self.normal.weighted(solver), tangent=tangent)

    def answer(
        self, relaxation: Array, motions: Motions, impulse: Array, slip: Array | None
    ) -> tuple[tuple[Array, Array | None], tuple[Array, Array | None]]:
        """Impulses of all pairs and of their friction that answer these motions, and by how much they changed."""
        error = self.normal.mass * (self.normal.velocity(motions) + self.bias)
        after = jnp.maximum(impulse - relaxation * error, 0)
        if self.tangent is None or slip is None:
            return (after, None), (after - impulse, None)
        limit = self.friction * after.sum(0, keepdims=True)
        slip_after = jnp.clip(slip - self.tangent.mass * self.tangent.velocity(motions), -limit, limit)
        return (after, slip_after), (after - impulse, slip_after - slip)

    def push(self, solver: Solver, motions: Motions, impulse: Array, slip: Array | None) -> Motions:
        """The motions after these impulses."""
        motions = self.normal.push(motions, impulse, solver)
        return motions if self.tangent is None else self.tangent.push(motions, slip, solver)


def _disc_disc(solver: Solver, disc: Pose) -> Contact:
    index = np.arange(disc.x.shape[0])
    order = _table(np.sign(index - index[:, None])[None], disc.x)
    x = _own(disc.x) - _other(disc.x) + 1e-9 * order  # discs at one place part, too
    y = _own(disc.y) - _other(disc.y)
    squared = jnp.maximum(x**2 + y**2, 1e-18)
    inverse = jax.lax.rsqrt(squared)
    gap = squared * inverse - (2 * DISC_RADIUS + solver.offsets.disc_disc)
    near = (gap < solver.margin) * jnp.abs(order)
    rows = Rows(x * inverse, y * inverse, None, None, near, own="disc", other="disc")
    return Contact(rows, gap, _bias(solver, gap, solver.recovery))


def _table(values: np.ndarray, like: Array) -> Array:
    """Numbers for each pair of bodies in all worlds, those of `like`, [bodies, *worlds]."""
    return jnp.asarray(values.reshape(*values.shape, *[1] * (like.ndim - 1)), jnp.float32)


def _bias(solver: Solver, gap: Array, recovery: float) -> Array:
    return jnp.where(gap > 0, gap, recovery * gap) * (1 / solver.duration)


def _disc_box(solver: Solver, disc: Pose, box: Pose, present: Array) -> Contact:
    """Discs touch the nearest point of a box; one whose centre is inside leaves by the nearest face."""
    box = _other(box)
    dx, dy = _own(disc.x) - box.x, _own(disc.y) - box.y
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
    near = (gap < solver.margin) * _other(present)
    normal = box.cos * local_x - box.sin * local_y, box.sin * local_x + box.cos * local_y
    rows = Rows(*normal, None, arm, near, own="disc", other="box", is_mutual=True)
    return Contact(rows, gap, _bias(solver, gap, solver.recovery))


def _box_box(solver: Solver, box: Pose, present: Array) -> Contact:
    """Two points for each pair: the facing edge of one box, clipped to the width of the face of the other.

    The separating axis is that of the box, then called the reference, from whose face the other is farther. In its
    axes, u along the normal of that face and t along the face, the other box is at (u, t), turned by an angle that
    equal squares allow to reduce to a turn of at most 45 degrees either way.
    """
    index = np.arange(box.x.shape[0])
    is_first = _table(index[None] < index[:, None], box.x)[None] > 0
    own, other = _own(box), _other(box)
    dx, dy = other.x - own.x, other.y - own.y

    def separation(pose: Pose) -> Array:
        return jnp.maximum(jnp.abs(pose.cos * dx + pose.sin * dy), jnp.abs(pose.cos * dy - pose.sin * dx))

    own_separation, other_separation = separation(own), separation(other)
    is_own = (own_separation > other_separation) | ((own_separation == other_separation) & is_first)
    sign = jnp.where(is_own, 1.0, -1.0)
    face_x, face_y, u, t, turn_cos, turn_sin = _facing(own, other, dx, dy, is_own)
    edge_u, edge_t = u - _HALF * turn_cos, t - _HALF * turn_sin
    end = _table(np.array([-_HALF, _HALF])[:, None, None], box.x)
    point_t = jnp.clip(edge_t + end * turn_cos, -_HALF, _HALF)
    point_u = edge_u - (point_t - edge_t) * (turn_sin / turn_cos)
    gap = point_u - _HALF - solver.offsets.box_box
    is_pair = _table(1 - np.eye(len(index))[None], box.x) * _own(present) * _other(present)
    near = (gap < solver.margin) * is_pair
    own_t, other_t = (sign * jnp.where(x, point_t, point_t - t) for x in (is_own, ~is_own))
    normal = Rows(-sign * face_x, -sign * face_y, own_t, other_t, near, own="box", other="box")

    middle = _mean((point_u + _HALF) / 2, near)
    own_u, other_u = (sign * jnp.where(x, middle, middle - u) for x in (is_own, ~is_own))
    touching = near.max(0, keepdims=True)
    tangent = Rows(sign * face_y, -sign * face_x, -own_u, -other_u, touching, own="box", other="box")
    return Contact(normal, gap, _bias(solver, gap, 0.0), tangent, solver.box_friction)


def _mean(values: Array, near: Array) -> Array:
    """Over the points of each pair that are in contact, with one point left."""
    return (values * near).sum(0, keepdims=True) / jnp.maximum(near.sum(0, keepdims=True), 1)


def _facing(own: Pose, other: Pose, dx: Array, dy: Array, is_own: Array) -> tuple[Array, ...]:
    """The normal of the reference's face, in world axes; in its own, where the other box is: u, t, cos, sin."""
    sign = jnp.where(is_own, 1.0, -1.0)
    cos, sin = jnp.where(is_own, own.cos, other.cos), jnp.where(is_own, own.sin, other.sin)
    x, y = sign * (cos * dx + sin * dy), sign * (cos * dy - sin * dx)
    by_x = jnp.abs(x) >= jnp.abs(y)
    side = jnp.where(jnp.where(by_x, x, y) >= 0, 1.0, -1.0)
    normal_x, normal_y = jnp.where(by_x, side, 0), jnp.where(by_x, 0, side)
    u, t = jnp.where(by_x, jnp.abs(x), jnp.abs(y)), y * normal_x - x * normal_y
    turn_cos = own.cos * other.cos + own.sin * other.sin
    turn_sin = sign * (own.cos * other.sin - own.sin * other.cos)
    is_small = jnp.abs(turn_cos) >= jnp.abs(turn_sin)
    reduced_cos = jnp.where(is_small, jnp.abs(turn_cos), jnp.abs(turn_sin))
    reduced_sin = jnp.where(is_small, turn_sin * jnp.sign(turn_cos), -turn_cos * jnp.sign(turn_sin))
    return cos * normal_x - sin * normal_y, sin * normal_x + cos * normal_y, u, t, reduced_cos, reduced_sin


def _box_wall(solver: Solver, box: Pose, present: Array, side: Array) -> Contact:
    """The two foremost corners of boxes against the nearer of the walls x = +-side/2, and of y = +-side/2."""
    is_x = _table(np.array([True, False])[None, :, None], box.x) > 0
    flip = _table(np.array([1, -1])[:, None, None], box.x)
    box = _own(box)
    place = jnp.where(is_x, box.x, box.y)
    outward = jnp.where(place < 0, -1.0, 1.0)
    along_x, along_y = jnp.where(is_x, box.cos, box.sin), jnp.where(is_x, -box.sin, box.cos)  # the wall's normal
    corner_x, corner_y = _HALF * _sign(outward * along_x), _HALF * _sign(outward * along_y)
    is_front_x = jnp.abs(along_x) >= jnp.abs(along_y)  # the face in front is the box's x face; the corners differ in y
    corner_x, corner_y = (
        jnp.where(is_front_x, corner_x, flip * corner_x),
        jnp.where(is_front_x, flip * corner_y, corner_y),
    )
    arm_x, arm_y = box.cos * corner_x - box.sin * corner_y, box.sin * corner_x + box.cos * corner_y
    gap = side / 2 - solver.offsets.box_wall - outward * (place + jnp.where(is_x, arm_x, arm_y))
    near = (gap < solver.margin) * _own(present)
    zero = jnp.zeros_like(gap)
    inward_x, inward_y = jnp.where(is_x, -outward, zero), jnp.where(is_x, zero, -outward)
    normal_arm = jnp.where(is_x, arm_y, -arm_x) * outward
    normal = Rows(inward_x, inward_y, normal_arm, None, near, own="box", other="wall")
    tangent_arm = _mean(jnp.where(is_x, arm_x, -arm_y), near)
    tangent_x, tangent_y = jnp.where(is_x, zero[:1], 1.0), jnp.where(is_x, 1.0, zero[:1])
    touching = near.max(0, keepdims=True)
    tangent = Rows(tangent_x, tangent_y, tangent_arm, None, touching, own="box", other="wall")
    return Contact(normal, gap, _bias(solver, gap, 0.0), tangent, solver.wall_friction)


def _sign(x: Array) -> Array:
    return jnp.where(x < 0, -1.0, 1.0)


def find_contacts(
    solver: Solver,
    side: Float[Array, "*worlds"],
    disc: Pose,
    box: Pose,
    present: Float[Array, "boxes *worlds"],
) -> dict[str, Contact]:
    """All pairs that might touch, by kind, in the order in which they are solved."""
    return {
        "box_wall": _box_wall(solver, box, present, side[None, None, None]),
        "box_box": _box_box(solver, box, present),
        "disc_box": _disc_box(solver, disc, box, present),
        "disc_disc": _disc_disc(solver, disc),
    }


def no_impulses(disc: Float[Array, "discs *worlds"], box: Float[Array, "boxes *worlds"]) -> dict[str, Array]:
    """Zeros for all contacts; made of coordinates of bodies, so that worlds may be spread over devices."""
    walls, points = np.zeros((1, 2, 1)), np.zeros((2, 1, 1))
    return {
        "disc_disc": 0 * (_own(disc) + _other(disc)),
        "disc_box": 0 * (_own(disc) + _other(box)),
        "box_box": 0 * (_own(box) + _other(box)) + _table(points, box),
        "box_wall": 0 * _own(box) + _table(points + walls, box),
    }


def weigh_contacts(solver: Solver, contacts: dict[str, Contact]) -> dict[str, Contact]:
    """The same, with effective masses."""
    return {kind: contact.weighted(solver) for kind, contact in contacts.items()}


def hold_discs(solver: Solver, side: Float[Array, "*worlds"], disc: Pose, motion: Motion) -> Motion:
    """The velocity of discs that walls leave them."""

    def held(place: Array, velocity: Array) -> Array:
        gap = side[None] / 2 - (DISC_RADIUS + solver.offsets.disc_wall) - jnp.abs(place)
        bias = _bias(solver, gap, solver.recovery)
        return velocity - jnp.sign(place) * jnp.maximum(jnp.sign(place) * velocity - bias, 0)

    return Motion(held(disc.x, motion.x), held(disc.y, motion.y))
