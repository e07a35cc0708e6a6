"""How far centroids and samples are believed LED by LED: hand-made sightings and residuals."""

from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import pytest

from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.led_by_led import led_noise
from bricktrack_host.fusion.led_by_led.led_measurements import SeenLeds
from bricktrack_host.fusion.led_by_led.led_noise import (
    ALL_NEW,
    STATED_SCALES,
    InertialNoise,
    believed_covariance_px2,
    centroid_scales,
    choose_inertial_noise,
    pictures_alike,
    still_sightings,
)
from bricktrack_host.fusion.pose_by_pose.inertial_noise import NoiseLevel, NoiseParts


def sightings(frame, led, u_px):
    m = len(frame)
    values = {
        "frame": np.array(frame), "led": np.array(led), "t_ns": np.arange(m), "spread_ns": np.zeros(m),
        "exposure_ns": np.zeros(m, dtype=np.int64),
        "uv_px": np.stack([np.array(u_px, dtype=float), np.full(m, 500.0)], axis=1),
        "cov_px2": np.tile(1e-3 * np.eye(2), (m, 1, 1)),
    }  # fmt: skip
    return SeenLeds(**{f.name: values[f.name] for f in fields(SeenLeds)})


def test_a_picture_stands_still_where_it_was_a_frame_before():
    #                 first   stays  another LED  moves  a frame is missing
    leds = sightings([4, 5, 5, 6, 8], [1, 1, 2, 1, 1], [700.0, 700.2, 700.2, 702.0, 702.0])
    assert still_sightings(leds).tolist() == [True, True, False, False, False]


def test_the_first_picture_stands_still_where_the_next_one_is_in_its_place():
    #                 starts: moves  stops  stays         comes late, stays
    leds = sightings([0, 1, 2, 3, 2, 3], [1, 1, 1, 1, 3, 3], [700.0, 710.0, 720.0, 720.1, 900.0, 900.0])
    assert still_sightings(leds).tolist() == [False, False, False, True, True, True]


def test_a_picture_that_moves_is_no_surer_than_one_at_rest():
    leds = sightings([0, 1, 2, 3], [1, 1, 1, 1], [700.0, 700.1, 710.0, 740.0])
    leds.cov_px2[2:] = np.diag([0.01, 0.002]), np.diag([0.4, 0.05])  # stated: the more, the longer the smear
    still = still_sightings(leds)
    found = believed_covariance_px2(leds, still, np.array([0.2, 0.5]), ALL_NEW)
    np.testing.assert_allclose(found[:2], np.tile(0.25e-3 * np.eye(2), (2, 1, 1)), rtol=1e-12)
    # 0.2^2 of what is stated, and of the 0.5^2 at rest what 0.2^2 leaves out.
    np.testing.assert_allclose(found[2], np.diag([0.0004 + 0.00021, 0.00008 + 0.00021]), rtol=1e-12)
    np.testing.assert_allclose(found[3], np.diag([0.016 + 0.00021, 0.002 + 0.00021]), rtol=1e-12)
    # Surer at rest, as where errors repeat: nothing is added to those that move.
    found = believed_covariance_px2(leds, still, np.array([0.8, 0.3]), ALL_NEW)
    np.testing.assert_allclose(found[3], 0.64 * leds.cov_px2[3], rtol=1e-12)
    np.testing.assert_allclose(found[0], 0.09 * leds.cov_px2[0], rtol=1e-12)
    # An error that is one in four pictures, or six at rest: they are believed as one.
    found = believed_covariance_px2(leds, still, np.ones(2), np.array([4.0, 6.0]))
    np.testing.assert_allclose(found[[0, 3]], leds.cov_px2[[0, 3]] * [[[6.0]], [[4.0]]], rtol=1e-12)


@pytest.mark.parametrize("alike", [0.0, 0.5, 0.8])
def test_errors_that_fade_from_picture_to_picture_are_found(alike):
    # Each is so much of the last one's: (1 + r) / (1 - r) of them are one. Cut off where they hardly agree.
    n_frames, n_leds = 400, 7
    leds = sightings(
        np.repeat(np.arange(n_frames), n_leds), np.tile(np.arange(n_leds), n_frames), 10.0 * np.arange(2800)
    )
    rng, off_px = np.random.default_rng(4), np.zeros((n_frames, n_leds, 2))
    for i in range(1, n_frames):
        off_px[i] = alike * off_px[i - 1] + np.sqrt(1 - alike**2) * rng.normal(size=(n_leds, 2))
    off_px[50, 3] = 100.0  # an outlier says nothing
    off_px[:, 5] += 7.0  # and what stands beside its place all the time is no noise
    still = leds.frame >= 300
    found = pictures_alike(0.02 * off_px.reshape(-1, 2), leds, still, np.ones(len(still), dtype=bool))
    assert found[0] == pytest.approx((1 + alike) / (1 - alike), rel=0.2)
    assert found[1] >= found[0]
    # What is not used, and a few sightings, say nothing.
    few = leds.frame < 5
    np.testing.assert_array_equal(pictures_alike(off_px.reshape(-1, 2), leds, still, few), ALL_NEW)


