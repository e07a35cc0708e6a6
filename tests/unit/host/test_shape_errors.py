import numpy as np
import pytest

from bricktrack_host.fusion.led_by_led.shape_errors import N_SHAPES, shape_shifts_px

SIDE_ON_PX = np.array([[20.0, 0.0], [-18.0, 5.0], [19.0, -4.0], [5.0, 3.0]])


def covariance(angle_rad, side_on_px):
    by_error = shape_shifts_px(np.cos(angle_rad), side_on_px).reshape(-1, N_SHAPES)
    return by_error @ by_error.T


def test_leds_all_seen_at_one_angle_are_as_their_profile_says():
    cov = covariance(np.full(4, 0.9), SIDE_ON_PX)
    assert np.abs(cov).max() < 1e-12  # a tenth of the rest below would be 1e-2


def test_errors_are_a_process_over_the_angle_less_what_the_fit_took_out():
    # Drawn: errors that change over half a radian, and are the larger the more from in front an LED is seen.
    angle = np.array([0.95, 0.9, 0.5, 0.2])
    sd = 0.008 + 0.045 * np.exp(-angle / 0.25)
    alike = np.exp(-(np.subtract.outer(angle, angle) ** 2) / (2 * 0.5**2))
    drawn = np.random.default_rng(1).multivariate_normal(np.zeros(4), sd[:, None] * alike * sd, 200_000)
    drawn -= np.average(drawn, axis=1, weights=(SIDE_ON_PX**2).sum(axis=1))[:, None]
    px = (drawn[:, :, None] * SIDE_ON_PX).reshape(-1, 8)
    expected = px.T @ px / len(px)
    cov = covariance(angle, SIDE_ON_PX)
    # Of 200,000 draws a variance is known to 0.3 %; what lies between the knots, to a hundredth.
    assert np.abs(cov - expected).max() < 0.02 * expected.max()
    across = np.array([-3.0, 5.0]) / np.hypot(3.0, 5.0)
    assert across @ cov[6:, 6:] @ across == pytest.approx(0.0, abs=1e-12)


def test_what_two_leds_show_at_one_angle_they_show_the_same_way():
    # One radius side on, at the same angle, along different axes of the picture.
    angle = np.array([0.95, 0.9, 0.2, 0.2])
    side_on_px = np.array([[20.0, 0.0], [-18.0, 5.0], [5.0, 0.0], [0.0, 5.0]])
    by_error = shape_shifts_px(np.cos(angle), side_on_px)
    np.testing.assert_allclose(by_error[2, 0], by_error[3, 1], rtol=1e-12)
    assert np.linalg.norm(by_error[2, 0]) == pytest.approx(5 * 0.028, rel=0.2)  # radii at 11 degrees, px


def test_an_led_that_is_not_seen_has_no_errors():
    cov = covariance(np.array([0.9, 0.9, 0.3, 0.0]), SIDE_ON_PX * [[1], [1], [1], [0]])
    np.testing.assert_array_equal(cov[6:], 0.0)
    assert np.isfinite(cov).all()
