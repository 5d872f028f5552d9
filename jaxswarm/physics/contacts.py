"""Impulses that keep discs, boxes and walls apart, for given contacts.

Contacts of one kind form `Rows`, dense arrays over all pairs, because computing all pairs of a few bodies is cheaper
than selecting those that touch. The last axes are any number of environments: [..., *envs].

Bodies of two kinds form a table with a row for each other body. Bodies of one kind are in cyclic order, and row k pairs
each body with the one k + 1 places ahead. Half a table then holds every pair once, except that the last row for an even
number of bodies holds each pair twice.
"""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxswarm import checks
from jaxswarm.checks import require
from jaxswarm.types import pytree, static

DURATION = 1.0  # s, of one step
DISC_RADIUS = 0.0165  # m
BOX_SIDE = 0.1  # m
MAX_SPEED = 0.01  # m / s, commanded speed of a disc
MAX_TURN_RATE = math.pi / 2  # rad / s

DISC_MASS = 1.0
BOX_MASS = BOX_SIDE**2 / (math.pi * DISC_RADIUS**2)  # of the same density
BOX_INERTIA = BOX_MASS * BOX_SIDE**2 / 6

TICK = 0.1  # s; drag acts, and motors reset the velocity of discs, once in this time
DRAG = 0.92  # share of a velocity that remains after a tick, for all bodies


class Offsets(NamedTuple):
    """Distances beyond touching at which bodies rest, in meters; the defaults are those of Box2D 2.3."""

    disc_disc: float = -2e-4
    disc_box: float = 2e-4
    box_box: float = 6e-4
    disc_wall: float = 2e-4
    box_wall: float = 6e-4


BOX2D_OFFSETS = Offsets()


@dataclasses.dataclass(frozen=True)
class Solver:
    """Settings of the contact solver; a step of 1 s has `substeps` substeps."""

    substeps: int = 10
    iterations: int = 4  # sweeps per substep; each solves contacts between discs twice
    relaxation: float = 1.5  # of impulses, in (0, 2); the last sweep uses 1, which is exact if one sweep suffices
    recovery: float = 0.3  # share of an overlap with a disc that its velocity removes per substep
    box_recovery: float = 0.5  # share of an overlap without discs that displacement removes per substep
    max_speed: float = MAX_SPEED  # m / s, of the fastest disc; it determines how early contacts are found
    box_friction: float = 0.01  # coefficient between boxes; discs are frictionless
    wall_friction: float = 0.0447  # between boxes and walls
    offsets: Offsets = BOX2D_OFFSETS
    max_overlap: float = 1e-3  # m; a substep that would deepen an overlap beyond it takes further rounds of sweeps
    rounds: int = 12  # most rounds of `iterations` sweeps per substep

    def __post_init__(self) -> None:
        require(self, checks.integer(1), "substeps", "iterations", "rounds")
        require(self, checks.Check("a number above 0 and below 2", lambda x: 0 < x < 2), "relaxation")
        require(self, checks.Check("a number above 0, up to 1", lambda x: 0 < x <= 1), "recovery", "box_recovery")
        require(self, checks.POSITIVE, "max_speed", "max_overlap")
        require(self, checks.NOT_NEGATIVE, "box_friction", "wall_friction")

    @property
    def duration(self) -> float:
        """Duration of a substep, in seconds."""
        return DURATION / self.substeps

    @property
    def drag(self) -> float:
        """Share of a velocity that remains after a substep."""
        return DRAG ** (self.duration / TICK)

    @property
    def disc_mass(self) -> float:
        """Mass of a disc, corrected so that motors that act per substep push as fast as motors that act per tick."""
        return DISC_MASS * (1 - self.drag) / (1 - DRAG)

    @property
    def margin(self) -> float:
        """Gap in meters up to which a pair is in contact."""
        return 2 * self.max_speed * self.duration


@pytree
class Motion:
    """Velocities, or displacements, of the bodies of one kind; pushing does not turn discs."""

    x: Float[Array, "bodies *envs"]
    y: Float[Array, "bodies *envs"]
    turn: Any = None  # like x and y, or None


Motions = dict[str, Motion]  # "disc", "box"


@pytree
class Pose:
    """Positions of discs or boxes, with the `cos` and `sin` of their headings."""

    x: Float[Array, "bodies *envs"]
    y: Float[Array, "bodies *envs"]
    cos: Float[Array, "bodies *envs"]
    sin: Float[Array, "bodies *envs"]