def test_errors_at_rest_are_no_newer_than_those_of_a_picture_that_moves():
    n_frames = 200
    leds = sightings(np.arange(n_frames), np.zeros(n_frames, dtype=int), 10.0 * np.arange(n_frames))
    off_px = np.repeat(np.random.default_rng(5).normal(size=(n_frames // 10, 2)), 10, axis=0)
    off_px[100:] = np.random.default_rng(6).normal(size=(100, 2))
    still, use = leds.frame >= 100, np.ones(n_frames, dtype=bool)
    found = pictures_alike(off_px, leds, still, use)
    assert found[0] > 5
    assert found[1] == found[0]


def chi2_of(scale, n, rng):
    return scale**2 * rng.chisquare(2, n)


def test_moving_and_still_pictures_have_scales_of_their_own():
    rng = np.random.default_rng(1)
    chi2 = np.concatenate([chi2_of(1.5, 4000, rng), chi2_of(0.3, 4000, rng)])
    still = np.repeat([False, True], 4000)
    scales = centroid_scales(chi2, still, np.ones(8000, dtype=bool), STATED_SCALES)
    # The median of 4000 such is known to 2 %, its root to 1 %.
    assert scales == pytest.approx([1.5, 0.3], rel=0.04)


def test_a_run_at_rest_says_nothing_of_pictures_that_move():
    rng = np.random.default_rng(2)
    still = np.ones(2000, dtype=bool)
    still[:5] = False
    scales = centroid_scales(chi2_of(0.2, 2000, rng), still, np.ones(2000, dtype=bool), STATED_SCALES)
    assert scales[0] == 1.0
    assert scales[1] == pytest.approx(0.2, rel=0.05)


def test_steps_of_inertial_noise_are_factors_of_two_and_few_impacts_are_believed_less():
    noise = InertialNoise(gyro_rough=-1, acc_rough=1, acc_systematic=-2, impact=-2, n_impacts=6)
    gyro, acc = noise.levels((NoiseLevel(1.0, 0.5), NoiseLevel(1.0, 0.5)))
    # Variance of Student's t with six degrees of freedom: 6 / 4.
    share = pytest.approx(0.25 * np.sqrt(1.5))
    assert (gyro.roughness, gyro.systematic, gyro.impact) == (0.5, 0.5, share)
    assert (acc.roughness, acc.systematic, acc.impact) == (2.0, 0.125, share)
    assert noise.n_steps == 6


def test_an_led_that_nothing_can_be_said_of_does_not_count():
    rng = np.random.default_rng(3)
    chi2, still, use = chi2_of(1.5, 4000, rng), np.zeros(4000, dtype=bool), np.ones(4000, dtype=bool)
    without = centroid_scales(chi2[100:], still[100:], use[100:], STATED_SCALES)
    chi2[:100] = np.nan
    assert np.array_equal(centroid_scales(chi2, still, use, STATED_SCALES), without)


def test_each_kind_of_noise_is_walked_as_long_as_it_pays_and_up_only_where_down_is_unlikelier(monkeypatch):
    tried = []

    def likelihood(problem, gyro_var, acc_var):
        # Of steps away from what is stated: acc_rough, gyro_rough, acc_systematic, gyro_systematic, impact.
        steps = np.log2(np.sqrt([acc_var[0], gyro_var[0], acc_var[1], gyro_var[1], gyro_var[2]]))
        tried.append(np.round(steps).astype(int).tolist())
        return -float(np.array([10.0, 1.0, 10.0, 10.0, 0.3]) @ (steps - [-2.0, -0.6, 2.0, 0.0, -3.0]) ** 2)

    monkeypatch.setattr(led_noise, "_log_likelihood", likelihood)
    zero, one = np.zeros(3), np.eye(3)
    parts = NoiseParts(zero, one[0], one[1], zero, one[0], one[1], one[2], one[2])
    pulses = SimpleNamespace(acc_impact_mps2=np.array([0.0, 50.0, 50.0, 0.0, 50.0]))
    stated = NoiseLevel(1.0, 1.0), NoiseLevel(1.0, 1.0)
    chosen = choose_inertial_noise(None, parts, pulses, stated, FusionSettings())
    assert chosen == InertialNoise(acc_rough=-2, acc_systematic=2)
    assert tried == [
        [0, 0, 0, 0, 0],
        *([-1, 0, 0, 0, 0], [-2, 0, 0, 0, 0], [-3, 0, 0, 0, 0]),  # earn 30, 10, -10
        [-2, -1, 0, 0, 0],  # 0.2, where 2 are asked for: up is unlikelier still
        [-2, 0, 0, 0, -1],  # 1.5
        *([-2, 0, -1, 0, 0], [-2, 0, 1, 0, 0], [-2, 0, 2, 0, 0], [-2, 0, 3, 0, 0]),  # -50, 30, 10, -10
        *([-2, 0, 2, -1, 0], [-2, 0, 2, 1, 0]),  # -10, -10
    ]
