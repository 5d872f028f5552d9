"""Pursuit: agents must catch evaders that are twice as fast as they are."""

import dataclasses
import math
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxswarm import checks
from jaxswarm.checks import require
from jaxswarm.physics.dynamics import Velocity
from jaxswarm.physics.geometry import Space, bearing, direction, norm, unit_vector
from jaxswarm.physics.neighbors import Neighborhood, neighborhood
from jaxswarm.scene import Bodies, Scene
from jaxswarm.tasks import swarm
from jaxswarm.tasks.evasion import evader_direction
from jaxswarm.tasks.swarm import NumberRange
from jaxswarm.types import Comparable, Entities, Key, Metrics, Observation, Step, pytree, static

EVADER_STRIDE = 2.0  # world units per step, twice the stride of a pursuer
CATCH_DISTANCE = {"distance": 1.0, "catches": 2.0}  # world units
WALL_LOW, WALL_HIGH = 1.0, 99.0  # agents beyond these are "at a wall" for every side, as in the thesis's program


@pytree
class State:
    """State of one environment, drawn by `reset` and advanced by `step`."""

    position: Float[Array, "agents 2"]  # world units, in [0, side]
    heading: Float[Array, "agents"]  # rad, counter-clockwise from x
    velocity: Float[Array, "agents 2"]  # linear speed in world units / s, turn rate in rad / s
    rounding: Float[Array, "agents 5"]  # float32 rounding errors, see `physics.dynamics`
    evader_position: Float[Array, "evaders 2"]  # world units, in [0, side]
    evader_age: Int[Array, " evaders"]  # steps since the evader was last placed
    catches: Int[Array, ""]  # number of catches since reset
    active_agents: Int[Array, ""]  # the first agents are active; the others do not exist
    active_evaders: Int[Array, ""]  # the first evaders are active; the others do not exist
    time: Int[Array, ""]  # steps since reset


@pytree
class Agents:
    """Quantities of each agent that the observations of all agents share."""

    position: Float[Array, "agents 2"]  # world units
    direction: Float[Array, "agents 2"]  # [cos, sin] of the heading
    own: Float[Array, "agents own_dim"]


@pytree
class View(swarm.View):
    """Part of a state that `perceive` needs."""

    evader_position: Float[Array, "evaders 2"]
    active_evaders: Int[Array, ""]


