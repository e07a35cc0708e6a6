"""A brick that is jolted while the rows of a frame are read: its lights lie where no pose has them, and are whole."""

from dataclasses import replace

import numpy as np
import pytest
from led_scenes import seven_leds
from pinhole import PinholeCamera
from scipy.spatial.transform import Rotation

from bricktrack_common.brick_model import ProfileEntry
from bricktrack_host.quality import LedFlag, PoseFlag
from bricktrack_host.tracking.led_model.led_profile import predict_brick
from bricktrack_host.tracking.led_tracker import NOT_USED, observe_lights
from bricktrack_host.tracking.optical_track import solve_poses
from bricktrack_host.tracking.pictures.segment import Blobs

CAMERA = PinholeCamera()
PROFILE = ProfileEntry(collar_mm=0.7, source="test", shift_sd_per_radius=0.0)
BRICK = replace(seven_leds(collar_mm=0.7), led_profile=PROFILE)
FRAME_S, EXPOSURE_S, LINE_S = 33.327e-3, 1e-3, 18903.5e-9
N, JOLTED = 50, 25


def pose(seconds, jolt_s):
    """A swing at 2 Hz, and after the jolt a ringing at 45 Hz that is gone within a frame."""
    since = np.maximum(seconds - jolt_s, 0.0)[..., None]
    ringing = np.sin(2 * np.pi * 45 * since) * np.exp(-since / 6e-3)
    swing = np.sin(2 * np.pi * 2.0 * seconds[..., None] + np.array([0.0, 1.0, 2.0]))
    turn = np.radians(1.0 * swing + ringing * [0.6, -0.4, 0.5])
    R = Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix().reshape(*seconds.shape, 3, 3)
    return R, np.array([-26.0, -24.0, 134.0]) + 2 * swing + ringing * [1.2, -0.5, 0.6]


def lights_of(jolt_s, rng, *, area_of=None):
    """The lights of all frames, each LED's in its own row's instant, and the frames' instants."""
    stamp_s = np.arange(N) * FRAME_S
    v = np.full((N, 7), 539.5)
    for _ in range(8):
        R, t_mm = pose(stamp_s[:, None] - EXPOSURE_S / 2 + v * LINE_S, jolt_s)
        prediction, _ = predict_brick(R, t_mm, CAMERA, BRICK, collar_mm=0.7)
        v = prediction.uv_px[..., 1]
    uv = prediction.uv_px + rng.normal(0, 0.02, (N, 7, 2))
    area = prediction.area_px2 * np.exp(rng.normal(0, 0.002, (N, 7)))
    if area_of is not None:
        frame, led, share = area_of
        area[frame, led] *= 1 - share
        uv[frame, led] += share * np.sqrt(area[frame, led] / np.pi)
    cov = np.broadcast_to(0.06**2 * np.eye(2) + 1e-7 * area[..., None, None] * np.eye(2), (N, 7, 2, 2))
    ones, none = np.ones(7), np.zeros(7, dtype=np.int64)
    lights = [Blobs(uv[i], cov[i].copy(), area[i], 0.1 * ones, ones, none) for i in range(N)]
    return lights, stamp_s - EXPOSURE_S / 2 + 539.5 * LINE_S


def observed(lights):
    return observe_lights(
        lights, CAMERA, BRICK,
        sensor_timestamp_ns=np.rint(np.arange(N) * FRAME_S * 1e9).astype(np.int64),
        exposure_ns=np.full(N, round(EXPOSURE_S * 1e9)),
    )  # fmt: skip


@pytest.mark.parametrize("before_ms", [6.0, 4.0, 2.0, 0.0])
def test_the_lights_of_a_jolted_frame_are_not_taken_for_covered_ones_and_its_pose_is_unsure(before_ms):
    jolt_s = JOLTED * FRAME_S + 539.5 * LINE_S - before_ms * 1e-3
    lights, instant_s = lights_of(jolt_s, np.random.default_rng(1))
    seen = observed(lights)
    assert not (seen.led_flags & int(NOT_USED)).any()
    track = solve_poses(seen, CAMERA, BRICK)
    R, t_mm = pose(instant_s, jolt_s)
    turn = Rotation.from_matrix(np.swapaxes(track.R_camera_brick, 1, 2) @ R).as_rotvec()
    error = np.concatenate([turn, t_mm - track.t_camera_brick_mm], axis=1)
    sd = np.sqrt(np.einsum("nii->ni", track.covariance))
    assert (np.abs(error) < 5 * sd).all()
    assert track.flags[JOLTED] & PoseFlag.IMPACT


def test_a_light_that_strayed_and_is_smaller_is_partly_covered():
    never = 1e3
    lights, _ = lights_of(never, np.random.default_rng(2), area_of=(JOLTED, 4, 0.06))
    covered = (observed(lights).led_flags & int(LedFlag.PARTLY_COVERED)) != 0
    assert np.argwhere(covered).tolist() == [[JOLTED, 4]]
