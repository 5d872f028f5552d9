"""Rendezvous: all agents are to meet at one place, which is not given."""

import math
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxswarm import checks
from jaxswarm.checks import require
from jaxswarm.physics.dynamics import DYNAMICS, Acceleration, Velocity
from jaxswarm.physics.geometry import Space, direction
from jaxswarm.physics.neighbors import Neighborhood, neighborhood
from jaxswarm.scene import Bodies, Scene
from jaxswarm.tasks import swarm
from jaxswarm.tasks.swarm import NumberRange, View
from jaxswarm.types import Entities, Key, Observation, Step, pytree, static

RELATIVE_VELOCITY = {
    "normalized": lambda difference, max_speed: difference / (2 * max_speed),  # in [-1, 1]
    "thesis": lambda difference, max_speed: difference * (max_speed / 2),  # a slip of its program; in [-100, 100]
}


@pytree
class State:
    """One world."""

    position: Float[Array, "agents 2"]  # world units, in [0, side]
    heading: Float[Array, "agents"]  # rad, counter-clockwise from x
    velocity: Float[Array, "agents 2"]  # linear speed in world units / s, turn rate in rad / s
    rounding: Float[Array, "agents 5"]  # see `dynamics`
    active_agents: Int[Array, ""]  # the first ones take part; the others do not exist
    time: Int[Array, ""]  # steps since reset


@pytree
class Agents:
    """What is known of each agent by itself."""

    position: Float[Array, "agents 2"]
    direction: Float[Array, "agents 2"]  # [cos, sin] of the heading
    velocity: Float[Array, "agents 2"]  # in world axes
    num_visible: Float[Array, "agents 1"]
    own: Float[Array, "agents own_dim"]