@pytree
class Pursuit:
    """Pursuit tasks of the thesis (sections 5.2.2 and 5.2.3): agents catch evaders that flee from visible agents.

    With the reward "distance", a catch (within 1 world unit) ends the episode. With "catches", evaders that are caught
    (within 2 world units) restart at random positions. `max_neighbors` suits large swarms that see a small part of the
    world: observations then need O(num_agents) memory (see `physics.neighbors`).

    Without `torus`, agents observe whether they are at a wall: a coordinate is <= 1 or >= 99. As in the thesis's
    program, these limits do not depend on `side`. In Python, `null` is `None`.

    Attributes:
        num_agents: An environment has this number of agents, an integer >= 1.
        num_evaders: An environment has this number of evaders, an integer >= 1.
        active_agents: The number of active agents in each episode is drawn from [low, high]; with null all are active.
        active_evaders: The number of active evaders in each episode is drawn from [low, high]; with null all are
            active.
        side: The sides of the square world have this length in world units.
        torus: Agents that leave the square enter it on the opposite side if true; if false, the sides are walls.
        visibility_radius: Agents see each other within this distance in world units; 100 * sqrt(2) sees all of a
            world of side 100.
        evader_visibility_radius: Agents and evaders see each other within this distance in world units.
        max_neighbors: Agents perceive at most this number of their nearest visible neighbors; with null they perceive
            all of them.
        reward: The reward is minus the smallest "distance" between an agent and an evader over
            `evader_visibility_radius`, or the number of "catches".
        episode_length: An episode is truncated after this number of steps of 0.1 s, an integer >= 1.
    """

    num_agents: int = static(default=10)
    num_evaders: int = static(default=1)
    active_agents: NumberRange | None = static(default=None)
    active_evaders: NumberRange | None = static(default=None)
    side: float = 100.0
    torus: bool = static(default=True)
    visibility_radius: float = 100 * math.sqrt(2)
    evader_visibility_radius: float = 100 * math.sqrt(2)
    max_neighbors: int | None = static(default=None)
    reward: Literal["distance", "catches"] = static(default="distance")
    episode_length: int = static(default=1024)

    action_dim: ClassVar[int] = 2
    comparable_metrics: ClassVar[tuple[Comparable, ...]] = (
        Comparable("catches", ("evader_visibility_radius",), is_higher_better=True),
        Comparable("evader_distance", ("evader_visibility_radius", "episode_length", "reward")),
    )

    def __post_init__(self) -> None:
        swarm.require_swarm(self, least=1)
        require(self, checks.size(1), "num_evaders")
        require(self, checks.optional(checks.integer_range(1, self.num_evaders)), "active_evaders")
        require(self, checks.POSITIVE_FINITE, "evader_visibility_radius")
        require(self, checks.choice(CATCH_DISTANCE), "reward")

    @property
    def space(self) -> Space:
        """Space in which distances are measured."""
        return swarm.space(self)

    @property
    def motion(self) -> Velocity:
        """Motion model of the agents: no inertia, at most one turn per second."""
        return Velocity(max_turn_rate=2 * math.pi)

    def reset(self, key: Key) -> State:
        """Draw a start state: agents and evaders with uniform positions, agents with uniform headings.

        Positions keep a distance of `side / 20` from the sides.
        """
        position_key, heading_key, evader_key, agents_key, evaders_key = jax.random.split(key, 5)
        return State(
            position=swarm.draw_positions(position_key, self.side, self.num_agents),
            heading=jax.random.uniform(heading_key, (self.num_agents,), maxval=2 * math.pi),
            velocity=jnp.zeros((self.num_agents, 2)),
            rounding=jnp.zeros((self.num_agents, 5)),
            evader_position=swarm.draw_positions(evader_key, self.side, self.num_evaders),
            evader_age=jnp.zeros(self.num_evaders, jnp.int32),
            catches=jnp.zeros((), jnp.int32),
            active_agents=swarm.draw_number(agents_key, self.active_agents, self.num_agents),
            active_evaders=swarm.draw_number(evaders_key, self.active_evaders, self.num_evaders),
            time=jnp.zeros((), jnp.int32),
        )

    def step(self, key: Key, state: State, action: Float[Array, "agents 2"]) -> tuple[State, Step]:
        """Simulate one step of 0.1 s; `key` only draws the new positions of caught evaders.

        1. "catches": evaders closer than 2 units to an agent after the last step are caught and placed at random.
           The reward is their number.
        2. Evaders move by 2 units, away from the previous positions of the agents.
        3. Agents move.
        4. "distance": the reward is -min(d, R) / R, with d the smallest distance between an agent and an evader and
           R = evader_visibility_radius. Below 1 unit the evader is caught and the episode terminates.
        """
        if self.reward == "catches":
            caught, age = self.is_caught(state), state.evader_age
            state = self._move(self._restart(key, state, caught), action)
            reward, is_solved = caught.sum(dtype=state.position.dtype), jnp.array(False)
        else:
            state = self._move(state, action)
            caught, age = self.is_caught(state), state.evader_age
            smallest = jnp.minimum(self.distances(state).min(), self.evader_visibility_radius)
            reward, is_solved = -smallest / self.evader_visibility_radius, caught.any()
        state = dataclasses.replace(state, catches=state.catches + caught.sum(dtype=jnp.int32))
        is_over = jnp.asarray(state.time >= self.episode_length)
        metrics = self._metrics(state, is_solved | is_over, is_solved)
        metrics["capture_time"] = jnp.where(caught, age, 0).sum() / jnp.where(caught.any(), caught.sum(), jnp.nan)
        return state, Step(reward, is_solved, is_over & ~is_solved, metrics)

    def distances(self, state: State) -> Float[Array, "agents evaders"]:
        """Return the distances in world units; they are infinite for inactive agents and evaders."""
        distance = norm(self.space.displacement(state.position[:, None], state.evader_position[None]))
        is_agent = swarm.is_present(state.active_agents, self.num_agents)
        is_evader = swarm.is_present(state.active_evaders, self.num_evaders)
        return jnp.where(is_agent[:, None] & is_evader[None], distance, jnp.inf)

    def is_caught(self, state: State) -> Bool[Array, " evaders"]:
        """Mark evaders that are closer to an agent than the catch distance."""
        return (self.distances(state) < CATCH_DISTANCE[self.reward]).any(0)

    def _restart(self, key: Key, state: State, caught: Bool[Array, " evaders"]) -> State:
        start = swarm.draw_positions(key, self.side, self.num_evaders)
        return dataclasses.replace(
            state,
            evader_position=jnp.where(caught[:, None], start, state.evader_position),
            evader_age=jnp.where(caught, 0, state.evader_age),
        )

    def _move(self, state: State, action: Float[Array, "agents 2"]) -> State:
        """Move the evaders, all from the same state, and then the agents."""
        is_present = swarm.is_present(state.active_agents, self.num_agents)
        escape = jax.vmap(evader_direction, (None, 0, None, None, None))(
            self.space, state.evader_position, state.position, is_present, self.evader_visibility_radius
        )
        evader_position = self.space.confine(state.evader_position + EVADER_STRIDE * escape)
        state = self.motion.move(self.space, state, action)
        return dataclasses.replace(
            state, evader_position=evader_position, evader_age=state.evader_age + 1, time=state.time + 1
        )

    def _metrics(self, state: State, is_over: Bool[Array, ""], is_solved: Bool[Array, ""]) -> Metrics:
        is_present = swarm.is_present(state.active_agents, self.num_agents)
        nearest = jnp.where(is_present, self.distances(state).min(-1), 0.0).sum() / state.active_agents
        metrics = {"evader_distance": nearest, "catches": jnp.where(is_over, state.catches, jnp.nan)}
        if self.reward == "distance":
            metrics["caught"] = jnp.where(is_over, is_solved, jnp.nan)
        return metrics | swarm.overflow(self.around(state), is_present, self.max_neighbors)

    def around(self, state: State) -> Neighborhood:
        """Return the number of visible neighbors, the sum of distances and the nearest neighbors of each agent."""
        is_present = swarm.is_present(state.active_agents, self.num_agents)
        return neighborhood(
            self.space,
            state.position,
            is_present,
            self.visibility_radius,
            lambda distance: distance <= self.visibility_radius,
            self.max_neighbors,
        )

    def view(self, state: State) -> View:
        """Return the part of a state that `perceive` needs, in O(agents) memory."""
        around = self.around(state)
        dtype = state.position.dtype
        own = [around.num_visible.astype(dtype) / jnp.maximum(state.active_agents - 1, 1)]
        if not self.torus:
            own.append(((state.position <= WALL_LOW) | (state.position >= WALL_HIGH)).any(-1).astype(dtype))
        agents = Agents(state.position, direction(state.heading), jnp.stack(own, -1))
        return View(agents, state.active_agents, around.nearest, state.evader_position, state.active_evaders)

    def perceive(self, view: View, agent: Int[Array, ""]) -> Observation:
        """Return the observation of one agent; neighbors are in cyclic order, starting with the agent after it.

        Own features: fraction of the other agents that is visible and, in a world with walls, whether the agent is at
        a wall. Neighbor features: distance over `visibility_radius`, bearing to the neighbor and from it as [cos, sin].
        Evader features: distance over `evader_visibility_radius`, bearing to the evader as [cos, sin]. Invisible
        neighbors and evaders are masked and have zero features.
        """
        me, them, is_present = swarm.agent_and_others(view, agent)
        distance, bearings = swarm.distance_and_bearings(self.space, me, them)
        neighbors = _entities(distance, bearings, self.visibility_radius, is_present)
        to_evaders = self.space.displacement(me.position, view.evader_position)
        distance = norm(to_evaders)
        bearings = bearing(me.direction, unit_vector(to_evaders, distance))
        is_present = swarm.is_present(view.active_evaders, self.num_evaders)
        evaders = _entities(distance, bearings, self.evader_visibility_radius, is_present)
        is_active = None if self.active_agents is None else agent < view.active_agents
        return Observation(own=me.own[0], groups={"neighbors": neighbors, "evaders": evaders}, mask=is_active)

    def observe(self, state: State) -> Observation:
        """Return the observations of all agents; `perceive` lists the features."""
        return jax.vmap(self.perceive, (None, 0))(self.view(state), jnp.arange(self.num_agents))

    def slots(self, state: State) -> dict[str, Int[Array, "agents slots"]]:
        """Return the number of the scene's body in each slot of `observe`; -1 marks an empty slot."""
        evaders = jnp.broadcast_to(self.num_agents + jnp.arange(self.num_evaders), (self.num_agents, self.num_evaders))
        return {"neighbors": swarm.slots(self.view(state)), "evaders": evaders}

    def scene(self, state: State) -> Scene:
        """Return the scene of a state: points in a square, with evaders marked as caught before they restart."""
        is_agent = swarm.is_present(state.active_agents, self.num_agents)
        is_evader = swarm.is_present(state.active_evaders, self.num_evaders)
        agents = Bodies(state.position, is_agent, state.heading, seen_within=self.visibility_radius)
        evaders = Bodies(state.evader_position, is_evader, seen_within=self.evader_visibility_radius)
        return Scene(jnp.zeros(2), jnp.full(2, self.side), self.torus, agents, evaders, is_caught=self.is_caught(state))


def _entities(distance: Array, bearings: Array, radius: Array | float, is_present: Array) -> Entities:
    """Return the entities, with a mask of those that are present and not farther away than the radius."""
    mask = is_present & (distance <= radius)
    features = jnp.concatenate([distance[:, None] / radius, bearings], -1)
    return Entities(jnp.where(mask[:, None], features, 0.0), mask)
