"""Quaternions in NumPy alone are SciPy's rotations, over any leading axes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vehsim.lie.quaternions import (
    angles_between,
    conjugate,
    continuous,
    cross,
    from_vectors,
    from_yaw,
    matrices,
    product,
    quaternions,
    right_jacobian,
    right_jacobian_inverse,
    rotate,
    rotation_vectors,
    tilt_of,
    yaw_of,
    yaw_tilt,
)

LEADS = [(), (5,), (2, 3)]


def turns(lead, seed=1):
    q = np.random.default_rng(seed).normal(size=(*lead, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def scipys(q):
    return Rotation.from_quat(q.reshape(-1, 4), scalar_first=True)


def same(q, rotation, atol=1e-14):
    """Quaternions q (..., 4) are these rotations, of either sign."""
    expected = rotation.as_quat(scalar_first=True)
    signs = np.sign((q.reshape(-1, 4) * expected).sum(axis=1))[:, None]
    np.testing.assert_allclose(q.reshape(-1, 4), signs * expected, atol=atol)


@pytest.mark.parametrize("lead", LEADS)
def test_matrices_products_and_vectors(lead):
    p, q, v = turns(lead), turns(lead, 2), np.random.default_rng(3).normal(size=(*lead, 3))
    shape = (*lead, 3, 3)
    np.testing.assert_allclose(matrices(p), scipys(p).as_matrix().reshape(shape), atol=1e-14)
    same(product(p, q), scipys(p) * scipys(q))
    same(conjugate(p), scipys(p).inv())
    same(from_vectors(v), Rotation.from_rotvec(v.reshape(-1, 3)))
    np.testing.assert_allclose(rotate(p, v), scipys(p).apply(v.reshape(-1, 3)).reshape(v.shape), atol=1e-14)
    np.testing.assert_allclose(from_vectors(rotation_vectors(p)), p, atol=1e-14)
    angles = (scipys(p).inv() * scipys(q)).magnitude().reshape(lead)
    np.testing.assert_allclose(angles_between(p, q), angles, atol=1e-13)
    if len(lead) < 2:
        np.testing.assert_allclose(cross(p[..., 1:], v), np.cross(p[..., 1:], v), atol=1e-15)


@pytest.mark.parametrize("lead", LEADS)
def test_yaw_and_tilt(lead):
    yaw = np.random.default_rng(4).uniform(-3, 3, lead)
    same(from_yaw(yaw), Rotation.from_euler("z", np.reshape(yaw, (-1, 1))))
    np.testing.assert_allclose(yaw_of(from_yaw(yaw)), yaw, atol=1e-14)
    np.testing.assert_allclose(yaw_of(turns(lead)), scipys(turns(lead)).as_euler("ZYX")[:, 0].reshape(lead), atol=1e-13)


def test_yaw_pitch_and_roll_round_trip():
    yaw, pitch, roll = angles = np.random.default_rng(5).uniform(-1.5, 1.5, (3, 40))
    same(yaw_tilt(*angles), Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll])))
    np.testing.assert_allclose(tilt_of(yaw_tilt(*angles)), angles, atol=1e-13)


def test_matrices_of_every_largest_component_and_back():
    rotations = Rotation.concatenate([Rotation.random(300, rng=1), Rotation.from_rotvec(np.pi * np.eye(3))])
    R = rotations.as_matrix()
    same(quaternions(R), rotations)
    np.testing.assert_allclose(matrices(quaternions(R)), R, atol=1e-14)
    assert quaternions(R[0]).shape == (4,)


def test_angles_near_zero_keep_their_digits():
    q = turns((3,))
    tiny = product(q, from_vectors(np.tile([0.0, 3e-9, 4e-9], (3, 1))))
    np.testing.assert_allclose(angles_between(q, tiny), 5e-9, rtol=1e-6)


def test_signs_flip_nowhere():
    q = from_yaw(np.linspace(0, 9, 30))
    flipped = q * np.where(np.arange(30) % 3, 1, -1)[:, None]
    np.testing.assert_array_equal(continuous(flipped), -q)
    assert continuous(q) is q


@pytest.mark.parametrize("size", [1e-6, 1.0, 3.0])
def test_right_jacobian_is_the_body_rate_of_a_changing_rotation_vector(size):
    rng = np.random.default_rng(6)
    phi, v = rng.normal(size=(2, 20, 3))
    phi *= size / np.linalg.norm(phi, axis=1, keepdims=True)
    h = 1e-5
    ahead, behind = (from_vectors(phi + sign * h * v) for sign in (1, -1))
    rate = rotation_vectors(product(conjugate(behind), ahead)) / (2 * h)
    np.testing.assert_allclose(right_jacobian(phi, v), rate, atol=1e-8)
    np.testing.assert_allclose(right_jacobian_inverse(phi, right_jacobian(phi, v)), v, atol=1e-9)
