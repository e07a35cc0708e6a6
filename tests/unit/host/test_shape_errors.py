import numpy as np
import pytest

from bricktrack_host.fusion.led_by_led.shape_errors import shape_covariance_px2

SIDE_ON_PX = np.array([[20.0, 0.0], [-18.0, 5.0], [19.0, -4.0], [5.0, 3.0]])


def test_leds_all_seen_at_one_angle_are_as_their_profile_says():
    cov = shape_covariance_px2(np.full(4, 0.9), SIDE_ON_PX)
    assert np.abs(cov).max() < 1e-12  # a tenth of the rest below would be 1e-3


def test_an_led_seen_from_in_front_is_unsure_along_its_axis():
    # Drawn: errors of 0.008 of the radius that change over half a radian, less what the others show on the mean.
    angle = np.array([0.95, 0.9, 1.0, 0.2])
    alike = np.exp(-(np.subtract.outer(angle, angle) ** 2) / (2 * 0.5**2))
    drawn = 0.008 * np.random.default_rng(1).multivariate_normal(np.zeros(4), alike, 200_000)
    drawn -= np.average(drawn, axis=1, weights=(SIDE_ON_PX**2).sum(axis=1))[:, None]
    px = (drawn[:, :, None] * SIDE_ON_PX).reshape(-1, 8)
    expected = px.T @ px / len(px)
    cov = shape_covariance_px2(angle, SIDE_ON_PX)
    # Of 200,000 draws a variance is known to 0.3 %.
    assert np.abs(cov - expected).max() < 0.015 * expected.max()
    across = np.array([-3.0, 5.0]) / np.hypot(3.0, 5.0)
    assert across @ cov[6:, 6:] @ across == pytest.approx(0.0, abs=1e-12)
    assert np.sqrt(np.trace(cov[6:, 6:])) == pytest.approx(0.05, abs=0.01)  # px, of 5.8


def test_an_led_that_is_not_seen_has_no_errors():
    cov = shape_covariance_px2(np.array([0.9, 0.9, 0.3, 0.0]), SIDE_ON_PX * [[1], [1], [1], [0]])
    np.testing.assert_array_equal(cov[6:], 0.0)
    assert np.isfinite(cov).all()
