"""Cubics through samples are SciPy's, with their derivatives and integrals."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from bricktrack_host.fusion.inertial.cubic_pieces import cubic_through

ROUNDING = 1e-9  # of values near one over steps of 10 ms: third powers of 100 from rounding at 1e-16


@pytest.mark.parametrize("n", [2, 3, 4, 5, 400])
def test_values_derivatives_and_integrals_are_those_of_scipy(n):
    rng = np.random.default_rng(n)
    t_s = np.cumsum(rng.uniform(0.004, 0.03, n))
    values = rng.normal(size=(n, 3))
    ours, peers = cubic_through(t_s, values), CubicSpline(t_s, values)
    # In no order, on the knots, and a little beyond both ends.
    at = rng.permutation(np.concatenate([t_s, rng.uniform(t_s[0] - 0.01, t_s[-1] + 0.01, 999)]))
    for order in range(3):
        scale = np.abs(peers(at, order)).max()
        np.testing.assert_allclose(ours(at, order), peers(at, order), atol=ROUNDING * scale)
    once, twice = ours.antiderivative(), ours.antiderivative().antiderivative()
    np.testing.assert_allclose(once(at), peers.antiderivative()(at), atol=ROUNDING)
    np.testing.assert_allclose(twice(at), peers.antiderivative(2)(at), atol=ROUNDING)
    assert ours(at[:6].reshape(2, 3)).shape == (2, 3, 3)


def test_no_instant_has_no_value():
    values = cubic_through(np.arange(5.0), np.ones((5, 3)))(np.array([1.5, np.nan, 3.0]))
    assert np.isfinite(values).all(axis=1).tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("x", "value"), [(np.array([0.0, 1, 1, 2]), 1.0), (np.arange(4.0), np.nan), (np.zeros(1), 1.0)]
)
def test_what_has_no_spline_is_refused(x, value):
    with pytest.raises(ValueError, match="finite values at increasing knots"):
        cubic_through(x, np.full((len(x), 3), value))
