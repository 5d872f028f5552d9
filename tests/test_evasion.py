"""Tests of the evader's rule against recorded directions and against bounded Voronoi cells of SciPy.

`golden/evader.npz` is a table of recorded directions, see `golden/README.md`.
"""

import functools
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import Voronoi

from jaxswarm.physics.geometry import Plane, Torus
from jaxswarm.tasks.evasion import evader_direction

GOLDEN = np.load(pathlib.Path(__file__).parent / "golden" / "evader.npz")
IS_STABLE = GOLDEN["sensitivity"] < 1e-6
NUM_SLOTS = 50


@functools.partial(jax.jit, static_argnames="torus")
@functools.partial(jax.vmap, in_axes=(None, 0, 0, 0, 0, 0))
def directions(torus, side, evader, pursuers, num_pursuers, radius):
    is_present = jnp.arange(NUM_SLOTS) < num_pursuers
    return evader_direction((Torus if torus else Plane)(side), evader, pursuers, is_present, radius)


def directions_of_recorded_rows(dtype):
    """Compute our directions for all recorded rows, with inputs rounded to float32 first."""
    names = ("world_size", "evader", "pursuers", "n_pursuers", "obs_radius")
    rows = [np.nan_to_num(GOLDEN[name]).astype(np.float32).astype(dtype) for name in names]
    return np.where(GOLDEN["torus"][:, None], directions(True, *rows), directions(False, *rows))


def voronoi_direction(torus, side, evader, pursuers, radius):
    """Compute the direction from the evader's Voronoi cell, in a box whose sides mirror all points."""
    points, box = pursuers, side
    if torus:
        evader = np.where(evader < side / 2, evader + side, evader)
        points = np.concatenate([pursuers + side * np.array(corner) for corner in ((0, 0), (1, 0), (0, 1), (1, 1))])
        box = 2 * side
    distance = np.linalg.norm(points - evader, axis=-1)
    order = np.argsort(distance)[:10]
    order = order[distance[order] < radius]
    if not len(order):
        return np.zeros(2)
    own = np.concatenate([evader[None], points[order]])
    mirrored = [own, own * [-1, 1], own * [1, -1], [2 * box, 0] + own * [-1, 1], [0, 2 * box] + own * [1, -1]]
    cells = Voronoi(np.concatenate(mirrored))
    (edge,) = [i for i, pair in enumerate(cells.ridge_points) if set(pair) == {0, 1}]
    ends = cells.vertices[cells.ridge_vertices[edge]] - evader
    gap = distance[order[0]]
    toward = (points[order[0]] - evader) / gap
    left = np.array([-toward[1], toward[0]])
    low, high = sorted(ends @ left)
    length, to_low = high - low, np.clip(-low, 0, high - low)
    escape = -length / 2 * toward - (to_low**2 - (length - to_low) ** 2) / (2 * gap) * left
    return escape / np.linalg.norm(escape)


def test_recorded_directions_are_reproduced():
    """Float32 reproduces all stable directions, unless rounding the input alone changes the nearest pursuer."""
    is_defined = IS_STABLE & (GOLDEN["status"] == 0)
    assert is_defined.sum() > 900
    error = np.abs(directions_of_recorded_rows(np.float32) - GOLDEN["direction"]).max(-1)
    with jax.enable_x64(True):
        rounding_error = np.abs(directions_of_recorded_rows(np.float64) - GOLDEN["direction"]).max(-1)
    is_wrong = is_defined & (error > 1e-4)
    assert is_wrong.sum() <= 0.002 * is_defined.sum()
    assert (rounding_error[is_wrong] > 1e-4).all()
    assert np.median(error[is_defined]) < 1e-6


def test_nobody_in_sight_is_recorded_as_no_flight():
    is_alone = IS_STABLE & (GOLDEN["status"] == 1)
    assert is_alone.sum() > 30
    np.testing.assert_array_equal(directions_of_recorded_rows(np.float32)[is_alone], 0)


def test_every_recorded_row_gives_a_unit_vector_or_none():
    """This includes rows in which the original failed or in which the direction is unstable."""
    ours = directions_of_recorded_rows(np.float32)
    length = np.linalg.norm(ours, axis=-1)
    assert ((np.abs(length - 1) < 1e-5) | (length == 0)).all()
    is_at_evader = np.char.endswith(GOLDEN["category"], "pursuer_on_evader")
    assert is_at_evader.any()
    np.testing.assert_array_equal(ours[is_at_evader], 0)


@pytest.mark.parametrize("torus", [False, True])
def test_random_directions_are_those_of_voronoi_cells(torus):
    rng = np.random.default_rng(0)
    num_rows = 300
    side = rng.choice([60.0, 100.0], num_rows).astype(np.float32)
    radius = rng.choice([20.0, 40.0, 141.0], num_rows).astype(np.float32)
    num_pursuers = rng.integers(1, NUM_SLOTS + 1, num_rows)
    evader = (side[:, None] * rng.random((num_rows, 2))).astype(np.float32)
    pursuers = (side[:, None, None] * rng.random((num_rows, NUM_SLOTS, 2))).astype(np.float32)
    ours = directions(torus, side, evader, pursuers, num_pursuers, radius)
    expected = [
        voronoi_direction(torus, s, e.astype(float), p[:n].astype(float), r)
        for s, e, p, n, r in zip(side, evader, pursuers, num_pursuers, radius, strict=True)
    ]
    error = np.abs(ours - np.array(expected)).max(-1)
    assert error.max() < 1e-3
    assert (error > 1e-4).mean() < 0.01
    assert (np.array(expected) == 0).all(-1).any()


@pytest.mark.parametrize("distance", [0.0, 1e-30, 1e-16, 1e-14, 1e-3])
def test_no_pursuer_is_too_close(distance):
    is_present = jnp.ones((1,), bool)
    escape = np.asarray(evader_direction(Plane(100.0), jnp.zeros(2), jnp.array([[distance, 0.0]]), is_present, 50.0))
    assert np.isfinite(escape).all()
    assert np.linalg.norm(escape) == pytest.approx(float(distance > 1e-15), abs=1e-6)


def test_a_lone_pursuer_in_the_middle_is_fled_straight_away():
    pursuers = jnp.zeros((NUM_SLOTS, 2)).at[0].set(jnp.array([50.0, 40.0]))
    escape = directions(False, *(jnp.array([x]) for x in (100.0, [50.0, 60.0], pursuers, 1, 30.0)))[0]
    np.testing.assert_allclose(escape, [0, 1], atol=1e-6)
