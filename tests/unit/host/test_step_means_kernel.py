"""Means over steps, against NumPy's own interpolation."""

import numpy as np

from bricktrack_host.fusion.inertial.step_means_kernel import step_means


def test_means_over_steps_are_those_of_numpys_interpolation():
    # Points beyond both ends, steps in any order, and some points that count as zero.
    rng = np.random.default_rng(2)
    t_s = np.cumsum(rng.uniform(0.005, 0.02, 50))
    values = rng.normal(size=(50, 3))
    points = rng.uniform(-0.1, t_s[-1] + 0.1, (40, 1)) + 0.002 * np.arange(4)
    counts = rng.random((40, 4)) > 0.2
    wanted = [(np.interp(points, t_s, column) * counts).mean(axis=1) for column in values.T]
    np.testing.assert_allclose(step_means(t_s, values, points, counts), np.stack(wanted, axis=1), atol=1e-12)
