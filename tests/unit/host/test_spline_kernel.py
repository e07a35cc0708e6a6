import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from bricktrack_host.tracking.pose.spline_kernel import carried_by_spline, poses_as_vectors


@pytest.mark.parametrize("n", [2, 3, 4, 5, 30])
def test_a_brick_is_carried_as_scipys_spline_carries_it(n):
    rng = np.random.default_rng(n)
    t_s = np.cumsum(rng.uniform(0.03, 0.1, n))
    samples = rng.normal(size=(n, 6))
    led_t_s = t_s[:, None] + rng.uniform(-0.12, 0.12, (n, 4))  # beyond the neighbours, and beyond the ends
    turns, shifts = np.empty((2, n, 4, 3))
    carried_by_spline(samples, t_s, led_t_s, turns, shifts)
    at = CubicSpline(t_s, samples)(led_t_s)
    size = np.abs(at).max()  # far beyond the ends cubics grow, and so does what rounding leaves
    np.testing.assert_allclose(shifts, at[..., 3:] - samples[:, None, 3:], atol=1e-12 * size)
    here = Rotation.from_rotvec(np.repeat(samples[:, :3], 4, axis=0))
    expected = here.inv() * Rotation.from_rotvec(at[..., :3].reshape(-1, 3))
    off = expected.inv() * Rotation.from_rotvec(turns.reshape(-1, 3))
    assert off.magnitude().max() < 1e-12 * size


def test_poses_are_turns_from_the_middle_ones_attitude():
    rng = np.random.default_rng(1)
    R = Rotation.random(7, random_state=rng)
    t_mm = rng.normal(size=(7, 3))
    vectors = poses_as_vectors(R.as_matrix(), t_mm)
    np.testing.assert_allclose(vectors[:, :3], (R[3].inv() * R).as_rotvec(), atol=1e-13)
    np.testing.assert_array_equal(vectors[:, 3:], t_mm)
