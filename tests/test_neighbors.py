"""The grid of cells finds the same neighbors as the search over all pairs."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxswarm.physics.geometry import Plane, Torus
from jaxswarm.physics.neighbors import neighborhood

ROOM = 30
SIDE = 10.0


@functools.partial(jax.jit, static_argnames=("torus", "max_neighbors"))
def around(torus, position, num_present, radius, max_neighbors):
    space = (Torus if torus else Plane)(SIDE)
    is_present = jnp.arange(ROOM) < num_present
    return neighborhood(space, position, is_present, radius, lambda distance: distance <= radius, max_neighbors)


def distances(torus, position):
    across = position[None].astype(float) - position[:, None]
    if torus:
        across -= SIDE * np.round(across / SIDE)
    distance = np.hypot(across[..., 0], across[..., 1])
    np.fill_diagonal(distance, np.inf)
    return distance


def random_swarm(seed):
    """Draw a swarm that is spread out or in clusters, with coincident agents and agents on the sides, and a radius."""
    rng = np.random.default_rng(seed)
    position = rng.random((ROOM, 2)) * SIDE
    position = position[rng.integers(0, rng.integers(1, ROOM + 1), ROOM)] + rng.choice([0, 0.3]) * rng.random((ROOM, 2))
    return np.clip(position, 0, SIDE).astype(np.float32), rng.integers(1, ROOM + 1), np.float32(rng.uniform(0.2, 12))


@pytest.mark.parametrize("torus", [False, True])
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_cells_give_what_all_pairs_give(torus, seed):
    position, num_present, radius = random_swarm(seed)
    dense = around(torus, position, num_present, radius, None)
    sparse = around(torus, position, num_present, radius, ROOM - 1)
    present = slice(num_present)
    np.testing.assert_array_equal(sparse.num_visible[present], dense.num_visible[present])
    np.testing.assert_allclose(sparse.spread[present], dense.spread[present], rtol=1e-5, atol=1e-3)
    distance = distances(torus, position)[present, present]
    for own, nearest in zip(distance, np.asarray(sparse.nearest), strict=False):
        listed = sorted(nearest[nearest >= 0])
        is_clear = np.abs(own - radius) > 1e-4
        assert listed == sorted(set(listed))
        assert set(np.flatnonzero((own < radius) & is_clear)) <= set(listed) <= set(np.flatnonzero(own < radius + 1e-4))


@pytest.mark.parametrize("torus", [False, True])
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_with_too_little_room_the_nearest_are_kept_and_all_are_counted(torus, seed):
    position, _, radius = random_swarm(seed)
    found = around(torus, position, ROOM, radius, 3)
    for own, nearest, number in zip(distances(torus, position), found.nearest, found.num_visible, strict=True):
        kept = np.asarray(nearest)[np.asarray(nearest) >= 0]
        assert len(kept) == min(number, 3)
        np.testing.assert_allclose(np.sort(own[kept]), np.sort(own)[: len(kept)], atol=1e-5)


def test_counts_and_sums_are_those_of_numpy():
    position, _, _ = random_swarm(1)
    distance = distances(False, position)
    found = around(False, position, ROOM, np.float32(4.0), None)
    np.testing.assert_array_equal(found.num_visible, (distance <= 4).sum(-1))
    np.fill_diagonal(distance, 0)
    np.testing.assert_allclose(found.spread, np.minimum(distance, 4).sum(-1), rtol=1e-5)


def test_absent_agents_surround_nobody():
    position, _, _ = random_swarm(2)
    moved = np.concatenate([position[:20], position[20:][::-1]])
    for max_neighbors in (None, 5):
        one, two = (around(True, x, 20, np.float32(5.0), max_neighbors) for x in (position, moved))
        jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[:20], b[:20]), one, two)


@pytest.mark.slow
def test_derivatives_by_radius_and_side_pass_the_grid_by():
    def spread(numbers, max_neighbors):
        radius, side = numbers
        position, is_present = jnp.array([[1.0, 1.0], [2.0, 2.0]]), jnp.ones(2, bool)
        return neighborhood(Torus(side), position, is_present, radius, lambda x: x < radius, max_neighbors).spread.sum()

    gradients = [jax.grad(spread)((3.0, 10.0), max_neighbors) for max_neighbors in (None, 1)]
    np.testing.assert_array_equal(gradients[1], 0.0)
    assert np.isfinite(gradients[0]).all()


def test_memory_grows_with_the_number_of_agents():
    """Of the compiled program, without running it: 10 000 agents would need 400 MB for every matrix of pairs."""
    position = jax.ShapeDtypeStruct((10_000, 2), jnp.float32)
    is_present = jax.ShapeDtypeStruct((10_000,), jnp.bool)

    def nearest(position, is_present):
        return neighborhood(Torus(100.0), position, is_present, 3.0, lambda distance: distance < 3, 48)

    compiled = jax.jit(nearest).lower(position, is_present).compile()
    assert compiled.memory_analysis().temp_size_in_bytes < 50e6
