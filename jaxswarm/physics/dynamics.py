"""How point agents move under an action: unicycles that are given speeds, or accelerations.

They move states of any world that has these fields, of all its agents:

    position  [agents, 2]  world units
    heading   [agents]     rad, counter-clockwise from x
    velocity  [agents, 2]  linear speed in world units / s, turn rate in rad / s
    rounding  [agents, 5]  what float32 cut off these sums, in this order, for the next step to add (Kahan summation):
                           an agent that circles for a whole episode would otherwise stray by a thousandth of a unit
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxswarm.physics.geometry import Space, direction
from jaxswarm.types import pytree

SUBSTEPS = 10
DURATION = 0.01  # s, of a sub-step

FULL_TURN = float(np.float32(2 * math.pi))


@pytree
class Acceleration:
    """A unicycle with inertia; actions are its linear and angular acceleration, as fractions of what is possible.

    Explicit Euler, with the velocity before the position and the heading last:

        (v, w) <- clip((1 - damping) (v, w) + 0.01 a)
        p <- p + 0.01 v (cos h, sin h)
        h <- h + 0.01 w
    """

    max_speed: float = 10.0  # world units / s
    max_turn_rate: float = math.pi  # rad / s
    max_acceleration: float = 10.0
    max_turn_acceleration: float = math.pi
    damping: float = 0.01  # lost velocity per sub-step

    @partial(jax.jit, inline=True)  # so that steps outside of any other `jit` are fast, too
    def move(self, space: Space, state: Any, action: Float[Array, "agents 2"]) -> Any:
        """The state after 0.1 s; actions are clipped to [-1, 1]."""
        gain = jnp.clip(action, -1, 1) * _row(self.max_acceleration, self.max_turn_acceleration)
        limit = _row(self.max_speed, self.max_turn_rate)
        return _drive(space, state, lambda velocity: DURATION * gain - self.damping * velocity, limit)

    def world_velocity(
        self, heading: Float[Array, "agents"], velocity: Float[Array, "agents 2"]
    ) -> Float[Array, "agents 2"]:
        """Velocity in world axes during the last sub-step, that is along the heading before its turn."""
        return velocity[:, :1] * direction(heading - DURATION * velocity[:, 1])

    def proprioception(self, velocity: Float[Array, "agents 2"]) -> Float[Array, "agents 2"]:
        """What agents feel of their own motion: linear speed and turn rate, in [-1, 1]."""
        return velocity / _row(self.max_speed, self.max_turn_rate)


@pytree
class Velocity:
    """A unicycle without inertia; actions are its speed and turn rate, as fractions of what is possible.

    A sub-step moves along the heading before its turn.
    """

    max_speed: float = 10.0  # world units / s
    max_turn_rate: float = math.pi  # rad / s

    @partial(jax.jit, inline=True)  # so that steps outside of any other `jit` are fast, too
    def move(self, space: Space, state: Any, action: Float[Array, "agents 2"]) -> Any:
        """The state after 0.1 s, its velocity the commanded one; actions are clipped to [-1, 1]."""
        limit = _row(self.max_speed, self.max_turn_rate)
        velocity = jnp.clip(action, -1, 1) * limit
        return _drive(space, state.replace(velocity=velocity), jnp.zeros_like, limit)

    def world_velocity(
        self, heading: Float[Array, "agents"], velocity: Float[Array, "agents 2"]
    ) -> Float[Array, "agents 2"]:
        """Zero: the thesis's experiments never told agents without inertia how others move."""
        return jnp.zeros_like(velocity)

    def proprioception(self, velocity: Float[Array, "agents 2"]) -> Float[Array, "agents 0"]:
        """Nothing: agents without inertia have no motion but their next action."""
        return velocity[:, :0]


DYNAMICS = {"acceleration": Acceleration, "velocity": Velocity}


def _row(linear: Float[Array, ""] | float, angular: Float[Array, ""] | float) -> Float[Array, "1 2"]:
    return jnp.stack([jnp.asarray(linear), jnp.asarray(angular)])[None]


def _drive(space: Space, state: Any, acceleration: Callable[[Array], Array], limit: Array) -> Any:
    """The sub-steps of one step; headings end in [-pi, pi], where float32 is finest."""

    def substep(_: object, carry: tuple[Array, ...]) -> tuple[Array, ...]:
        path, turn, velocity, velocity_rest = carry
        velocity, velocity_rest = _add(velocity, acceleration(velocity) + velocity_rest)
        velocity = jnp.clip(velocity, -limit, limit)
        path = path + DURATION * velocity[:, :1] * direction(state.heading + turn)
        return space.slide(state.position, path), turn + DURATION * velocity[:, 1], velocity, velocity_rest

    path, turn, velocity_rest = state.rounding[:, :2], state.rounding[:, 2], state.rounding[:, 3:]
    carry = (path, turn, state.velocity, velocity_rest)
    path, turn, velocity, velocity_rest = jax.lax.fori_loop(0, SUBSTEPS, substep, carry)
    position, path_rest = _add(state.position, path)
    heading, turn_rest = _add(state.heading, turn)
    num_turns = jnp.round(heading / FULL_TURN)
    turn_rest = turn_rest - num_turns * (2 * math.pi - FULL_TURN)
    return state.replace(
        position=space.confine(position),
        heading=heading - num_turns * FULL_TURN,
        velocity=velocity,
        rounding=jnp.concatenate([path_rest, turn_rest[:, None], velocity_rest], -1),
    )


def _add(total: Array, change: Array) -> tuple[Array, Array]:
    """The sum, and what it lacks because of rounding."""
    result = total + change
    return result, change - (result - total)
