"""Motion models of point agents: unicycles whose actions are velocities or accelerations.

A motion model moves any state that has these fields:

    position  [agents, 2]  world units
    heading   [agents]     rad, counter-clockwise from x
    velocity  [agents, 2]  linear speed in world units / s, turn rate in rad / s
    rounding  [agents, 5]  float32 rounding errors of these three fields, in this order

The next step adds the rounding errors (Kahan summation). Without them, an agent that circles for a whole episode would
drift by a thousandth of a world unit.
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
from jaxswarm.types import clip_action, pytree

SUBSTEPS = 10
DURATION = 0.01  # s, of one substep

FULL_TURN = float(np.float32(2 * math.pi))  # rad, rounded to float32


@pytree
class Acceleration:
    """A unicycle with inertia; actions are its linear and angular acceleration as fractions of their maxima.

    Each of the 10 substeps is an explicit Euler step that updates the velocity, the position and then the heading:

        (v, w) <- clip((1 - damping) (v, w) + 0.01 a)
        p <- p + 0.01 v (cos h, sin h)
        h <- h + 0.01 w

    Attributes:
        max_speed: The linear speed is clipped to this absolute value in world units / s.
        max_turn_rate: The turn rate is clipped to this absolute value in rad / s.
        max_acceleration: An action of 1 gives this linear acceleration in world units / s^2.
        max_turn_acceleration: An action of 1 gives this angular acceleration in rad / s^2.
        damping: Agents lose this fraction of their velocity in each substep of 0.01 s.
    """

    max_speed: float = 10.0
    max_turn_rate: float = math.pi
    max_acceleration: float = 10.0
    max_turn_acceleration: float = math.pi
    damping: float = 0.01

    @partial(jax.jit, inline=True)  # steps outside of other compiled functions must be fast, too
    def move(self, space: Space, state: Any, action: Float[Array, "agents 2"]) -> Any:
        """Return the state after 0.1 s; actions are clipped to [-1, 1]."""
        gain = clip_action(action) * _as_row(self.max_acceleration, self.max_turn_acceleration)
        limit = _as_row(self.max_speed, self.max_turn_rate)
        return _integrate(space, state, lambda velocity: DURATION * gain - self.damping * velocity, limit)

    def world_velocity(
        self, heading: Float[Array, "agents"], velocity: Float[Array, "agents 2"]
    ) -> Float[Array, "agents 2"]:
        """Return the velocity in world axes during the last substep, along the heading before its turn.

        The unit is world units / s.
        """
        return velocity[:, :1] * direction(heading - DURATION * velocity[:, 1])

    def proprioception(self, velocity: Float[Array, "agents 2"]) -> Float[Array, "agents 2"]:
        """Return the linear speed and turn rate that agents observe of themselves, scaled to [-1, 1]."""
        return velocity / _as_row(self.max_speed, self.max_turn_rate)


@pytree
class Velocity:
    """A unicycle without inertia; actions are its speed and turn rate as fractions of their maxima.

    Each of the 10 substeps moves an agent along its heading and then turns the agent.

    Attributes:
        max_speed: An action of 1 gives this linear speed in world units / s.
        max_turn_rate: An action of 1 gives this turn rate in rad / s.
    """

    max_speed: float = 10.0
    max_turn_rate: float = math.pi

    @partial(jax.jit, inline=True)  # steps outside of other compiled functions must be fast, too
    def move(self, space: Space, state: Any, action: Float[Array, "agents 2"]) -> Any:
        """Return the state after 0.1 s, with the commanded velocity; actions are clipped to [-1, 1]."""
        limit = _as_row(self.max_speed, self.max_turn_rate)
        velocity = clip_action(action) * limit
        return _integrate(space, state.replace(velocity=velocity), jnp.zeros_like, limit)

    def world_velocity(
        self, heading: Float[Array, "agents"], velocity: Float[Array, "agents 2"]
    ) -> Float[Array, "agents 2"]:
        """Return zeros: in the thesis's experiments, agents without inertia observed no velocities of others."""
        return jnp.zeros_like(velocity)

    def proprioception(self, velocity: Float[Array, "agents 2"]) -> Float[Array, "agents 0"]:
        """Return no features, because the next action alone determines the motion of an agent without inertia."""
        return velocity[:, :0]


DYNAMICS = {"acceleration": Acceleration, "velocity": Velocity}


def _as_row(linear: Float[Array, ""] | float, angular: Float[Array, ""] | float) -> Float[Array, "1 2"]:
    return jnp.stack([jnp.asarray(linear), jnp.asarray(angular)])[None]


def _integrate(space: Space, state: Any, velocity_change: Callable[[Array], Array], limit: Array) -> Any:
    """Integrate the substeps of one step.

    `velocity_change` maps a velocity to its change in one substep. Headings end in [-pi, pi], where float32 is most
    precise.
    """

    def substep(_: object, carry: tuple[Array, ...]) -> tuple[Array, ...]:
        path, turn, velocity, velocity_error = carry
        velocity, velocity_error = _add_compensated(velocity, velocity_change(velocity) + velocity_error)
        velocity = jnp.clip(velocity, -limit, limit)
        path = path + DURATION * velocity[:, :1] * direction(state.heading + turn)
        return space.slide(state.position, path), turn + DURATION * velocity[:, 1], velocity, velocity_error

    path, turn, velocity_error = state.rounding[:, :2], state.rounding[:, 2], state.rounding[:, 3:]
    carry = (path, turn, state.velocity, velocity_error)
    path, turn, velocity, velocity_error = jax.lax.fori_loop(0, SUBSTEPS, substep, carry)
    position, position_error = _add_compensated(state.position, path)
    heading, heading_error = _add_compensated(state.heading, turn)
    num_turns = jnp.round(heading / FULL_TURN)
    heading_error = heading_error - num_turns * (2 * math.pi - FULL_TURN)
    return state.replace(
        position=space.confine(position),
        heading=heading - num_turns * FULL_TURN,
        velocity=velocity,
        rounding=jnp.concatenate([position_error, heading_error[:, None], velocity_error], -1),
    )


def _add_compensated(total: Array, change: Array) -> tuple[Array, Array]:
    """Return the sum and its rounding error."""
    result = total + change
    return result, change - (result - total)