@pytree
class Rows:
    """Directions in which pairs of bodies push each other, at one or more points; walls are bodies that do not move.

    `x, y` is the unit vector along which the own body is pushed. An arm is the torque of a unit force.
    """

    x: Float[Array, "points row own *envs"]
    y: Float[Array, "points row own *envs"]
    own_arm: Float[Array, "points row own *envs"] | None
    other_arm: Float[Array, "points row own *envs"] | None
    near: Float[Array, "points row own *envs"]  # 1 in contact, else 0
    own: str = static()
    other: str = static()
    mass: Any = None  # once `weighted`: effective mass in contact, else 0; like the others

    def counts(self) -> dict[str, Float[Array, "bodies *envs"]]:
        """Return the number of contacts of each body, at least 1."""
        near = total(self.near, 0)
        count = {self.own: total(near, 0)}
        if self.other != "wall":
            count[self.other] = self._by_other(near) + count.get(self.other, 0.0)
        return {kind: jnp.maximum(number, 1) for kind, number in count.items()}

    def masses(
        self, solver: Solver, counts: dict[str, Float[Array, "bodies *envs"]]
    ) -> Float[Array, "points row own *envs"]:
        """Return 1 / (n_a (1 / m_a + arm_a^2 / I_a) + n_b (...)) with n contacts per body; 0 without contact."""

        def mobility(kind: str, arm: Array | None) -> Array | float:
            linear, angular = _inverse_mass(kind, solver)
            return linear if arm is None else linear + angular * arm**2

        inverse = of_own(counts[self.own]) * mobility(self.own, self.own_arm)
        if self.other != "wall":
            inverse = inverse + self._of_other(counts[self.other]) * mobility(self.other, self.other_arm)
        return self.near / inverse

    def velocity(self, motions: Motions) -> Float[Array, "points row own *envs"]:
        """Return the velocity at which each pair separates."""
        result = _along(self.x, self.y, self.own_arm, of_own(motions[self.own]))
        if self.other != "wall":
            result = result - _along(self.x, self.y, self.other_arm, self._of_other(motions[self.other]))
        return result

    def force(self, impulse: Float[Array, "points row own *envs"]) -> "Force":
        """Return the change of the separation velocities by these impulses."""

        def torque(arm: Array | None) -> Array | None:
            return None if arm is None else total(impulse * arm, 0)

        x, y = total(impulse * self.x, 0), total(impulse * self.y, 0)
        return Force(x, y, torque(self.own_arm), torque(self.other_arm))

    def push(self, solver: Solver, motions: Motions, force: "Force") -> Motions:
        """Return the motions after these impulses."""

        def kick(kind: str, torque: Array | None, sign: int, by_body: Callable[[Array], Array]) -> Motion:
            motion, (linear, angular) = motions[kind], _inverse_mass(kind, solver)
            turn = None if torque is None else motion.turn + sign * angular * by_body(torque)
            return Motion(
                motion.x + sign * linear * by_body(force.x), motion.y + sign * linear * by_body(force.y), turn
            )

        motions = motions | {self.own: kick(self.own, force.own_torque, 1, lambda rows: total(rows, 0))}
        if self.other != "wall":
            motions = motions | {self.other: kick(self.other, force.other_torque, -1, self._by_other)}
        return motions

    def _of_other(self, bodies: Any) -> Any:
        return ahead(bodies) if self.own == self.other else of_other(bodies)

    def _by_other(self, rows: Float[Array, "row own *envs"]) -> Float[Array, "other *envs"]:
        return total(_behind(rows), 0) if self.own == self.other else total(rows, 1)


class Force(NamedTuple):
    """Return the impulses of pairs, summed over their points."""

    x: Float[Array, "row own *envs"]
    y: Float[Array, "row own *envs"]
    own_torque: Float[Array, "row own *envs"] | None
    other_torque: Float[Array, "row own *envs"] | None


def of_own(bodies: Any) -> Any:
    """Return arrays [bodies, *envs] for the own body of each pair."""
    return jax.tree.map(lambda v: v[None, None], bodies)


def of_other(bodies: Any) -> Any:
    """Return arrays [bodies, *envs] for the other body of each pair."""
    return jax.tree.map(lambda v: v[None, :, None], bodies)


def ahead(bodies: Any) -> Any:
    """Return arrays [bodies, *envs] for the other body of each pair, with the bodies in cyclic order."""

    def shifted(v: Array) -> Array:
        size, num_rows = v.shape[0], v.shape[0] // 2
        laps = jnp.broadcast_to(v, (num_rows + 2, *v.shape)).reshape(-1, *v.shape[1:])  # row k begins at k + 1
        return laps[1 : 1 + num_rows * (size + 1)].reshape(1, num_rows, size + 1, *v.shape[1:])[:, :, :size]

    return jax.tree.map(shifted, bodies)


def _behind(rows: Float[Array, "row own *envs"]) -> Float[Array, "row other *envs"]:
    """Return values of the pairs in cyclic order, by their other body."""
    row, other = np.indices(rows.shape[:2])
    own = (other - row - 1) % rows.shape[1]
    return rows.reshape(-1, *rows.shape[2:]).at[row * rows.shape[1] + own].get(mode="promise_in_bounds")