@pytree
class Rendezvous:
    """The rendezvous of the thesis (section 5.2.1); its figures used the defaults, but "thesis" relative velocities.

    With `active_agents` the number of agents of each episode is drawn between these two; `num_agents` is then the most
    there can be. With `max_neighbors` agents perceive their nearest neighbors only, in O(num_agents) memory (see
    `neighbors`).
    """

    num_agents: int = static(default=20)
    active_agents: NumberRange | None = static(default=None)
    side: float = 100.0
    torus: bool = static(default=False)
    visibility_radius: float = 100 * math.sqrt(2)
    max_neighbors: int | None = static(default=None)
    dynamics: str = static(default="acceleration")
    relative_velocity: str = static(default="normalized")
    episode_length: int = static(default=1024)

    action_dim: ClassVar[int] = 2

    def __post_init__(self) -> None:
        swarm.require_swarm(self, least=2)
        require(self, checks.choice(DYNAMICS), "dynamics")
        require(self, checks.choice(RELATIVE_VELOCITY), "relative_velocity")

    @property
    def space(self) -> Space:
        """Where distances are taken."""
        return swarm.space(self)

    @property
    def motion(self) -> Acceleration | Velocity:
        """How agents move."""
        return DYNAMICS[self.dynamics]()

    def reset(self, key: Key) -> State:
        """Agents at rest anywhere but within a twentieth of the walls, looking anywhere."""
        position_key, heading_key, number_key = jax.random.split(key, 3)
        return State(
            position=swarm.draw_positions(position_key, self.side, self.num_agents),
            heading=jax.random.uniform(heading_key, (self.num_agents,), maxval=2 * math.pi),
            velocity=jnp.zeros((self.num_agents, 2)),
            rounding=jnp.zeros((self.num_agents, 5)),
            active_agents=swarm.draw_number(number_key, self.active_agents, self.num_agents),
            time=jnp.zeros((), jnp.int32),
        )

    def step(self, key: Key, state: State, action: Float[Array, "agents 2"]) -> tuple[State, Step]:
        """One step of 0.1 s; nothing in it is random.

            reward = -mean_{i<j} min(d_ij, R) / R - 0.001 mean(action^2),  R = visibility_radius

        after the move, of the action as given; the move clips it to [-1, 1].
        """
        state = self.motion.move(self.space, state, action).replace(time=state.time + 1)
        is_present = swarm.is_present(state.active_agents, self.num_agents)
        around = self.around(state)
        num_agents = jnp.asarray(state.active_agents, state.position.dtype)
        num_pairs = num_agents * jnp.maximum(num_agents - 1, 1)  # ordered
        distance = jnp.where(is_present, around.spread, 0.0).sum() / num_pairs
        effort = jnp.where(is_present[:, None], jnp.square(action), 0.0).sum() / (2 * state.active_agents)
        is_over = jnp.asarray(state.time >= self.episode_length)
        step = Step(
            reward=-distance / self.visibility_radius - 0.001 * effort,
            terminated=jnp.array(False),
            truncated=is_over,
            metrics={"distance": distance, "final_distance": jnp.where(is_over, distance, jnp.nan)}
            | swarm.overflow(around, is_present, self.max_neighbors),
        )
        return state, step

    def around(self, state: State) -> Neighborhood:
        """Who is near each agent."""
        is_present = swarm.is_present(state.active_agents, self.num_agents)
        return neighborhood(
            self.space, state.position, is_present, self.visibility_radius, self.is_visible, self.max_neighbors
        )

    def is_visible(self, distance: Float[Array, "*n"]) -> Array:
        """An agent at exactly one's own place is not."""
        return (distance > 0) & (distance < self.visibility_radius)

    def view(self, state: State) -> View:
        """What `perceive` needs of a state, in O(agents) memory."""
        around = self.around(state)
        num_visible = around.num_visible[:, None].astype(jnp.float32)
        feeling = self.motion.proprioception(state.velocity)
        agents = Agents(
            position=state.position,
            direction=direction(state.heading),
            velocity=self.motion.world_velocity(state.heading, state.velocity),
            num_visible=num_visible,
            own=jnp.concatenate([num_visible / jnp.maximum(state.active_agents - 1, 1), feeling], -1),
        )
        return View(agents, state.active_agents, around.nearest)

    def perceive(self, view: View, agent: Int[Array, ""]) -> Observation:
        """What one agent perceives; its neighbors stand in cyclic order, from the agent after it on.

        Own features: fraction of the others that is visible, and the motion's proprioception. Neighbours': distance
        over the square's diagonal, bearing to them and from them as [cos, sin], relative velocity (own - theirs) in
        world axes, visible agents (theirs - own) over agents - 2. Those out of sight are masked, and zero.
        """
        me, them, is_present = swarm.pick(view, agent)
        distance, bearings = swarm.sight(self.space, me, them)
        mask = is_present & self.is_visible(distance)
        features = [
            distance[:, None] / (self.side * math.sqrt(2)),
            bearings,
            RELATIVE_VELOCITY[self.relative_velocity](me.velocity - them.velocity, self.motion.max_speed),
            (them.num_visible - me.num_visible) / jnp.maximum(view.active_agents - 2, 1),
        ]
        neighbors = Entities(features=jnp.where(mask[:, None], jnp.concatenate(features, -1), 0), mask=mask)
        is_active = None if self.active_agents is None else agent < view.active_agents
        return Observation(own=me.own[0], groups={"neighbors": neighbors}, mask=is_active)

    def observe(self, state: State) -> Observation:
        """What each agent perceives; see `perceive`."""
        return jax.vmap(self.perceive, (None, 0))(self.view(state), jnp.arange(self.num_agents))

    def slots(self, state: State) -> dict[str, Int[Array, "agents slots"]]:
        """Which body of the scene is in which slot of `observe`; -1: none."""
        return {"neighbors": swarm.slots(self.view(state))}

    def scene(self, state: State) -> Scene:
        """Points in a square."""
        is_present = swarm.is_present(state.active_agents, self.num_agents)
        agents = Bodies(state.position, is_present, state.heading, seen_within=self.visibility_radius)
        return Scene(jnp.zeros(2), jnp.full(2, self.side), self.torus, agents)
