import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from jaxswarm.physics.geometry import Plane, Torus, bearing, direction, norm, unit

SIDE = 100.0
SPACES = [Plane(SIDE), Torus(SIDE)]

# Multiples of 1/64 and their sums are exact in float32, so that identities of real numbers hold bit for bit.
several = settings(max_examples=30, deadline=None)


def points(low=0, high=100):
    return arrays(np.int32, (6, 2), elements=st.integers(64 * low, 64 * high)).map(lambda n: jnp.float32(n / 64))


@pytest.mark.parametrize("space", SPACES)
@several
@given(a=points(), b=points())
def test_displacement_is_antisymmetric(space, a, b):
    np.testing.assert_array_equal(space.displacement(a, b), -space.displacement(b, a))


@pytest.mark.parametrize("space", SPACES)
@several
@given(a=points(), b=points())
def test_displacement_leads_from_a_to_b(space, a, b):
    reached = np.asarray(space.confine(jnp.asarray(a + space.displacement(a, b))))
    seam = SIDE if isinstance(space, Torus) else np.inf
    np.testing.assert_array_equal(np.mod(reached, seam), np.mod(b, seam))


@several
@given(a=points(), b=points())
def test_displacement_on_the_torus_is_the_shortest_to_any_image(a, b):
    displacement = Torus(SIDE).displacement(a, b)
    shifts = SIDE * np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)])
    distances = np.linalg.norm(np.asarray(b - a) + shifts[:, None], axis=-1)
    np.testing.assert_allclose(norm(displacement), distances.min(0), rtol=1e-6)
    assert jnp.abs(displacement).max() <= SIDE / 2


@several
@given(a=points(), b=points(), shift=points(high=99))
def test_displacement_on_the_torus_does_not_change_when_both_ends_are_shifted(a, b, shift):
    space = Torus(SIDE)
    displacement = np.asarray(space.displacement(a, b))
    assume((np.abs(displacement) != SIDE / 2).all())  # at half a side, two vectors are shortest
    shifted = space.displacement(space.confine(a + shift[:1]), space.confine(b + shift[:1]))
    np.testing.assert_array_equal(shifted, displacement)


@pytest.mark.parametrize("space", SPACES)
@several
@given(position=points(-99, 199))
def test_confine_ends_inside_and_then_changes_nothing(space, position):
    inside = space.confine(position)
    assert 0 <= inside.min() <= inside.max() <= SIDE
    np.testing.assert_array_equal(space.confine(inside), inside)


@several
@given(position=points(-99, 199))
def test_walls_stop_where_the_torus_goes_on_at_the_other_side(position):
    np.testing.assert_array_equal(Plane(SIDE).confine(position), np.clip(position, 0, SIDE))
    np.testing.assert_array_equal(np.mod(Torus(SIDE).confine(position), SIDE), np.mod(position, SIDE))


def test_points_far_beyond_the_seam_come_back_too():
    position = jnp.array([[5.4, -7.9], [1.0, 0.0], [-0.25, 1.25]])
    np.testing.assert_allclose(Torus(1.0).confine(position), [[0.4, 0.1], [1.0, 0.0], [0.75, 0.25]], atol=1e-6)


def test_exactly_one_side_is_not_wrapped():
    edge = jnp.array([SIDE, 0.0])
    np.testing.assert_array_equal(Torus(SIDE).confine(edge), edge)
    np.testing.assert_array_equal(Torus(SIDE).displacement(edge, jnp.zeros(2)), jnp.zeros(2))


@several
@given(position=points(), path=points(-99, 99))
def test_a_path_slides_along_walls(position, path):
    np.testing.assert_array_equal(position + Plane(SIDE).slide(position, path), np.clip(position + path, 0, SIDE))
    np.testing.assert_array_equal(Torus(SIDE).slide(position, path), path)


@several
@given(arrays(np.float32, (6, 2), elements=st.floats(-7, 7, width=32)))
def test_bearings_are_clockwise_from_ahead(angles):
    heading, toward = jnp.asarray(angles).T
    expected = np.stack(
        [np.cos(angles[:, 0].astype(float) - angles[:, 1]), np.sin(angles[:, 0].astype(float) - angles[:, 1])], -1
    )
    np.testing.assert_allclose(bearing(direction(heading), direction(toward)), expected, atol=1e-6)


def test_what_is_to_the_right_has_a_positive_sine():
    north, east = jnp.array([0.0, 1.0]), jnp.array([1.0, 0.0])
    np.testing.assert_array_equal(bearing(north, east), [0, 1])


@several
@given(points(-99, 99))
def test_norm_and_unit_agree_with_numpy(vector):
    length = norm(vector)
    np.testing.assert_allclose(length, np.linalg.norm(vector, axis=-1), rtol=1e-6)
    np.testing.assert_allclose(unit(vector, length) * length[:, None], vector, rtol=1e-6)


@pytest.mark.parametrize("length", [0.0, 1e-30, 1e-20, 1e-15, 1e-14, 1e-5, 1.0])
def test_gradients_are_finite_at_any_distance(length):
    def toward(vector):
        return unit(vector, norm(vector))

    vector = jnp.array([0.6, 0.8]) * length
    assert jnp.isfinite(jax.grad(norm)(vector)).all()
    assert jnp.isfinite(jax.jacobian(toward)(vector)).all()
    assert jnp.isfinite(jax.jacfwd(toward)(vector)).all()


@pytest.mark.parametrize("space", SPACES)
def test_spaces_broadcast_over_leading_axes(space):
    a, b = jnp.zeros((3, 1, 2)), jnp.ones((1, 4, 2))
    assert space.displacement(a, b).shape == (3, 4, 2)
    assert norm(space.displacement(a, b)).shape == (3, 4)