def _along(x: Array, y: Array, arm: Array | None, motion: Motion) -> Array:
    """Return the velocity of the contact points along a direction."""
    result = x * motion.x + y * motion.y
    return result if arm is None else result + arm * motion.turn


def _inverse_mass(kind: str, solver: Solver) -> tuple[float, float]:
    return (1 / solver.disc_mass, 0.0) if kind == "disc" else (1 / BOX_MASS, 1 / BOX_INERTIA)


def total(rows: Array, axis: int) -> Array:
    """Return the sum over an axis.

    XLA on a CPU does not vectorize loops over a few leading rows; unrolled, they take at most a third of the time.
    """
    return _fold(operator.add, jnp.sum, rows, axis)


def greatest(rows: Float[Array, "points row own *envs"]) -> Float[Array, "*envs"]:
    """Return the greatest value of each environment, at least 0."""
    for _ in range(3):
        rows = _fold(jnp.maximum, partial(jnp.max, initial=0.0), rows, 0)
    return jnp.maximum(rows, 0)


def _fold(combine: Callable, reduce: Callable, rows: Array, axis: int) -> Array:
    if not 0 < rows.shape[axis] <= 32:
        return reduce(rows, axis)
    terms = [jax.lax.index_in_dim(rows, i, axis, False) for i in range(rows.shape[axis])]
    return functools.reduce(combine, terms)


@pytree
class Contact:
    """All pairs of one kind of contact.

    The impulse of each point is at least 0. Friction acts once for all points of a pair.
    """

    normal: Rows
    gap: Float[Array, "points row own *envs"]  # in meters, negative where bodies overlap
    bias: Float[Array, "points row own *envs"]  # m / s, at which a pair may close; negative if it must separate
    tangent: Rows | None = None
    friction: float = static(default=0.0)

    def counts(self) -> tuple[dict[str, Array], dict[str, Array] | None]:
        """Return the number of contacts of each body, and the same for friction, which each pair has once."""
        return self.normal.counts(), self.tangent and self.tangent.counts()

    def masses(self, solver: Solver, counts: tuple) -> tuple[Array, Array | None]:
        """Return effective masses along normals, and along tangents if there is friction."""
        normal, tangent = counts
        return self.normal.masses(solver, normal), self.tangent and self.tangent.masses(solver, tangent)

    def weighted(self, mass: Array, tangent_mass: Array | None) -> "Contact":
        """Return the contacts with these effective masses."""
        tangent = self.tangent and dataclasses.replace(self.tangent, mass=tangent_mass)
        return dataclasses.replace(self, normal=dataclasses.replace(self.normal, mass=mass), tangent=tangent)

    def answer(
        self, relaxation: Array, motions: Motions, impulse: Array, slip: Array | None
    ) -> tuple[Array, Array | None]:
        """Return the impulses and friction impulses that answer these motions, from the previous `impulse, slip`."""
        error = self.normal.mass * (self.normal.velocity(motions) + self.bias)
        impulse = jnp.maximum(impulse - relaxation * error, 0)
        if self.tangent is None or slip is None:
            return impulse, None
        limit = self.friction * total(impulse, 0)[None]
        return impulse, jnp.clip(slip - self.tangent.mass * self.tangent.velocity(motions), -limit, limit)

    def push(self, solver: Solver, motions: Motions, impulse: Array, slip: Array | None = None) -> Motions:
        """Return the motions after these impulses."""
        force = self.normal.force(impulse)
        if self.tangent is not None and slip is not None:
            force = Force(*jax.tree.map(operator.add, force, self.tangent.force(slip)))
        return self.normal.push(solver, motions, force)

    def displaced(self, shift: Motions) -> "Contact":
        """Return the contacts with the gaps after these displacements, to first order."""
        return dataclasses.replace(self, gap=self.gap + self.normal.velocity(shift))

    def depth(self) -> Float[Array, "*envs"]:
        """Return the deepest overlap in meters, at least 0."""
        return greatest(-self.gap * self.normal.near)

    def growth(self, solver: Solver, motions: Motions) -> Float[Array, "*envs"]:
        """Return by how many meters a substep with these motions deepens an overlap beyond `Solver.max_overlap`."""
        gap = self.gap + solver.duration * self.normal.velocity(motions)
        return greatest((jnp.minimum(self.gap, -solver.max_overlap) - gap) * self.normal.near)

    @property
    def bodies(self) -> tuple[str, ...]:
        """Kinds of bodies that this contact moves."""
        return tuple(kind for kind in ("disc", "box") if kind in (self.normal.own, self.normal.other))
