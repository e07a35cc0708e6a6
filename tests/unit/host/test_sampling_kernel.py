"""Covariances between nodes, against NumPy's products."""

import numpy as np

from bricktrack_host.fusion.pose_by_pose.sampling_kernel import covariance_between


def test_covariances_are_carried_by_the_derivative_and_linear_between_nodes():
    rng = np.random.default_rng(1)
    root, H = rng.standard_normal((5, 8, 8)), rng.standard_normal((4, 6, 8))
    H[:, 1, 2:5] = 0.0
    at_nodes = root @ np.swapaxes(root, 1, 2)
    node, share = np.array([0, 3, 2, 4]), np.array([0.25, 0.75, 0.0, 0.0])
    after = np.minimum(node + 1, 4)
    part = share[:, None, None]
    expected = H @ ((1 - part) * at_nodes[node] + part * at_nodes[after]) @ np.swapaxes(H, 1, 2)
    found = covariance_between(at_nodes, node, share, H)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(found, np.swapaxes(found, 1, 2))
