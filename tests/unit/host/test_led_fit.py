from dataclasses import replace

import numpy as np
import pytest
from led_scenes import leds_in_camera, lit_outline, polygon_centroid, random_poses, seven_leds
from pinhole import PinholeCamera

from bricktrack_common.errors import CalibrationError
from bricktrack_host.quality import PoseFlag
from bricktrack_host.tracking.led_fit import fit_collar, with_profile_of_run
from bricktrack_host.tracking.optical_track import solve_poses, start_poses
from bricktrack_host.tracking.sweep_frames import words_on_left_out
from bricktrack_host.tracks import LedObservations

CAMERA = PinholeCamera()
BRICK = seven_leds()


def sweep(collar, *, n=12, sd=0.03, seed=1, brick=BRICK):
    """Centroids of true outlines, by no product code, with noise."""
    R, t = random_poses(n, seed=seed)
    axes = np.einsum("nij,lj->nli", R, brick.led_axes)
    uv = np.array(
        [
            [
                polygon_centroid(lit_outline(c, a, radius=3.0, collar=collar, camera=CAMERA, n=120))[0]
                for c, a in zip(centres, frame_axes, strict=True)
            ]
            for centres, frame_axes in zip(leds_in_camera(R, t, brick), axes, strict=True)
        ]
    )
    uv += np.random.default_rng(seed).normal(0, sd, uv.shape)
    return LedObservations(
        sensor_timestamp_ns=np.arange(n) * 33_000_000,
        exposure_ns=np.full(n, 4_000_000),
        uv_px=uv,
        cov_px2=np.broadcast_to(0.06**2 * np.eye(2), (n, 7, 2, 2)).copy(),
        area_px2=np.full((n, 7), 3500.0),
        led_flags=np.zeros((n, 7), dtype=np.int64),
        frame_flags=np.zeros(n, dtype=np.int64),
    )


@pytest.mark.parametrize("collar", [-1.8, -0.5, 0.0, 0.3, 0.9, 2.0])
def test_the_collar_of_a_sweep_is_found(collar):
    fit = fit_collar(sweep(collar), CAMERA, BRICK)
    # Noise of 0.03 px over 84 LEDs is a few micrometres of collar; the profile's own error adds 0.01 mm.
    assert fit.collar_mm == pytest.approx(collar, abs=4 * fit.sd_mm + 0.02)
    assert 0.0 < fit.sd_mm < 0.05
    assert fit.is_believable
    assert fit.cross_validated_rms_px < 0.05
    assert fit.rms_without_px > 2 * fit.cross_validated_rms_px
    assert (fit.n_frames, fit.n_leds) == (12, 84)


def test_leds_in_nearly_one_plane_tell_their_collar_too():
    flat = replace(BRICK, led_positions_mm=BRICK.led_positions_mm * [1.0, 1.0, 0.05])
    fit = fit_collar(sweep(0.9, brick=flat), CAMERA, flat)
    assert fit.collar_mm == pytest.approx(0.9, abs=4 * fit.sd_mm + 0.02)
    assert fit.n_frames == 12


@pytest.mark.parametrize("off_px", [(0.3, 0.0), (1.0, -0.5), (8.0, 0.0)])
def test_a_dirty_led_is_named_and_left_out(off_px):
    seen = sweep(0.9)
    dirty = replace(seen, uv_px=seen.uv_px.copy())
    dirty.uv_px[:, 3] += off_px
    clean = replace(seen, uv_px=seen.uv_px.copy())
    clean.uv_px[:, 3] = np.nan
    fit, without = fit_collar(dirty, CAMERA, BRICK), fit_collar(clean, CAMERA, BRICK)
    assert np.flatnonzero(fit.left_out_px).tolist() == [3]
    # Each of u and v; some of it turns the pose that the others share in no test of this LED.
    assert fit.left_out_px[3] == pytest.approx(np.hypot(*off_px) / np.sqrt(2), rel=0.15)
    assert fit.collar_mm == pytest.approx(without.collar_mm, abs=1e-6)
    assert fit.n_leds == 72
    assert fit.is_believable
    assert "LED m3 (" in words_on_left_out(fit.left_out_px, BRICK)


def test_clean_leds_are_all_used():
    for seed in (2, 3):
        assert not fit_collar(sweep(0.9, n=8, seed=seed), CAMERA, BRICK).left_out_px.any()


def test_more_dirty_leds_than_the_others_can_outvote_are_refused():
    seen = sweep(0.9)
    seen.uv_px[:, 6] = np.nan  # six are left, of which one may be odd
    seen.uv_px[:, 2] += [4.0, 0.0]
    assert np.flatnonzero(fit_collar(seen, CAMERA, BRICK).left_out_px).tolist() == [2]
    seen.uv_px[4:, 5] = np.nan  # without it, five are in four frames only
    with pytest.raises(CalibrationError, match=r"left out: LED m2 .* Then: 4 frames with 5"):
        fit_collar(seen, CAMERA, BRICK)


def test_too_few_frames_are_refused():
    with pytest.raises(CalibrationError, match="needs 5"):
        fit_collar(sweep(0.7, n=4), CAMERA, BRICK)


def test_leds_that_show_something_else_are_refused():
    seen = sweep(0.0)
    R, t = random_poses(12, seed=1)
    # Centroids far beyond a tall dome's: a spotlight in front, or axes that point elsewhere.
    tips = leds_in_camera(R, t, BRICK) + 6.0 * np.einsum("nij,lj->nli", R, BRICK.led_axes)
    seen.uv_px[:] = CAMERA.project(tips).uv_px
    with pytest.raises(CalibrationError, match="do not determine the collar|expected -6 to 6 mm"):
        fit_collar(seen, CAMERA, BRICK)


def test_a_run_without_a_profile_tells_its_own():
    seen = sweep(0.8, n=10)
    first = start_poses(seen, CAMERA, BRICK)
    told = with_profile_of_run(seen, first, CAMERA, BRICK, rolling_shutter=False)
    assert told.led_profile.collar_mm == pytest.approx(0.8, abs=0.05)
    assert told.led_profile.shift_sd_per_radius >= 0.005
    before = solve_poses(seen, CAMERA, BRICK, first=first, rolling_shutter=False)
    after = solve_poses(seen, CAMERA, told, first=first, rolling_shutter=False)
    assert ((after.flags & PoseFlag.LED_PROFILE_UNKNOWN) != 0).all()
    _, t = random_poses(10, seed=1)
    off = [np.sqrt(np.mean((track.t_camera_brick_mm - t) ** 2)) for track in (before, after)]
    assert off[1] < 0.3 * off[0]
    # A layout's own profile stays, and a run that tells nothing leaves things as they were.
    assert with_profile_of_run(seen, first, CAMERA, told, rolling_shutter=False) is told
    few = sweep(0.8, n=3)
    none = with_profile_of_run(few, start_poses(few, CAMERA, BRICK), CAMERA, BRICK, rolling_shutter=False)
    assert none is BRICK
