"""Functions shared by the tasks of point agents: active agents, start positions, and perceived neighbors."""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxswarm import checks
from jaxswarm.checks import require
from jaxswarm.physics.geometry import Plane, Space, Torus, bearing, norm, unit_vector
from jaxswarm.physics.neighbors import Neighborhood
from jaxswarm.types import Key, Metrics, pytree

NumberRange = tuple[int, int]  # (low, high), both included


@pytree
class View:
    """Quantities computed once per agent, so that features of a pair need neither trigonometry nor other pairs."""

    agents: Any  # leaves [agents, ...], with at least `position` and `direction`
    active_agents: Int[Array, ""]
    nearest: Int[Array, "agents max_neighbors"] | None  # perceived neighbors of each agent; None: all other agents


def require_swarm(task: Any, least: int) -> None:
    """Check the fields that tasks of point agents share; `least` is the smallest number of agents.

    Raises a `ValueError` that names the field.
    """
    require(task, checks.size(least), "num_agents")
    require(task, checks.integer(1), "episode_length")
    require(task, checks.optional(checks.size(1)), "max_neighbors")
    require(task, checks.POSITIVE_FINITE, "side", "visibility_radius")
    require(task, checks.BOOL, "torus")
    require(task, checks.optional(checks.integer_range(least, task.num_agents)), "active_agents")


def space(task: Any) -> Space:
    """Return the space in which the task measures distances."""
    return Torus(task.side) if task.torus else Plane(task.side)


def draw_number(key: Key, bounds: NumberRange | None, most: int) -> Int[Array, ""]:
    """Draw the number of active entities of an episode.

    The number is uniform within `bounds`, both included. Without bounds it is `most`.
    """
    if bounds is None:
        return jnp.array(most, jnp.int32)
    return jax.random.randint(key, (), bounds[0], bounds[1] + 1)


def draw_positions(key: Key, side: float | Float[Array, ""], num_points: int) -> Float[Array, "points 2"]:
    """Draw uniform positions, in world units, that keep a distance of `side / 20` from the sides."""
    return side * jax.random.uniform(key, (num_points, 2), minval=0.05, maxval=0.95)


def is_present(active: Int[Array, ""], num_slots: int) -> Bool[Array, " slots"]:
    """Mark the first `active` of `num_slots` slots."""
    return jnp.arange(num_slots) < active


def center_distance(space: Space, position: Float[Array, "agents 2"], present: Bool[Array, " agents"]) -> Array:
    """Return the mean distance of the present agents to their center, in world units.

    The center is the mean position. On a torus it is the circular mean of each coordinate.
    """

    def mean(values: Array) -> Array:
        return jnp.where(present[:, None], values, 0.0).sum(0) / present.sum()

    center = mean(position)
    if isinstance(space, Torus):
        angle = position * (2 * math.pi / space.side)
        center = jnp.arctan2(mean(jnp.sin(angle)), mean(jnp.cos(angle))) * (space.side / (2 * math.pi))
    distance = norm(space.displacement(center[None], position))
    return jnp.where(present, distance, 0.0).sum() / present.sum()


def overflow(neighborhood: Neighborhood, present: Bool[Array, " agents"], max_neighbors: int | None) -> Metrics:
    """Return the metric `unseen_neighbors`, or no metric without `max_neighbors`.

    The metric is the mean number of visible neighbors that an agent does not perceive because they exceed
    `max_neighbors`.
    """
    if max_neighbors is None:
        return {}
    missed = jnp.maximum(neighborhood.num_visible - max_neighbors, 0)
    return {"unseen_neighbors": jnp.where(present, missed, 0.0).sum() / present.sum()}


def cyclic_others(agent: Int[Array, ""], num_agents: int) -> Int[Array, " others"]:
    """Return the indices of all other agents in cyclic order, starting with the agent after `agent`."""
    index = agent + jnp.arange(1, num_agents)
    return jnp.where(index < num_agents, index, index - num_agents)


def others(view: View, agent: Int[Array, ""]) -> Int[Array, " others"]:
    """Return the indices of the agents that `agent_and_others` returns, in its order; -1 marks an empty slot."""
    return cyclic_others(agent, view.agents.position.shape[0]) if view.nearest is None else view.nearest[agent]


def slots(view: View) -> Int[Array, "agents others"]:
    """Return the result of `others` for every agent, by row."""
    return jax.vmap(others, (None, 0))(view, jnp.arange(view.agents.position.shape[0]))


def agent_and_others(view: View, agent: Int[Array, ""]) -> tuple[Any, Any, Bool[Array, " others"]]:
    """Return the agent (leaves [1, ...]), the other agents (leaves [others, ...]) and a mask of active others.

    Without a list of nearest neighbors, the others are all other agents in cyclic order, starting with the agent after
    `agent`. They are then slices of doubled arrays, which are faster than a gather.
    """
    num_agents = view.agents.position.shape[0]

    def window(start: Array, size: int) -> Any:
        twice = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), view.agents)
        return jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, size), twice)

    index = others(view, agent)
    if view.nearest is not None:
        me, them = (jax.tree.map(lambda leaf, i=i: leaf[i], view.agents) for i in (agent[None], index))
        return me, them, index >= 0
    return window(agent, 1), window(agent + 1, num_agents - 1), index < view.active_agents


def distance_and_bearings(space: Space, me: Any, them: Any) -> tuple[Float[Array, "others"], Float[Array, "others 4"]]:
    """Return the distance to each of `them`, and the bearings to and from them, as [cos, sin] each.

    Two agents at the same place see each other in the direction of x.
    """
    displacement = space.displacement(me.position, them.position)
    distance = norm(displacement)
    toward = unit_vector(displacement, distance)
    backward = jnp.where(distance[:, None] > 0, -toward, toward)
    return distance, jnp.concatenate([bearing(me.direction, toward), bearing(them.direction, backward)], -1)
