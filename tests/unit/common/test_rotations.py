"""Rotations against SciPy, which shares no code with ours, and against hand-worked numbers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bricktrack_common.errors import ShapeError
from bricktrack_common.poses import Pose
from bricktrack_common.rotations import (
    angles_xyz_from_matrix,
    continuous_quaternions,
    matrix_from_angles_xyz,
    matrix_from_quaternion,
    matrix_from_rvec,
    nearest_rotation,
    quaternion_from_matrix,
    right_jacobian,
    rvec_from_matrix,
)

TIGHT = 1e-12  # some thousand roundings of double precision
RVECS = np.concatenate(
    [
        np.random.default_rng(1).normal(size=(200, 3)),
        np.random.default_rng(2).normal(size=(50, 3)) * 1e-7,
        np.zeros((1, 3)),
        np.pi * np.eye(3) * (1 - 1e-9),
    ]
)
vectors = st.lists(st.floats(-3, 3), min_size=3, max_size=3).map(np.array)


def test_matrices_agree_with_scipy():
    np.testing.assert_allclose(matrix_from_rvec(RVECS), Rotation.from_rotvec(RVECS).as_matrix(), atol=TIGHT)


def test_rotation_vectors_agree_with_scipy():
    R = Rotation.from_rotvec(RVECS).as_matrix()
    np.testing.assert_allclose(rvec_from_matrix(R), Rotation.from_matrix(R).as_rotvec(), atol=1e-7)


def test_quaternions_are_scalar_first_and_survive_the_round_trip():
    np.testing.assert_allclose(
        quaternion_from_matrix(matrix_from_rvec([0, 0, np.pi / 2])), [0.5**0.5, 0, 0, 0.5**0.5]
    )
    R = matrix_from_rvec(RVECS)
    np.testing.assert_allclose(matrix_from_quaternion(quaternion_from_matrix(R)), R, atol=TIGHT)


def test_angles_are_intrinsic_xyz():
    R = matrix_from_rvec(RVECS[:200])
    np.testing.assert_allclose(angles_xyz_from_matrix(R), Rotation.from_matrix(R).as_euler("XYZ"), atol=TIGHT)
    np.testing.assert_allclose(matrix_from_angles_xyz(angles_xyz_from_matrix(R)), R, atol=TIGHT)


def test_a_turning_brick_has_quaternions_without_jumps():
    angles = np.linspace(0, 4 * np.pi, 200)
    q = continuous_quaternions(quaternion_from_matrix(matrix_from_rvec(angles[:, None] * [0, 0, 1.0])))
    q_with_hole = q.copy()
    q_with_hole[50:60] = np.nan
    assert np.abs(np.diff(q, axis=0)).max() < 0.05
    np.testing.assert_array_equal(continuous_quaternions(q_with_hole)[60:], q[60:])


def test_nearest_rotation_mends_noise_and_never_mirrors():
    R = matrix_from_rvec([0.3, -0.2, 0.5])
    np.testing.assert_allclose(nearest_rotation(R * 1.1), R, atol=TIGHT)
    assert np.linalg.det(nearest_rotation(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1)


@settings(max_examples=50, deadline=None)
@given(vectors)
def test_right_jacobian_meets_finite_differences(r):
    step = 1e-6
    for i in range(3):
        d = step * np.eye(3)[i]
        change = rvec_from_matrix(matrix_from_rvec(r).T @ matrix_from_rvec(r + d)) / step
        np.testing.assert_allclose(
            right_jacobian(r)[:, i], change, atol=1e-5
        )  # error of the difference: step / 2


@settings(max_examples=50, deadline=None)
@given(vectors, vectors, vectors, vectors, vectors)
def test_poses_compose_and_invert(r1, t1, r2, t2, p):
    a, b = Pose(matrix_from_rvec(r1), t1), Pose(matrix_from_rvec(r2), t2)
    np.testing.assert_allclose((a @ b).apply(p), a.apply(b.apply(p)), atol=1e-11)
    np.testing.assert_allclose(a.inverse().apply(a.apply(p)), p, atol=1e-11)


def test_a_pose_refuses_what_is_no_rotation():
    with pytest.raises(ShapeError, match="not orthonormal: off by 3"):
        Pose(2 * np.eye(3), np.zeros(3))
    with pytest.raises(ShapeError, match="mirrors"):
        Pose(np.diag([1.0, 1.0, -1.0]), np.zeros(3))
    with pytest.raises(ShapeError, match=r"shape \(2,\); expected \(..., 3\)"):
        Pose(np.eye(3), np.zeros(2))


def test_a_missing_pose_is_nan_and_passes():
    R = np.stack([np.eye(3), np.full((3, 3), np.nan)])
    assert np.isnan(Pose(R, np.zeros((2, 3))).apply(np.ones(3))[1]).all()
