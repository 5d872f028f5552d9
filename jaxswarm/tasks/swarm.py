"""What swarms of points have in common: how many take part, where they start, and who each of them looks at."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxswarm import checks
from jaxswarm.checks import require
from jaxswarm.physics.geometry import Plane, Space, Torus, bearing, norm, unit_vector
from jaxswarm.physics.neighbors import Neighborhood
from jaxswarm.types import Key, Metrics, pytree

NumberRange = tuple[int, int]  # lowest and highest


@pytree
class View:
    """What is known of each agent by itself, so that pairs need no trigonometry and no other pairs."""

    agents: Any  # leaves [agents, ...], with at least `position` and `direction`
    active_agents: Int[Array, ""]
    nearest: Int[Array, "agents max_neighbors"] | None  # whom to look at; None: at everybody


def require_swarm(task: Any, least: int) -> None:
    """Checks the fields that tasks of point swarms share."""
    require(task, checks.integer(least), "num_agents")
    require(task, checks.integer(1), "episode_length")
    require(task, checks.optional(checks.integer(1)), "max_neighbors")
    require(task, checks.POSITIVE_FINITE, "side", "visibility_radius")
    require(task, checks.BOOL, "torus")
    require(task, checks.optional(checks.integer_range(least, task.num_agents)), "active_agents")


def space(task: Any) -> Space:
    """Where distances are taken."""
    return Torus(task.side) if task.torus else Plane(task.side)


def draw_number(key: Key, bounds: NumberRange | None, most: int) -> Int[Array, ""]:
    """How many take part in an episode: any number within the bounds, both included; without bounds, all."""
    if bounds is None:
        return jnp.array(most, jnp.int32)
    return jax.random.randint(key, (), bounds[0], bounds[1] + 1)


def draw_positions(key: Key, side: float | Float[Array, ""], num_points: int) -> Float[Array, "points 2"]:
    """Anywhere but within a twentieth of the sides."""
    return side * jax.random.uniform(key, (num_points, 2), minval=0.05, maxval=0.95)


def is_present(active: Int[Array, ""], num_slots: int) -> Bool[Array, " slots"]:
    """The first ones take part."""
    return jnp.arange(num_slots) < active


def overflow(neighborhood: Neighborhood, present: Bool[Array, " agents"], max_neighbors: int | None) -> Metrics:
    """How many visible neighbors agents do not perceive, on average, because there is room for so many only."""
    if max_neighbors is None:
        return {}
    missed = jnp.maximum(neighborhood.num_visible - max_neighbors, 0)
    return {"unseen_neighbors": jnp.where(present, missed, 0.0).sum() / present.sum()}


def cyclic_others(agent: Int[Array, ""], num_agents: int) -> Int[Array, " others"]:
    """All other agents in cyclic order, from the one after it on."""
    index = agent + jnp.arange(1, num_agents)
    return jnp.where(index < num_agents, index, index - num_agents)


def others(view: View, agent: Int[Array, ""]) -> Int[Array, " others"]:
    """Those whom `pick` gives, in its order; -1 where a list of the nearest ends early."""
    return cyclic_others(agent, view.agents.position.shape[0]) if view.nearest is None else view.nearest[agent]


def slots(view: View) -> Int[Array, "agents others"]:
    """`others` of every agent."""
    return jax.vmap(others, (None, 0))(view, jnp.arange(view.agents.position.shape[0]))


def pick(view: View, agent: Int[Array, ""]) -> tuple[Any, Any, Bool[Array, " others"]]:
    """The agent, leaves [1, ...]; those it may see, leaves [others, ...]; and whether they take part.

    Without a list of the nearest these are all others in cyclic order, from the agent after it on: slices of doubled
    arrays, which are faster than a gather.
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


def sight(space: Space, me: Any, them: Any) -> tuple[Float[Array, "others"], Float[Array, "others 4"]]:
    """Distance; and bearing to them and from them, as [cos, sin] each. In one place, both see the other along x."""
    displacement = space.displacement(me.position, them.position)
    distance = norm(displacement)
    toward = unit_vector(displacement, distance)
    back = jnp.where(distance[:, None] > 0, -toward, toward)
    return distance, jnp.concatenate([bearing(me.direction, toward), bearing(them.direction, back)], -1)
