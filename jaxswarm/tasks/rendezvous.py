"""Rendezvous: all agents must meet at one place that is not given."""

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
from jaxswarm.types import Comparable, Entities, Key, Observation, Step, pytree, static

RELATIVE_VELOCITY = {
    "normalized": lambda difference, max_speed: difference / (2 * max_speed),  # in [-1, 1]
    "thesis": lambda difference, max_speed: difference * (max_speed / 2),  # an error in its program; in [-100, 100]
}


@pytree
class State:
    """State of one environment, drawn by `reset` and advanced by `step`."""

    position: Float[Array, "agents 2"]  # world units, in [0, side]
    heading: Float[Array, "agents"]  # rad, counter-clockwise from x
    velocity: Float[Array, "agents 2"]  # linear speed in world units / s, turn rate in rad / s
    rounding: Float[Array, "agents 5"]  # float32 rounding errors, see `physics.dynamics`
    active_agents: Int[Array, ""]  # the first agents are active; the others do not exist
    time: Int[Array, ""]  # steps since reset


@pytree
class Agents:
    """Quantities of each agent that the observations of all agents share."""

    position: Float[Array, "agents 2"]  # world units
    direction: Float[Array, "agents 2"]  # [cos, sin] of the heading
    velocity: Float[Array, "agents 2"]  # in world axes, world units / s
    num_visible: Float[Array, "agents 1"]  # number of visible neighbors
    own: Float[Array, "agents own_dim"]


@pytree
class Rendezvous:
    """Rendezvous task of the thesis (section 5.2.1): agents minimize their mean distance to each other.

    The figures of the thesis used the defaults, but `relative_velocity="thesis"`. `max_neighbors` suits large swarms
    that see a small part of the world: observations then need O(num_agents) memory (see `physics.neighbors`). In
    Python, `null` is `None`.

    Attributes:
        num_agents: An environment has this number of agents, an integer >= 2.
        active_agents: The number of active agents in each episode is drawn from [low, high]; with null all are active.
        side: The sides of the square world have this length in world units.
        torus: Agents that leave the square enter it on the opposite side if true; if false, the sides are walls.
        visibility_radius: Agents see each other within this distance in world units; 100 * sqrt(2) sees all of a
            world of side 100.
        max_neighbors: Agents perceive at most this number of their nearest visible neighbors; with null they perceive
            all of them.
        dynamics: Actions set the "acceleration" or the "velocity" of the agents.
        relative_velocity: Observed relative velocities are scaled to [-1, 1] ("normalized") or to [-100, 100]
            ("thesis").
        episode_length: An episode is truncated after this number of steps of 0.1 s, an integer >= 1.
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
    comparable_metrics: ClassVar[tuple[Comparable, ...]] = (
        Comparable("final_center_distance", ("visibility_radius", "episode_length", "side")),
    )

    def __post_init__(self) -> None:
        swarm.require_swarm(self, least=2)
        require(self, checks.choice(DYNAMICS), "dynamics")
        require(self, checks.choice(RELATIVE_VELOCITY), "relative_velocity")

    @property
    def space(self) -> Space:
        """Space in which distances are measured."""
        return swarm.space(self)

    @property
    def motion(self) -> Acceleration | Velocity:
        """Motion model of the agents, selected by `dynamics`."""
        return DYNAMICS[self.dynamics]()

    def reset(self, key: Key) -> State:
        """Draw a start state: agents at rest, with uniform positions and headings.

        Positions keep a distance of `side / 20` from the sides.
        """
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
        """Simulate one step of 0.1 s. The step is deterministic and ignores `key`.

            reward = -mean_{i<j} min(d_ij, R) / R - 0.001 mean(action^2),  R = visibility_radius

        Distances d_ij are those after the move. The move clips actions to [-1, 1], the reward uses unclipped actions.
        The reward and the metric `distance` depend on R. The metric `final_center_distance` does not; see
        `swarm.center_distance`.
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
            metrics={
                "distance": distance,
                "final_distance": jnp.where(is_over, distance, jnp.nan),
                "final_center_distance": jnp.where(
                    is_over, swarm.center_distance(self.space, state.position, is_present), jnp.nan
                ),
            }
            | swarm.overflow(around, is_present, self.max_neighbors),
        )
        return state, step

    def around(self, state: State) -> Neighborhood:
        """Return the number of visible neighbors, the sum of distances and the nearest neighbors of each agent."""
        is_present = swarm.is_present(state.active_agents, self.num_agents)
        return neighborhood(
            self.space, state.position, is_present, self.visibility_radius, self.is_visible, self.max_neighbors
        )

    def is_visible(self, distance: Float[Array, "*n"]) -> Array:
        """Mark visible neighbors by their distance in world units; an agent at the same place is not visible."""
        return (distance > 0) & (distance < self.visibility_radius)

    def view(self, state: State) -> View:
        """Return the part of a state that `perceive` needs, in O(agents) memory."""
        around = self.around(state)
        num_visible = around.num_visible[:, None].astype(jnp.float32)
        own_motion = self.motion.proprioception(state.velocity)
        agents = Agents(
            position=state.position,
            direction=direction(state.heading),
            velocity=self.motion.world_velocity(state.heading, state.velocity),
            num_visible=num_visible,
            own=jnp.concatenate([num_visible / jnp.maximum(state.active_agents - 1, 1), own_motion], -1),
        )
        return View(agents, state.active_agents, around.nearest)

    def perceive(self, view: View, agent: Int[Array, ""]) -> Observation:
        """Return the observation of one agent; neighbors are in cyclic order, starting with the agent after it.

        Own features: fraction of the other agents that is visible, and the proprioception of the motion model.
        Neighbor features: distance over the diagonal of the square, bearing to the neighbor and from it as [cos, sin],
        relative velocity (own - neighbor's) in world axes, and the difference in the number of visible agents
        (neighbor's - own) over the number of agents - 2. Invisible neighbors are masked and have zero features.
        """
        me, them, is_present = swarm.agent_and_others(view, agent)
        distance, bearings = swarm.distance_and_bearings(self.space, me, them)
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
        """Return the observations of all agents; `perceive` lists the features."""
        return jax.vmap(self.perceive, (None, 0))(self.view(state), jnp.arange(self.num_agents))

    def slots(self, state: State) -> dict[str, Int[Array, "agents slots"]]:
        """Return the number of the scene's body in each slot of `observe`; -1 marks an empty slot."""
        return {"neighbors": swarm.slots(self.view(state))}

    def scene(self, state: State) -> Scene:
        """Return the scene of a state: points in a square."""
        is_present = swarm.is_present(state.active_agents, self.num_agents)
        agents = Bodies(state.position, is_present, state.heading, seen_within=self.visibility_radius)
        return Scene(jnp.zeros(2), jnp.full(2, self.side), self.torus, agents)
