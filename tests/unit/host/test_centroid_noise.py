from dataclasses import replace

import numpy as np
import pytest
from led_scenes import random_poses, seven_leds
from pinhole import PinholeCamera
from scipy.spatial.transform import Rotation

from bricktrack_common.brick_model import ProfileEntry
from bricktrack_host.normalised_errors import normalised_squares
from bricktrack_host.tracking.centroid_noise import measure_noise, standing_share, with_measured_noise
from bricktrack_host.tracking.frame_errors import frame_errors
from bricktrack_host.tracking.led_model.led_profile import predict_brick
from bricktrack_host.tracking.optical_track import solve_poses, start_poses
from bricktrack_host.tracking.pictures.light_kernel import FLOOR_SD_PX
from bricktrack_host.tracks import LedObservations

CAMERA = PinholeCamera()
PROFILE = ProfileEntry(collar_mm=0.7, source="test", shift_sd_per_radius=0.0)
BRICK = replace(seven_leds(), led_profile=PROFILE)
FRAME_NS = 33_333_333


def seen(R, t, error_px):
    prediction, _ = predict_brick(R, t, CAMERA, BRICK, collar_mm=0.7)
    n = len(R)
    return LedObservations(
        sensor_timestamp_ns=np.arange(n, dtype=np.int64) * FRAME_NS,
        exposure_ns=np.full(n, 2_000_000, dtype=np.int64),
        uv_px=prediction.uv_px + error_px,
        cov_px2=np.tile(FLOOR_SD_PX**2 * np.eye(2), (n, 7, 1, 1)),
        area_px2=np.full((n, 7), 3500.0),
        led_flags=np.zeros((n, 7), dtype=np.int64),
        frame_flags=np.zeros(n, dtype=np.int64),
    )


def measured(observations):
    first = start_poses(observations, CAMERA, BRICK)
    return measure_noise(frame_errors(observations, first, CAMERA, BRICK, rolling_shutter=False))


@pytest.mark.parametrize("sd_px", [0.01, 0.03, 0.12])
def test_the_noise_of_many_places_is_found(sd_px):
    n = 100
    R, t = random_poses(n, seed=1)
    noise = measured(seen(R, t, np.random.default_rng(2).normal(0, sd_px, (n, 7, 2))))
    # 800 residuals: the sd to 2.5 %; the grid's step is 5 %.
    assert noise.seen_sd_px == pytest.approx(sd_px, rel=0.08)
    assert noise.sd_px == pytest.approx(np.sqrt((800 * sd_px**2 + FLOOR_SD_PX**2) / 799), rel=0.08)
    assert noise.n_frames == n
    assert noise.dof > 400


def test_wrong_leds_do_not_count():
    n = 60
    R, t = random_poses(n, seed=3)
    error = np.random.default_rng(4).normal(0, 0.02, (n, 7, 2))
    error[::10, 3] += 1.5
    assert measured(seen(R, t, error)).seen_sd_px == pytest.approx(0.02, rel=0.15)


def test_a_hundred_pictures_of_one_place_say_little_more_than_one():
    R, t = (np.repeat(x, 100, axis=0) for x in random_poses(1, seed=5))
    rng = np.random.default_rng(6)
    error = rng.normal(0, 0.02, (1, 7, 2)) + rng.normal(0, 0.003, (100, 7, 2))
    noise = measured(seen(R, t, error))
    assert 8 <= noise.dof < 12
    # Eight residuals know their sd to a fourth, and the floor counts for one more.
    assert noise.seen_sd_px == pytest.approx(0.02, rel=0.6)
    assert noise.sd_px > 1.1 * noise.seen_sd_px


def test_without_a_pose_the_floor_stays():
    observations = seen(*random_poses(4, seed=7), 0.0)
    observations.uv_px[:] = np.nan
    noise = measured(observations)
    assert (noise.sd_px, noise.n_frames) == (FLOOR_SD_PX, 0)
    first = start_poses(observations, CAMERA, BRICK)
    kept = with_measured_noise(observations, frame_errors(observations, first, CAMERA, BRICK))
    np.testing.assert_array_equal(kept.cov_px2, observations.cov_px2)


def test_poses_with_the_measured_noise_are_as_good_as_they_say():
    n = 150
    R, t = random_poses(n, seed=8)
    observations = seen(R, t, np.random.default_rng(9).normal(0, 0.02, (n, 7, 2)))
    first = start_poses(observations, CAMERA, BRICK)
    errors = frame_errors(observations, first, CAMERA, BRICK, rolling_shutter=False)
    told = with_measured_noise(observations, errors)
    shift_of = []
    for each in (observations, told):
        track = solve_poses(each, CAMERA, BRICK, rolling_shutter=False)
        shift = t - track.t_camera_brick_mm
        nees = np.einsum("ni,nij,nj->n", shift, np.linalg.inv(track.covariance[:, 3:, 3:]), shift)
        shift_of.append(nees.mean() / 3)
    # Chi-square with 450 degrees of freedom scatters by 7 %; the floor alone is nine times too wide.
    assert shift_of[0] < 0.2
    assert shift_of[1] == pytest.approx(1.0, abs=0.25)


