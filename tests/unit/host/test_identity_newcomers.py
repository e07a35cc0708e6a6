"""A shaken brick of seven LEDs, read out row by row, and lights that come in LEDs' places."""

import numpy as np
import pytest
from led_scenes import seven_leds
from pinhole import PinholeCamera

from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix
from bricktrack_host.tracking.identity.identity_newcomers import leave_out_newcomers, log_odds
from bricktrack_host.tracking.identity.identity_smoothing import steady_poses
from bricktrack_host.tracking.identity.run_identities import RunIdentities
from bricktrack_host.tracking.led_model.led_profile import predict_brick
from bricktrack_host.tracking.pictures.segment import Blobs

CAMERA = PinholeCamera()
COLLAR = 0.7
BRICK = seven_leds(collar_mm=COLLAR)
N, STEP_NS, NOISE_PX = 20, 33_327_000, 0.05
HIDDEN = 6


def poses_at(t_s):
    """A shake of 3 mm and 1 degree at 2 Hz."""
    wave = np.sin(2 * np.pi * 2.0 * t_s)[..., None]
    R = matrix_from_rvec(wave * [0.0, np.radians(1.0), 0.0])
    middle = np.array([26.0, 24.0, 3.0])
    return R, wave * [3.0, 0.0, 0.0] + [0.0, 0.0, 132.0] - R @ middle


FRAME_S = np.arange(N) * STEP_NS * 1e-9


def seen_by_rows():
    """What the camera shows of the shake, each LED when its own row is read."""
    mode = CAMERA.sensor_mode
    led_s = np.repeat(FRAME_S[:, None], 7, axis=1)
    for _ in range(5):
        seen, _ = predict_brick(*poses_at(led_s), CAMERA, BRICK, collar_mm=COLLAR)
        late_ns = mode.row_delay_ns(seen.uv_px[..., 1]) - mode.row_delay_ns(0.5 * (mode.height - 1))
        led_s = FRAME_S[:, None] + late_ns * 1e-9
    return seen


def known_run(*, false_px=None, at=10, hidden=HIDDEN):
    """A run of which all is known: one LED is hidden in all frames, and one false light in its place in one."""
    rng = np.random.default_rng(3)
    R, t = poses_at(FRAME_S)
    seen = seen_by_rows()
    uv = seen.uv_px + rng.normal(0, NOISE_PX, seen.uv_px.shape)
    blobs, assigned = [], np.tile(np.arange(7), (N, 1))
    assigned[:, hidden] = -1
    for i in range(N):
        places, areas = uv[i].copy(), seen.area_px2[i].copy()
        places[hidden] = [60.0, 60.0]
        if i == at and false_px is not None:
            places[hidden] = uv[i, hidden] + false_px
            assigned[i, hidden] = hidden
        blobs.append(
            Blobs(
                uv_px=places,
                cov_px2=np.tile(NOISE_PX**2 * np.eye(2), (7, 1, 1)),
                area_px2=areas,
                eccentricity=np.zeros(7),
                fill=np.ones(7),
                flags=np.zeros(7, dtype=np.int64),
            )
        )
    run = RunIdentities(blobs, np.arange(N) * STEP_NS, CAMERA, BRICK, radius_px=34.0, collar_mm=COLLAR)
    run.found.blob_of_led[:] = assigned
    run.found.R_camera_brick[:], run.found.t_camera_brick_mm[:] = R, t
    return run, R, t


USUAL = np.full(N, 0.1)


@pytest.mark.parametrize("away", [1.5, 8.0])
def test_a_light_beside_a_hidden_leds_place_is_not_the_led(away):
    run, R, _ = known_run(false_px=[away, 0.0])
    # As a fit that takes the light for the LED would have it: the brick turns about its flat side's middle.
    run.found.R_camera_brick[10] = R[10] @ matrix_from_rvec(np.array([0.0, 0.02, 0.0]))
    leave_out_newcomers(run, USUAL)
    assert run.found.blob_of_led[10].tolist() == [0, 1, 2, 3, 4, 5, -1]
    # 0.06 px of noise on six LEDs is below 0.2 degrees.
    assert np.linalg.norm(rvec_from_matrix(run.found.R_camera_brick[10].T @ R[10])) < np.radians(0.2)


def test_an_led_that_comes_and_stays_is_believed():
    run, _, _ = known_run(false_px=[0.0, 0.0])
    run.found.blob_of_led[10:, HIDDEN] = HIDDEN
    run.lights.uv_px[HIDDEN::7][11:] = seen_by_rows().uv_px[11:, HIDDEN]
    before = run.found.blob_of_led.copy()
    leave_out_newcomers(run, USUAL)
    assert (run.found.blob_of_led == before).all()


def test_the_odds_fall_with_the_distance_and_with_an_area_that_is_no_leds():
    odds = []
    for away in (0.0, 0.5, 1.0, 2.0):
        run, _, _ = known_run(false_px=[away, 0.0])
        odds.append(log_odds(run, np.array([10]), np.array([HIDDEN]), USUAL, still=False)[0])
    assert (np.diff(odds) < 0).all()
    # One free light, shown to 0.15 px in two million: log(2e6 / (2 pi 0.15^2)) = 16.5, and 3.3 for the area.
    assert 19 < odds[0] < 20.5
    run, _, _ = known_run(false_px=[0.0, 0.0])
    run.lights.area_px2[7 * 10 + HIDDEN] *= 3
    strange = log_odds(run, np.array([10]), np.array([HIDDEN]), USUAL, still=False)[0]
    assert strange < odds[0] - 3


def test_attitudes_that_few_lights_leave_open_are_the_runs():
    run, R, t = known_run(hidden=1)  # the only LED out of the others' plane
    turned = R @ matrix_from_rvec(np.random.default_rng(5).normal(0, 0.05, (N, 3)))
    run.found.R_camera_brick[:] = turned
    steady_R, steady_t = steady_poses(run, np.full(N, 0.3))
    error = np.linalg.norm(rvec_from_matrix(np.swapaxes(steady_R, -1, -2) @ R), axis=1)
    assert (
        error.max() < 0.02 < np.linalg.norm(rvec_from_matrix(np.swapaxes(turned, -1, -2) @ R), axis=1).max()
    )
    assert np.abs(steady_t - t).max() < 1.0


def test_frames_lost_for_a_moment_are_bridged_and_for_longer_are_not():
    run, R, _ = known_run()
    run.refuse(np.array([4, 5]))
    steady_R, _ = steady_poses(run, USUAL)
    assert (
        np.linalg.norm(rvec_from_matrix(np.swapaxes(steady_R[[4, 5]], -1, -2) @ R[[4, 5]]), axis=1).max()
        < 0.01
    )
    run.refuse(np.arange(9, 14))
    assert np.isnan(steady_poses(run, USUAL)[0][9:14]).all()


def test_frames_are_not_bridged_over_time_that_no_frame_tells_of():
    run, _, _ = known_run()
    run.refuse(np.array([9, 10]))
    assert np.isfinite(steady_poses(run, USUAL)[0][9:11]).all()
    run.stamps_ns[10:] += 5 * STEP_NS  # the camera left five frames out
    assert np.isnan(steady_poses(run, USUAL)[0][9:11]).all()
