from dataclasses import replace

import numpy as np
import pytest
from led_scenes import random_poses, seven_leds
from pinhole import PinholeCamera

from bricktrack_common.brick_model import ProfileEntry
from bricktrack_host.quality import LedFlag
from bricktrack_host.tracking.centroid_noise import with_measured_noise
from bricktrack_host.tracking.frame_errors import frame_errors
from bricktrack_host.tracking.led_model.led_profile import predict_brick
from bricktrack_host.tracking.odd_leds import (
    odd_leds_px,
    with_odd_leds_doubted,
    words_on_odd_leds,
    words_on_unused_leds,
)
from bricktrack_host.tracking.optical_track import solve_poses, start_poses
from bricktrack_host.tracking.pictures.light_kernel import FLOOR_SD_PX
from bricktrack_host.tracks import LedObservations

CAMERA = PinholeCamera()
PROFILE = ProfileEntry(collar_mm=0.7, source="test", shift_sd_per_radius=0.0)
BRICK = replace(seven_leds(), led_profile=PROFILE)
N = 25


def shaken(seed):
    """Poses of a brick that moves by a few millimetres and degrees about one place."""
    R, t = random_poses(1, seed=seed)
    turns, shifts = random_poses(N, seed=seed + 1, tilt_deg=3.0)
    return R @ turns, t + 0.3 * (shifts - shifts.mean(axis=0))


def seen(R, t, *, off_px, seed, sd_px=0.02):
    """What a camera sees of each LED; ``off_px`` (7, 2) is added in every frame."""
    prediction, _ = predict_brick(R, t, CAMERA, BRICK, collar_mm=0.7)
    uv = prediction.uv_px + np.random.default_rng(seed).normal(0, sd_px, (N, 7, 2)) + off_px
    return LedObservations(
        sensor_timestamp_ns=np.arange(N, dtype=np.int64) * 33_333_333,
        exposure_ns=np.full(N, 4_000_000),
        uv_px=uv,
        cov_px2=np.tile(FLOOR_SD_PX**2 * np.eye(2), (N, 7, 1, 1)),
        area_px2=np.full((N, 7), 3500.0),
        led_flags=np.zeros((N, 7), dtype=np.int64),
        frame_flags=np.zeros(N, dtype=np.int64),
    )


def off(led, *uv_px):
    out = np.zeros((7, 2))
    out[led] = uv_px
    return out


def found(observations):
    first = start_poses(observations, CAMERA, BRICK)
    return odd_leds_px(frame_errors(observations, first, CAMERA, BRICK, rolling_shutter=False))


@pytest.mark.parametrize(("led", "uv_px"), [(0, (1.0, 0.0)), (2, (0.0, 1.2)), (4, (-0.8, 0.8))])
def test_an_led_beside_its_place_is_found_with_its_distance(led, uv_px):
    px = found(seen(*shaken(3), off_px=off(led, *uv_px), seed=4))
    # Each of u and v; six LEDs tell of an end of the pattern to a tenth of a pixel.
    assert px[led] == pytest.approx(np.hypot(*uv_px) / np.sqrt(2), abs=0.15)
    np.testing.assert_array_equal(np.delete(px, led), 0.0)


def test_sound_leds_are_not_doubted():
    standing = np.random.default_rng(5).normal(0, 0.05, (20, 7, 2))  # limb, rays: as all LEDs have them
    for seed in range(20):
        assert not found(seen(*shaken(seed), off_px=standing[seed], seed=seed)).any()


def test_leds_that_are_all_beside_their_places_are_not_told_apart():
    standing = np.random.default_rng(6).normal(0, 1.0, (7, 2))
    assert not found(seen(*shaken(7), off_px=standing, seed=8)).any()


def test_four_others_are_too_few_to_judge():
    observations = seen(*shaken(9), off_px=off(1, 2.0, 0.0), seed=10)
    observations.uv_px[:, 5:] = np.nan
    assert not found(observations).any()


def test_poses_are_freed_of_an_odd_led_and_say_so():
    R, t = shaken(11)
    observations = seen(R, t, off_px=off(6, 1.0, 0.7), seed=12)
    first = start_poses(observations, CAMERA, BRICK)
    errors = frame_errors(observations, first, CAMERA, BRICK, rolling_shutter=False)
    doubted, doubted_errors = with_odd_leds_doubted(observations, errors)
    assert ((doubted.led_flags == LedFlag.OUTLIER) == (np.arange(7) == 6)).all()
    assert [words_on_odd_leds(o, BRICK) != [] for o in (observations, doubted)] == [False, True]
    assert "LED m6" in words_on_odd_leds(doubted, BRICK)[0]
    rms_mm = []
    for each, of_each in ((observations, errors), (doubted, doubted_errors)):
        told = with_measured_noise(each, of_each)
        track = solve_poses(told, CAMERA, BRICK, first=first, rolling_shutter=False)
        rms_mm.append(np.sqrt(np.mean((track.t_camera_brick_mm - t) ** 2)))
    assert rms_mm[1] < 0.3 * rms_mm[0]


def test_an_led_that_was_hardly_used_is_named_with_the_reason():
    R, t = shaken(4)
    run = seen(R, t, off_px=0.0, seed=4)
    assert words_on_unused_leds(run, BRICK) == []
    flags = run.led_flags.copy()
    flags[:, 2] = int(LedFlag.MISSING)
    flags[:21, 4], flags[21:24, 4] = int(LedFlag.PARTLY_COVERED), int(LedFlag.MISSING)
    flags[:20, 5] = int(LedFlag.MISSING)  # hidden for most of the run only
    flags[24] = int(LedFlag.MISSING)  # a picture without any says nothing of single ones
    (words,) = words_on_unused_leds(replace(run, led_flags=flags), BRICK)
    assert "m2, used in 0 of 24 frames (not found in 25); m4, used in 0 of 24 frames" in words
    assert "(partly covered in 21, not found in 4)" in words
    assert "m5" not in words