def test_each_kind_of_picture_has_its_own_noise():
    n = 240
    R, t = random_poses(n, seed=12)
    is_keyframe = np.arange(n) % 8 == 3
    sd_px = np.where(is_keyframe, 0.01, np.where(np.roll(is_keyframe, 1), 0.03, 0.02))
    observations = seen(R, t, np.random.default_rng(13).normal(0, 1, (n, 7, 2)) * sd_px[:, None, None])
    first = start_poses(observations, CAMERA, BRICK)
    errors = frame_errors(observations, first, CAMERA, BRICK, rolling_shutter=False)
    told = with_measured_noise(observations, errors, is_keyframe)
    # 120 residuals of 15 pictures tell their sd to 7 %, the grid to 5 %; eight of all are believed beside them.
    np.testing.assert_allclose(np.sqrt(told.cov_px2[:, 0, 0, 0]), sd_px, rtol=0.15)


@pytest.mark.parametrize("are_keyframes", [False, True])
def test_where_no_picture_or_every_one_is_coded_for_itself_all_have_one_noise(are_keyframes):
    R, t = random_poses(40, seed=14)
    observations = seen(R, t, np.random.default_rng(15).normal(0, 0.02, (40, 7, 2)))
    first = start_poses(observations, CAMERA, BRICK)
    errors = frame_errors(observations, first, CAMERA, BRICK, rolling_shutter=False)
    np.testing.assert_allclose(
        with_measured_noise(observations, errors, np.full(40, are_keyframes)).cov_px2,
        with_measured_noise(observations, errors).cov_px2,
    )


def test_centroids_stated_better_than_the_floor_are_as_noisy_as_their_residuals():
    n, sd_px = 60, 0.005
    R, t = random_poses(n, seed=16)
    observations = seen(R, t, np.random.default_rng(17).normal(0, sd_px, (n, 7, 2)))
    observations.cov_px2[:] = 0.003**2 * np.eye(2)
    observations.uv_px[5, 2] = observations.cov_px2[5, 2] = np.nan
    first = start_poses(observations, CAMERA, BRICK)
    errors = frame_errors(observations, first, CAMERA, BRICK, rolling_shutter=False)
    told = with_measured_noise(observations, errors, np.arange(n) % 15 == 0)
    # The floor counts as one residual beside 480, which tell the sd to 3 %, the grid to 5 %.
    expected_px = np.sqrt(sd_px**2 + FLOOR_SD_PX**2 / 480)
    np.testing.assert_allclose(np.sqrt(np.nanmedian(told.cov_px2[..., 0, 0])), expected_px, rtol=0.2)
    assert np.nanmin(np.linalg.eigvalsh(told.cov_px2)) > 0
    track = solve_poses(told, CAMERA, BRICK, rolling_shutter=False, first=first)
    assert np.isfinite(track.R_camera_brick).all()


def test_the_share_that_stands_still_is_told_from_residuals():
    rng = np.random.default_rng(8)
    shares = [
        standing_share(rng.normal(0, 0.03, (7, 2)) + rng.normal(0, 0.04, (200, 7, 2))) for _ in range(300)
    ]
    # 0.36 by its truth; of 14 means less the 6 that a pose takes the share is widened by 8 / 6.
    assert np.mean(shares) == pytest.approx(0.36 * 8 / 6, rel=0.1)
    assert standing_share(rng.normal(0, 0.04, (200, 7, 2))) < 0.02
    assert standing_share(np.full((5, 7, 2), np.nan)) == 0.9  # what nobody saw may be anything


def test_what_frames_share_of_their_errors_is_as_large_as_it_is_said_to_be():
    # 60 runs of 30 frames of one place: the mean error of a run is what its frames share.
    n, sd_px = 30, 0.05
    R0, t0 = random_poses(60, seed=11)
    shared, new = [], []
    for k in range(60):
        rng = np.random.default_rng(k)
        error = rng.normal(0, sd_px, (7, 2)) + rng.normal(0, sd_px, (n, 7, 2))
        R, t = np.repeat(R0[k : k + 1], n, axis=0), np.repeat(t0[k : k + 1], n, axis=0)
        observed = seen(R, t, error)
        observed.cov_px2[:] = 2 * sd_px**2 * np.eye(2)
        track = solve_poses(observed, CAMERA, BRICK, rolling_shutter=False)
        turn = Rotation.from_matrix(np.swapaxes(track.R_camera_brick, 1, 2) @ R).as_rotvec()
        e = np.concatenate([turn, t - track.t_camera_brick_mm], axis=1)
        part = track.shared_covariance
        shared.append(normalised_squares(e.mean(axis=0)[None], part[:1] + (track.covariance - part)[:1] / n))
        new.append(normalised_squares(e - e.mean(axis=0), (track.covariance - part) * (1 - 1 / n)))
    # F of 6 and 8 degrees of freedom, by 6 / 8: one run scatters by one, 60 by 0.13.
    assert 0.6 < np.mean(shared) / 6 < 1.5
    # What is new is what is left: a share of half is widened by 8 / 6, which leaves 0.33 for 0.5. The fusion
    # finds as much from how the frames scatter.
    assert 1.0 < np.mean(new) / 6 < 1.8
