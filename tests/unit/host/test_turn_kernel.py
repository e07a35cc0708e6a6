"""Turns between attitudes against SciPy's rotations: small, large, none, and half a turn."""

import numpy as np
from scipy.spatial.transform import Rotation

from bricktrack_host.tracking.pose.turn_kernel import angles_between, turns_between


def test_turns_are_scipys():
    rng = np.random.default_rng(4)
    here = rng.normal(scale=1.0, size=(40, 3))
    there = here[:, None] + rng.normal(size=(40, 6, 3)) * [[1e-14], [1e-9], [1e-4], [0.1], [1.0], [3.0]]
    expected = Rotation.from_rotvec(np.repeat(here, 6, axis=0)).inv() * Rotation.from_rotvec(
        there.reshape(-1, 3)
    )
    # Rounding of unit quaternions; SciPy's own is of that size.
    np.testing.assert_allclose(turns_between(here, there).reshape(-1, 3), expected.as_rotvec(), atol=4e-15)


def test_no_turn_is_nothing_and_half_a_turn_is_pi():
    here, there = np.zeros((2, 3)), np.array([[[0.0, 0.0, 0.0]], [[0.0, np.pi, 0.0]]])
    turn = turns_between(here, there)[:, 0]
    np.testing.assert_array_equal(turn[0], 0.0)
    np.testing.assert_allclose(np.abs(turn[1]), [0.0, np.pi, 0.0], atol=1e-15)


def test_more_than_half_a_turn_is_told_the_short_way():
    turn = turns_between(np.array([[0.0, 0.0, -2.0]]), np.array([[[0.0, 0.0, 2.0]]]))
    np.testing.assert_allclose(turn, [[[0.0, 0.0, 4.0 - 2 * np.pi]]], atol=1e-15)


def test_angles_between_matrices_are_right_from_none_to_half_a_turn():
    rng = np.random.default_rng(4)
    angle = np.concatenate([[0.0, 1e-9, 1e-4, np.pi - 1e-6, np.pi], rng.uniform(0, np.pi, 50)])
    axis = rng.normal(size=(len(angle), 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    here = Rotation.random(len(angle), random_state=rng)
    there = here * Rotation.from_rotvec(angle[:, None] * axis)
    # Near half a turn the matrices themselves hold the angle to some 1e-16.
    np.testing.assert_allclose(angles_between(here.as_matrix(), there.as_matrix()), angle, atol=1e-14)
    assert np.isnan(angles_between(np.full((1, 3, 3), np.nan), np.eye(3)[None])[0])
