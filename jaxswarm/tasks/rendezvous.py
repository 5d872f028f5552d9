"""Rendezvous: all agents are to meet at one place, which is not given."""

import math
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxswarm.dynamics import DYNAMICS, Acceleration, Velocity
from jaxswarm.geometry import Plane, Space, Torus, bearing, direction, norm, unit
from jaxswarm.types import Entities, Key, Observation, Step, is_whole, pytree, require, static

RELATIVE_VELOCITY = {
    "normalised": lambda difference, max_speed: difference / (2 * max_speed),  # in [-1, 1]
    "thesis": lambda difference, max_speed: difference * (max_speed / 2),  # a slip of its program; in [-100, 100]
}


@pytree
class State:
    """One world."""

    position: Float[Array, "agents 2"]  # world units, in [0, side]
    heading: Float[Array, "agents"]  # rad, counter-clockwise from x, of any number of turns
    velocity: Float[Array, "agents 2"]  # linear speed in world units / s, turn rate in rad / s
    rounding: Float[Array, "agents 5"]  # see `dynamics`
    time: Int[Array, ""]  # steps since reset


@pytree
class View:
    """What is known of each agent by itself, so that pairs need no trigonometry and no other pairs."""

    position: Float[Array, "agents 2"]
    direction: Float[Array, "agents 2"]  # [cos, sin] of the heading
    velocity: Float[Array, "agents 2"]  # in world axes
    num_visible: Float[Array, "agents 1"]
    own: Float[Array, "agents own_dim"]


@pytree
class Rendezvous:
    """The rendezvous of the thesis (section 5.2.2); its figures used the defaults, but "thesis" relative velocities."""

    num_agents: int = static(default=20)
    side: float = 100.0
    torus: bool = static(default=False)
    visibility_radius: float = 100 * math.sqrt(2)
    dynamics: str = static(default="acceleration")
    relative_velocity: str = static(default="normalised")
    episode_length: int = static(default=1024)

    action_dim: ClassVar[int] = 2

    def __post_init__(self) -> None:
        require(self, "whole numbers from 2", is_whole(2), "num_agents")
        require(self, "whole numbers from 1", is_whole(1), "episode_length")
        require(self, "positive numbers", lambda x: x > 0, "side", "visibility_radius")
        require(self, "True, False", lambda x: isinstance(x, bool), "torus")
        require(self, ", ".join(DYNAMICS), lambda x: x in DYNAMICS, "dynamics")
        require(self, ", ".join(RELATIVE_VELOCITY), lambda x: x in RELATIVE_VELOCITY, "relative_velocity")

    @property
    def space(self) -> Space:
        """Where distances are taken."""
        return Torus(self.side) if self.torus else Plane(self.side)

    @property
    def motion(self) -> Acceleration | Velocity:
        """How agents move."""
        return DYNAMICS[self.dynamics]()

    def reset(self, key: Key) -> State:
        """Agents at rest anywhere but within a twentieth of the walls, looking anywhere."""
        position_key, heading_key = jax.random.split(key)
        shape = (self.num_agents, 2)
        return State(
            position=self.side * jax.random.uniform(position_key, shape, minval=0.05, maxval=0.95),
            heading=jax.random.uniform(heading_key, shape[:1], maxval=2 * math.pi),
            velocity=jnp.zeros(shape),
            rounding=jnp.zeros((self.num_agents, 5)),
            time=jnp.zeros((), jnp.int32),
        )

    def step(self, key: Key, state: State, action: Float[Array, "agents 2"]) -> tuple[State, Step]:
        """One step of 0.1 s; nothing in it is random.

            reward = -mean_{i<j} min(d_ij, R) / R - 0.001 mean(action^2),  R = visibility_radius

        after the move, of the action as given; the move clips it to [-1, 1].
        """
        state = self.motion.move(self.space, state, action).replace(time=state.time + 1)
        distance = self.distances(state.position)
        num_pairs = self.num_agents * (self.num_agents - 1)
        spread = jnp.minimum(distance, self.visibility_radius).sum() / num_pairs
        step = Step(
            reward=-spread / self.visibility_radius - 0.001 * jnp.square(action).mean(),
            terminated=jnp.array(False),
            truncated=state.time >= self.episode_length,
            metrics={"distance": distance.sum() / num_pairs},
        )
        return state, step

    def distances(self, position: Float[Array, "agents 2"]) -> Float[Array, "agents agents"]:
        """Between all agents."""
        return norm(self.space.displacement(position[:, None], position[None]))

    def is_visible(self, distance: Float[Array, "*n"]) -> Array:
        """An agent at exactly one's own place is not."""
        return (distance > 0) & (distance < self.visibility_radius)

    def view(self, state: State) -> View:
        """What `perceive` needs of a state, in O(agents) memory."""
        num_visible = self.is_visible(self.distances(state.position)).sum(-1, keepdims=True).astype(jnp.float32)
        feeling = self.motion.proprioception(state.velocity)
        return View(
            position=state.position,
            direction=direction(state.heading),
            velocity=self.motion.world_velocity(state.heading, state.velocity),
            num_visible=num_visible,
            own=jnp.concatenate([num_visible / (self.num_agents - 1), feeling], -1),
        )

    def perceive(self, view: View, agent: Int[Array, ""]) -> Observation:
        """What one agent perceives; its neighbours stand in cyclic order, from the agent after it on.

        Own features: fraction of the others that is visible, and the motion's proprioception. Neighbours': distance
        over the square's diagonal, bearing to them and from them as [cos, sin], relative velocity (own - theirs) in
        world axes, visible agents (theirs - own) over num_agents - 2. Those out of sight are masked, and zero.
        """

        def window(start: Array, size: int) -> View:
            twice = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), view)
            return jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, size), twice)

        me, them = window(agent, 1), window(agent + 1, self.num_agents - 1)
        displacement = self.space.displacement(me.position, them.position)
        distance = norm(displacement)
        toward = unit(displacement, distance)
        mask = self.is_visible(distance)
        features = [
            distance[:, None] / (self.side * math.sqrt(2)),
            bearing(me.direction, toward),
            bearing(them.direction, -toward),
            RELATIVE_VELOCITY[self.relative_velocity](me.velocity - them.velocity, self.motion.max_speed),
            (them.num_visible - me.num_visible) / max(self.num_agents - 2, 1),
        ]
        neighbors = Entities(features=jnp.where(mask[:, None], jnp.concatenate(features, -1), 0), mask=mask)
        return Observation(own=me.own[0], groups={"neighbors": neighbors})

    def observe(self, state: State) -> Observation:
        """What each agent perceives; see `perceive`."""
        return jax.vmap(self.perceive, (None, 0))(self.view(state), jnp.arange(self.num_agents))
