"""Motion and covariance between nodes, against NumPy's products and a motion known in closed form."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from bricktrack_common.rotations import matrix_from_rvec
from bricktrack_host.fusion.inertial.signal_kernel import SignalPieces
from bricktrack_host.fusion.pose_by_pose.sampling_kernel import (
    Path,
    carry_between,
    covariance_between,
    shared_between,
)
from bricktrack_host.fusion.smoothing.smoother import BG, GRAV, POS, SEEN, TAU, VEL, State, observe


def test_covariances_are_carried_by_the_derivative_and_linear_between_nodes():
    rng = np.random.default_rng(1)
    root, R = rng.standard_normal((5, 10, 10)), matrix_from_rvec(rng.standard_normal((4, 3)))
    at_nodes = root @ np.swapaxes(root, 1, 2)
    of = np.array([1, 2, 3, 4, 6, 7, 8, 9])
    node, share = np.array([0, 3, 2, 4]), np.array([0.25, 0.75, 0.0, 0.0])
    turn, v_point, arm, since = (rng.standard_normal(s) for s in ((4, 3), (4, 3), 3, 4))
    state = State(R, np.zeros((4, 22)))
    state.x[:, VEL] = v_point
    H = observe(state, turn, arm, since, np.zeros(4))[2]
    v_origin, further, common = H[:, 3:, TAU], rng.random((4, 2)), np.cov(rng.standard_normal((6, 20)))
    after, part = np.minimum(node + 1, 4), share[:, None, None]
    between = ((1 - part) * at_nodes[node] + part * at_nodes[after])[:, of][:, :, of]
    H = H[:, :, SEEN]
    to_mm = np.repeat([1.0, 1e3], 3)
    expected = H @ between @ np.swapaxes(H, 1, 2) + common
    expected += np.repeat(further, 3, axis=1)[:, :, None] * np.eye(6)
    found = np.empty((len(node), 6, 6))
    covariance_between(at_nodes, of, node, share, R, turn, v_origin, since, arm, further, common, found)
    np.testing.assert_allclose(found, expected * to_mm[:, None] * to_mm, rtol=1e-12, atol=1e-9)
    np.testing.assert_array_equal(found, np.swapaxes(found, 1, 2))
    shared = rng.standard_normal((5, 8, 6))
    with_others = np.empty((len(node), 6, 6))
    shared_between(shared, node, share, R, turn, v_origin, since, arm, with_others)
    expected = to_mm[:, None] * (H @ ((1 - part) * shared[node] + part * shared[after]))
    np.testing.assert_allclose(with_others, expected, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("is_smoothed", [True, False])
def test_a_steady_turn_and_pull_are_carried_exactly_and_a_miss_is_spread(is_smoothed):
    # About z at a steady rate, and a steady pull along z: attitude and place are known in closed form.
    rate, pull, gravity, bias = 2.0, 3.0, np.array([0.5, -1.0, -9.0]), np.array([0.1, -0.2, 0.3])
    knots_s = np.linspace(-0.1, 0.2, 31)
    gyro = CubicSpline(knots_s, np.tile(bias + np.array([0, 0, rate]), (31, 1)))
    acc = CubicSpline(knots_s, np.tile([0, 0, pull], (31, 1)))
    once = acc.antiderivative()
    pieces = SignalPieces(
        knots_s, (-0.1, 0.2), gyro.antiderivative().c, gyro.c, once.antiderivative().c, once.c, acc.c
    )
    node_s, x = np.array([0.0, 0.01, 0.02]), np.zeros((3, 22))
    R = Rotation.from_rotvec([[0, 0, rate * t] for t in node_s]).as_matrix()
    a, v0 = gravity + np.array([0, 0, pull]), np.array([0.3, 0.2, -0.1])
    x[:, VEL] = v0 + node_s[:, None] * a
    x[:, POS] = node_s[:, None] * v0 + 0.5 * node_s[:, None] ** 2 * a
    x[:, GRAV], x[:, BG] = gravity, bias
    miss_m, miss_rad = np.array([1e-4, -2e-4, 0.0]), np.array([0.0, 0.0, 1e-3])
    x[1, POS] += miss_m
    R[1] = R[1] @ matrix_from_rvec(miss_rad)
    t_s = np.array([0.0, 0.0025, 0.005, 0.01 - 1e-12])
    n, none = len(t_s), np.zeros((0, 2, 3))
    out = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    path = Path(node_s, R, x, pieces, 0.0, none)
    carry_between(path, t_s, np.zeros(n, dtype=np.int64), none, is_smoothed, *out)
    s = (t_s / 0.01)[:, None] if is_smoothed else np.zeros((n, 1))
    t = t_s[:, None]
    # By a cubic whose ends have no velocity of their own.
    p_m = t * v0 + 0.5 * t**2 * a + (3 * s**2 - 2 * s**3) * miss_m
    v_mps = v0 + t * a + 6 * (s - s**2) / 0.01 * miss_m
    turned = Rotation.from_rotvec(rate * t * [0, 0, 1] + s * miss_rad).as_matrix()
    np.testing.assert_allclose(out[0], turned, atol=1e-9)
    np.testing.assert_allclose(out[1], p_m, atol=1e-12)
    np.testing.assert_allclose(out[2], v_mps, atol=1e-9)
    np.testing.assert_allclose(out[3], np.tile([0, 0, rate], (n, 1)), atol=1e-12)
