"""SE(2) against homogeneous matrices in float64, and as a group."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dsom_jax import geometry
from reference import se2

PI = float(np.float32(np.pi))
# float32 at coordinates of up to 100 m: 100 * 2^-24 per operation, about eight of them.
METRES = 5e-5
RADIANS = 4e-6

lengths = st.floats(-50, 50, width=32)
angles = st.one_of(st.floats(-3.5, 3.5, width=32), st.sampled_from([PI, -PI, 0.0, PI / 2, -PI / 2]))


@st.composite
def poses(draw, shape=None):
    shape = draw(st.sampled_from([(), (3,), (2, 3)])) if shape is None else shape
    xy = draw(arrays(np.float32, (*shape, 2), elements=lengths))
    return np.concatenate([xy, draw(arrays(np.float32, (*shape, 1), elements=angles))], -1)


def assert_same(a, b, metres=METRES, radians=RADIANS):
    a, b = np.asarray(a), np.asarray(b)
    np.testing.assert_allclose(a[..., :2], b[..., :2], atol=metres, rtol=0)
    assert se2.angle_gap(a[..., 2], b[..., 2]).max() <= radians


@given(arrays(np.float32, 16, elements=st.floats(-1e3, 1e3, width=32)))
def test_wrapped_angle_is_the_same_direction_in_range(angle):
    wrapped = np.asarray(geometry.wrap_angle(jnp.asarray(angle)))
    assert (wrapped >= -PI).all() and (wrapped < PI).all()
    assert se2.angle_gap(wrapped, angle).max() <= 1e3 * 2.0**-22


@pytest.mark.parametrize("turns", [-3, -1, 0, 1, 2])
def test_wrap_at_the_seam(turns):
    seam = np.float32(PI + turns * 2 * np.pi)
    around = np.array([np.nextafter(seam, np.float32(s)) for s in (-1e9, 1e9)] + [seam], np.float32)
    wrapped = np.asarray(jax.jit(geometry.wrap_angle)(around))
    assert (wrapped >= -PI).all() and (wrapped < PI).all()
    assert se2.angle_gap(wrapped, around).max() <= 1e-5


def test_wrap_literals():
    given_degrees = np.array([0.0, 90.0, 180.0, -180.0, 270.0, 359.0, -540.0, 720.0])
    expected = np.array([0.0, 90.0, -180.0, -180.0, -90.0, -1.0, -180.0, 0.0])
    wrapped = np.degrees(np.asarray(geometry.wrap_angle(jnp.asarray(np.radians(given_degrees), jnp.float32))))
    assert np.degrees(se2.angle_gap(np.radians(wrapped), np.radians(expected))).max() < 1e-3


@given(poses(), poses(()))
def test_compose_is_the_matrix_product(a, b):
    assert_same(geometry.compose(jnp.asarray(a), jnp.asarray(b)), se2.compose(a, b))


@given(poses((3,)), poses((2, 1)))
def test_shapes_broadcast(a, b):
    composed = geometry.compose(jnp.asarray(a), jnp.asarray(b))
    assert composed.shape == (2, 3, 3)
    assert_same(composed, se2.compose(a, b))


@given(poses(), poses(()), poses(()))
def test_associative(a, b, c):
    a, b, c = map(jnp.asarray, (a, b, c))
    left = geometry.compose(geometry.compose(a, b), c)
    # An angle rounded by 2e-6 turns an arm of 70 m by 1.4e-4 m.
    assert_same(left, geometry.compose(a, geometry.compose(b, c)), metres=3e-4)


@given(poses())
def test_inverse_and_identity(a):
    a = jnp.asarray(a)
    identity = jnp.zeros(3)
    assert_same(geometry.compose(a, geometry.inverse(a)), np.zeros(a.shape), metres=3e-4)
    assert_same(geometry.compose(geometry.inverse(a), a), np.zeros(a.shape), metres=3e-4)
    assert_same(geometry.compose(a, identity), a)
    assert_same(geometry.compose(identity, a), a)


@given(poses(), poses(()))
def test_relative_undoes_compose(a, b):
    a, b = jnp.asarray(a), jnp.asarray(b)
    assert_same(geometry.relative(a, geometry.compose(a, b)), jnp.broadcast_to(b, a.shape), metres=3e-4)
    assert_same(geometry.relative(a, b), geometry.compose(geometry.inverse(a), b), metres=3e-4)


@given(poses(), arrays(np.float32, (5, 2), elements=lengths))
def test_points_are_transformed_by_the_matrix(pose, points):
    moved = geometry.transform_points(jnp.asarray(pose), jnp.asarray(points))
    homogeneous = np.concatenate([points, np.ones((5, 1))], -1)
    expected = (se2.matrix(pose) @ homogeneous.T).swapaxes(-1, -2)[..., :2]
    np.testing.assert_allclose(moved, expected, atol=METRES)


def test_quarter_turn_by_hand():
    # One metre ahead of a robot at (2, 1) that faces along +y, and two metres to its left.
    pose = jnp.array([2.0, 1.0, np.pi / 2])
    np.testing.assert_allclose(geometry.compose(pose, jnp.array([1.0, 2.0, 0.0])), [0.0, 2.0, np.pi / 2], atol=1e-6)
    np.testing.assert_allclose(geometry.rotate(np.float32(np.pi / 2), 1.0, 0.0), (0.0, 1.0), atol=1e-6)


def test_mean_across_the_seam_and_by_weight():
    poses = jnp.array([[0.0, 0.0, np.pi - 0.1], [4.0, 2.0, -np.pi + 0.1]])
    mean = np.asarray(geometry.mean_pose(poses, jnp.array([0.5, 0.5])))
    np.testing.assert_allclose(mean[:2], [2.0, 1.0], atol=1e-6)
    assert se2.angle_gap(mean[2], np.pi) < 1e-6
    np.testing.assert_allclose(geometry.mean_pose(poses, jnp.array([0.0, 1.0])), poses[1], atol=1e-6)


@given(arrays(np.float32, (2, 7), elements=angles), arrays(np.float32, (2, 7), elements=st.floats(0.0625, 1, width=32)))
def test_circular_mean_is_the_argument_of_the_resultant(theta, weights):
    resultant = (weights * np.exp(1j * theta.astype(np.float64))).sum(-1)
    mean = np.asarray(geometry.circular_mean(jnp.asarray(theta), jnp.asarray(weights)))
    known = np.abs(resultant) > 1e-2
    assert (se2.angle_gap(mean, np.angle(resultant))[known] < 1e-4).all()


@given(poses(()), poses(()))
def test_headings_are_wrapped(a, b):
    """Also where both headings lie beyond the seam: all functions of poses give angles in [-pi, pi)."""
    a, b = jnp.asarray(a), jnp.asarray(b)
    for pose in (geometry.compose(a, b), geometry.relative(a, b), geometry.inverse(a)):
        assert -PI <= float(pose[2]) < PI


@pytest.mark.parametrize(
    ("one", "other", "sum_", "difference"), [(3.0, 3.0, -0.283185, 0.0), (-3.0, 3.0, 0.0, -0.283185)]
)
def test_headings_across_the_seam_by_hand(one, other, sum_, difference):
    a, b = jnp.array([0.0, 0.0, one]), jnp.array([0.0, 0.0, other])
    assert float(geometry.compose(a, b)[2]) == pytest.approx(sum_, abs=1e-5)
    assert float(geometry.relative(a, b)[2]) == pytest.approx(difference, abs=1e-5)
