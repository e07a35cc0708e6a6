from dataclasses import replace

import numpy as np
import pytest
from led_scenes import random_poses, seven_leds
from pinhole import PinholeCamera

from bricktrack_common.errors import CalibrationError
from bricktrack_host.tracking.led_model.led_profile import predict_brick
from bricktrack_host.tracking.led_positions import fit_positions, free_directions
from bricktrack_host.tracks import LedObservations

CAMERA = PinholeCamera()
LAYOUT = seven_leds(collar_mm=0.7)


def in_gauge(change_mm):
    """A change of positions less what no picture shows: by hand, a fit of turn and scale about the origin."""
    P = LAYOUT.led_positions_mm
    d = change_mm - change_mm[0]
    columns = [np.cross(axis, P).ravel() for axis in np.eye(3)] + [P.ravel()]
    A = np.column_stack(columns)[3:]
    return np.concatenate([np.zeros(3), d.ravel()[3:] - A @ np.linalg.lstsq(A, d.ravel()[3:], rcond=None)[0]])


def sweep(change_mm, *, n=30, sd=0.02, seed=1):
    R, t = random_poses(n, seed=seed)
    built = replace(LAYOUT, led_positions_mm=LAYOUT.led_positions_mm + change_mm)
    prediction, _ = predict_brick(R, t, CAMERA, built, collar_mm=0.7)
    return LedObservations(
        sensor_timestamp_ns=np.arange(n) * 33_000_000,
        exposure_ns=np.full(n, 4_000_000),
        uv_px=prediction.uv_px + np.random.default_rng(seed).normal(0, sd, (n, 7, 2)),
        cov_px2=np.broadcast_to(sd**2 * np.eye(2), (n, 7, 2, 2)).copy(),
        area_px2=np.full((n, 7), 3500.0),
        led_flags=np.zeros((n, 7), dtype=np.int64),
        frame_flags=np.zeros(n, dtype=np.int64),
    )


def test_leds_built_beside_their_places_are_found_there():
    change = np.random.default_rng(3).normal(0, 0.1, (7, 3))
    fit = fit_positions(sweep(change), CAMERA, LAYOUT)
    off = (fit.positions_mm - LAYOUT.led_positions_mm).ravel() - in_gauge(change)
    np.testing.assert_array_equal(fit.positions_mm[0], 0.0)
    assert (np.abs(off)[3:] < 4 * fit.sd_mm.ravel()[3:] + 0.002).all()
    assert fit.sd_mm.max() < 0.03  # 0.02 px over 30 frames; along the axes the profile's doubt stays
    assert fit.is_believable
    assert fit.rms_before_px > 3 * fit.cross_validated_rms_px


def test_one_led_off_its_place_is_no_outlier():
    change = np.zeros((7, 3))
    change[5] = [0.0, 0.4, 0.0]
    fit = fit_positions(sweep(change), CAMERA, LAYOUT)
    # The others know it, so that it moves alone.
    np.testing.assert_allclose(fit.positions_mm - LAYOUT.led_positions_mm, change, atol=0.02)
    assert np.flatnonzero(fit.odd_px).tolist() == [5]
    assert not fit.left_out_px.any()


def test_what_no_picture_shows_is_left_as_it_was():
    free = free_directions(LAYOUT.led_positions_mm)
    P = LAYOUT.led_positions_mm
    assert free.shape == (21, 14)
    for hidden in (P, np.cross([0.0, 0.0, 1.0], P), np.cross([1.0, 0.0, 0.0], P)):
        np.testing.assert_allclose(free.T @ hidden.ravel(), 0.0, atol=1e-9)
    # A brick built larger as a whole looks like one farther away: nothing is made of it.
    fit = fit_positions(sweep(0.002 * P), CAMERA, LAYOUT)
    np.testing.assert_allclose(fit.positions_mm, P, atol=0.01)


def test_right_positions_are_not_bettered():
    fit = fit_positions(sweep(np.zeros((7, 3))), CAMERA, LAYOUT)
    assert np.abs(fit.positions_mm - LAYOUT.led_positions_mm).max() < 0.02
    assert not fit.is_believable or fit.cross_validated_rms_px > 0.97 * fit.rms_before_px


def test_an_led_beyond_the_tolerance_is_refused():
    change = np.zeros((7, 3))
    change[5] = [0.0, 1.2, 0.0]
    with pytest.raises(CalibrationError, match=r"LED m5 comes out 1\.2\d mm .* within 0\.25 mm"):
        fit_positions(sweep(change), CAMERA, LAYOUT, tolerance_mm=0.05)


def test_a_light_that_is_at_no_one_place_is_left_out():
    # The reflection of a lamp, say: it wanders over the LED as the brick turns.
    seen = sweep(np.zeros((7, 3)))
    wandering = replace(seen, uv_px=seen.uv_px.copy())
    wandering.uv_px[:, 5] += np.random.default_rng(8).normal(0, 6.0, (30, 2))
    fit = fit_positions(wandering, CAMERA, LAYOUT)
    assert np.flatnonzero(fit.left_out_px).tolist() == [5]
    np.testing.assert_allclose(fit.positions_mm, LAYOUT.led_positions_mm, atol=0.02)
    np.testing.assert_allclose(fit.positions_mm[5], LAYOUT.led_positions_mm[5], atol=1e-6)


def test_an_origin_that_the_others_contradict_is_refused():
    seen = sweep(np.zeros((7, 3)))
    seen.uv_px[:, 0] += [2.0, 0.0]
    with pytest.raises(CalibrationError, match="LED m0, from which all the others are measured"):
        fit_positions(seen, CAMERA, LAYOUT)


def test_positions_without_a_profile_or_with_few_frames_are_refused():
    with pytest.raises(CalibrationError, match="led_profile"):
        fit_positions(sweep(np.zeros((7, 3))), CAMERA, seven_leds())
    with pytest.raises(CalibrationError, match="need 10"):
        fit_positions(sweep(np.zeros((7, 3)), n=5), CAMERA, LAYOUT)
