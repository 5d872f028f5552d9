"""Neighbor search: over all pairs of a swarm, or through a grid of cells.

The grid needs O(agents) memory. Its cells are as wide as the visibility radius, and its time grows with the number of
agents times the number in the fullest cells. It is faster than all pairs only if the radius is a small part of the
world and the swarm is spread out.
"""

import itertools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxswarm.physics.geometry import Space, Torus, norm
from jaxswarm.types import pytree

IsVisible = Callable[[Array], Array]  # of distances; must be false beyond the radius


@pytree
class Neighborhood:
    """The neighbors of each agent; absent agents are nobody's neighbors."""

    num_visible: Int[Array, " agents"]
    spread: Float[Array, " agents"]  # sum of the distances to all others, at most the radius each
    nearest: Int[Array, "agents max_neighbors"] | None  # visible agents in any order, then -1; None without a grid


def neighborhood(
    space: Space,
    position: Float[Array, "agents 2"],
    is_present: Bool[Array, " agents"],
    radius: Float[Array, ""] | float,
    is_visible: IsVisible,
    max_neighbors: int | None,
) -> Neighborhood:
    """Find the neighbors of each agent over all pairs or, with `max_neighbors`, in adjoining cells of a grid.

    Both give the same counts and sums. The grid also lists the nearest visible agents, and has no gradient.
    """
    radius = jnp.asarray(radius)
    if max_neighbors is None:
        return _all_pairs(space, position, is_present, radius, is_visible)
    space, position, radius = jax.lax.stop_gradient((space, position, radius))
    return _by_cells(space, position, is_present, radius, is_visible, max_neighbors)


def _all_pairs(space: Space, position: Array, is_present: Array, radius: Array, is_visible: IsVisible) -> Neighborhood:
    distance = norm(space.displacement(position[:, None], position[None]))
    is_other = is_present[None] & ~jnp.eye(len(position), dtype=bool)
    num_visible = (is_visible(distance) & is_other).sum(-1, dtype=jnp.int32)
    spread = jnp.where(is_other, jnp.minimum(distance, radius), 0.0).sum(-1)
    return Neighborhood(num_visible, spread, None)


@pytree
class _Grid:
    """Agents sorted by cell; a cell is at least as wide as the radius."""

    num_cells: Int[Array, ""]  # per side
    cell: Int[Array, "agents 2"]
    agent: Int[Array, " agents"]  # by cell
    start: Int[Array, " cells"]  # of each cell, in `agent`
    size: Int[Array, " cells"]  # agents in each cell


def _grid(space: Space, position: Array, is_present: Array, radius: Array) -> _Grid:
    """Sort the agents into at most about as many cells as there are agents."""
    limit = math.ceil(math.sqrt(len(position)))
    wide_enough = jnp.floor(space.side / (1.0001 * radius))
    num_cells = jnp.clip(wide_enough, 1, limit).astype(jnp.int32)
    cell = jnp.clip(jnp.floor(position / space.side * num_cells).astype(jnp.int32), 0, num_cells - 1)
    number = jnp.where(is_present, cell[:, 0] * num_cells + cell[:, 1], limit**2)
    size = jnp.zeros(limit**2, jnp.int32).at[number].add(1, mode="drop")
    return _Grid(num_cells, cell, jnp.argsort(number).astype(jnp.int32), jnp.cumsum(size) - size, size)


def _adjoining(space: Space, grid: _Grid, offset: Int[Array, "2"]) -> tuple[Array, Array]:
    """Return the start in `grid.agent`, and the size, of the cell at this offset from each agent's own cell.

    On a torus with one or two cells per side, offsets that lead to the same cell count once.
    """
    cell = grid.cell + offset[None]
    if isinstance(space, Torus):
        is_there = jnp.broadcast_to((offset != -1) | (grid.num_cells > 2), cell.shape)
        is_there &= ((offset != 1) | (grid.num_cells > 1))[None]
        cell = cell % grid.num_cells
    else:
        is_there = (cell >= 0) & (cell < grid.num_cells)
    number = jnp.where(is_there.all(-1), cell[:, 0] * grid.num_cells + cell[:, 1], 0)
    return grid.start[number], jnp.where(is_there.all(-1), grid.size[number], 0)


def _by_cells(
    space: Space, position: Array, is_present: Array, radius: Array, is_visible: IsVisible, max_neighbors: int
) -> Neighborhood:
    """Visit the agents of nine cells one by one, for all agents in parallel, and keep the nearest."""
    num_agents, grid = len(position), _grid(space, position, is_present, radius)
    offsets, agent = jnp.array(list(itertools.product((-1, 0, 1), repeat=2))), jnp.arange(num_agents)

    def visit(start: Array, size: Array, i: Array | int, found: tuple) -> tuple:
        num_visible, closeness, nearest, distances = found
        other = grid.agent[jnp.minimum(start + i, num_agents - 1)]
        is_other = (i < size) & (other != agent)
        distance = norm(space.displacement(position, position[other]))
        is_seen = is_other & is_visible(distance)
        slot = distances.argmax(-1)
        is_nearer = is_seen & (distance < distances[agent, slot])
        nearest = nearest.at[agent, slot].set(jnp.where(is_nearer, other, nearest[agent, slot]))
        distances = distances.at[agent, slot].set(jnp.where(is_nearer, distance, distances[agent, slot]))
        closeness = closeness + jnp.where(is_other, jnp.maximum(radius - distance, 0.0), 0.0)
        return num_visible + is_seen, closeness, nearest, distances

    def visit_cell(c: Array | int, found: tuple) -> tuple:
        start, size = _adjoining(space, grid, offsets[c])
        return jax.lax.fori_loop(0, size.max(), lambda i, found: visit(start, size, i, found), found)

    shape = (num_agents, max_neighbors)
    found = (
        jnp.zeros(num_agents, jnp.int32),
        jnp.zeros(num_agents),
        jnp.full(shape, -1, jnp.int32),
        jnp.full(shape, jnp.inf),
    )
    num_visible, closeness, nearest, _ = jax.lax.fori_loop(0, len(offsets), visit_cell, found)
    num_others = is_present.sum() - is_present
    return Neighborhood(num_visible, num_others * radius - closeness, nearest)
