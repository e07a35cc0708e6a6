from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from led_scenes import random_poses, seven_leds
from pinhole import PinholeCamera
from scipy.spatial.transform import Rotation

from bricktrack_common.arrays import rows_of
from bricktrack_common.brick_model import LayoutFile, LedEntry, ProfileEntry, brick_model_from_file
from bricktrack_host.quality import LedFlag, PoseFlag
from bricktrack_host.tracking.led_model.led_profile import predict_brick
from bricktrack_host.tracking.optical_track import solve_poses, start_poses
from bricktrack_host.tracking.pose.twin_poses import mirrored_poses
from bricktrack_host.tracks import LedObservations

CAMERA = PinholeCamera()
BRICK = seven_leds(collar_mm=0.7)
PERIOD_NS = 40_000_000
EXPOSURE_NS = 4_000_000
LINE_NS = 18903.5
FLAT = np.array([True, False, True, True, True, True, False])  # without the one that stands out of plane


def observations(uv, *, sd):
    n, n_leds = uv.shape[:2]
    seen = np.isfinite(uv).all(axis=-1)
    return LedObservations(
        sensor_timestamp_ns=7_000_000_000 + np.arange(n) * PERIOD_NS,
        exposure_ns=np.full(n, EXPOSURE_NS),
        uv_px=uv,
        cov_px2=np.broadcast_to(sd**2 * np.eye(2), (n, n_leds, 2, 2)).copy(),
        area_px2=np.full((n, n_leds), 3500.0),
        led_flags=np.where(seen, 0, int(LedFlag.MISSING)).astype(np.int64),
        frame_flags=np.zeros(n, dtype=np.int64),
    )


def rolling_pixels(n, *, tilt_deg):
    """Pixels, each at its own row's instant, of a brick rocked at 2.5 Hz, and the true attitudes."""

    def rocked(seconds):
        w = 2 * np.pi * 2.5
        angle = np.stack([1 + np.sin(w * seconds), np.cos(w * seconds), 0.2 * np.sin(w * seconds)], axis=-1)
        R = Rotation.from_rotvec(np.radians(tilt_deg) * angle.reshape(-1, 3)).as_matrix()
        return R.reshape(*seconds.shape, 3, 3), np.array([-26.0, -24.0, 132.0]) + 3 * angle

    return pixels_of(rocked, n)


def swung_pixels(n, rng, *, tilt_deg, hz):
    """The same of a brick that swings about each axis at some rate, up to 30 % off, and from some phase."""
    turn_phase, shift_phase = rng.uniform(0, 2 * np.pi, (2, 3))
    middle, swing = rng.uniform(-1, 1, 3) * [1, 1, 0.3], rng.uniform(0.3, 1, 3) * [1, 1, 0.3]
    w, shift_mm = 2 * np.pi * hz * rng.uniform(0.7, 1.3, 3), rng.uniform(1, 4, 3)

    def swung(seconds):
        angle = middle + swing * np.sin(w * seconds[..., None] + turn_phase)
        R = Rotation.from_rotvec(np.radians(tilt_deg) * angle.reshape(-1, 3)).as_matrix()
        t_mm = [-26.0, -24.0, 132.0] + shift_mm * np.sin(w * seconds[..., None] + shift_phase)
        return R.reshape(*seconds.shape, 3, 3), t_mm

    return pixels_of(swung, n)


def pixels_of(motion, n):
    """Pixels, each at its own row's instant, and the true attitudes at the frames'."""
    first = np.arange(n) * PERIOD_NS * 1e-9 - EXPOSURE_NS * 0.5e-9
    v = np.full((n, BRICK.n_leds), 539.5)
    for _ in range(6):  # the row decides the instant, the instant the row
        prediction, _ = predict_brick(
            *motion(first[:, None] + v * LINE_NS * 1e-9), CAMERA, BRICK, collar_mm=0.7
        )
        v = prediction.uv_px[..., 1]
    return prediction.uv_px, motion(first + 539.5 * LINE_NS * 1e-9)[0]


def turn_deg(R, other):
    return np.degrees(np.linalg.norm(Rotation.from_matrix(np.swapaxes(R, 1, 2) @ other).as_rotvec(), axis=1))


def test_from_far_away_a_mirrored_pose_shows_the_same():
    R, t_mm = random_poses(20, seed=3, tilt_deg=25.0)
    seen = np.broadcast_to(FLAT, (20, 7))
    twin_R, twin_t_mm = mirrored_poses(seen, R, t_mm, np.zeros(3), BRICK)
    np.testing.assert_allclose(np.linalg.det(twin_R), 1.0)  # a rotation, no mirror image
    np.testing.assert_allclose(twin_R @ np.swapaxes(twin_R, 1, 2), np.tile(np.eye(3), (20, 1, 1)), atol=1e-12)
    own_mm = np.einsum("nij,kj->nki", R, BRICK.led_positions_mm[FLAT]) + t_mm[:, None]
    twin_mm = np.einsum("nij,kj->nki", twin_R, BRICK.led_positions_mm[FLAT]) + twin_t_mm[:, None]
    middle_mm = own_mm.mean(axis=1)
    sight = middle_mm / np.linalg.norm(middle_mm, axis=1, keepdims=True)
    # The same across the line of sight, and as far in front of the middle as it was behind.
    moved_mm = twin_mm - own_mm
    depth_mm = np.einsum("nki,ni->nk", own_mm - middle_mm[:, None], sight)
    np.testing.assert_allclose(moved_mm, -2 * depth_mm[..., None] * sight[:, None], atol=1e-9)


def test_leds_out_of_plane_have_no_mirrored_pose():
    R, t_mm = random_poses(3, seed=3, tilt_deg=25.0)
    seen = np.array([[True] * 7, [True] * 3 + [False] * 4, FLAT])
    twin_R, _ = mirrored_poses(seen, R, t_mm, np.zeros(3), BRICK)
    assert np.isfinite(twin_R).all(axis=(1, 2)).tolist() == [False, False, True]


@pytest.mark.parametrize("tilt_deg", [2.0, 4.0])
def test_a_motion_that_shows_leds_in_a_plane_as_their_mirrored_pose_is_seen_through(tilt_deg):
    uv, R = rolling_pixels(24, tilt_deg=tilt_deg)
    uv[:, ~FLAT] = np.nan
    seen = observations(uv, sd=0.03)
    first = start_poses(seen, CAMERA, BRICK)
    # Taken for one instant, what 20 ms of motion do to the pixels fits the mirrored pose better.
    assert turn_deg(first.R_camera_brick, R).max() > 15
    track = solve_poses(seen, CAMERA, BRICK, first=first)
    # A spline's ends are free; within, what 0.03 px leave is 0.15 degrees.
    off_deg = turn_deg(track.R_camera_brick, R)
    assert off_deg[2:-2].max() < 0.05
    assert off_deg.max() < 0.3
    assert not (track.flags & PoseFlag.AMBIGUOUS).any()


@pytest.mark.parametrize("leds", [(0, 2, 3, 5), (0, 1, 4, 5), (1, 3, 4, 5)])
def test_a_moving_frame_with_four_leds_starts_at_the_pose_that_is_near_its_neighbours(leds):
    uv, R = rolling_pixels(12, tilt_deg=12.0)
    uv[5, [k for k in range(7) if k not in leds]] = np.nan
    first = start_poses(observations(uv, sd=0.05), CAMERA, BRICK)
    # One instant leaves some degrees of 20 ms of motion; what fits that instant best is over 40 off.
    assert turn_deg(first.R_camera_brick[5:6], R[5:6])[0] < 5


def test_no_pose_of_a_rocked_brick_is_wrong_and_sure_whichever_leds_are_hidden():
    n_refused = 0
    for leds in set(combinations(range(7), 4)) - {(0, 3, 4, 5)}:  # those are one column: no pose at all
        uv, R = rolling_pixels(12, tilt_deg=4.0)
        uv += np.random.default_rng(leds).normal(0, 0.05, uv.shape)
        uv[:, [k for k in range(7) if k not in leds]] = np.nan
        track = solve_poses(observations(uv, sd=0.05), CAMERA, BRICK)
        posed = np.isfinite(track.R_camera_brick).all(axis=(1, 2))
        n_refused += int((~posed).sum())
        off_deg = turn_deg(track.R_camera_brick[posed], R[posed])
        sd_deg = np.degrees(np.sqrt(np.einsum("nii->n", track.covariance[posed, :3, :3])))
        assert (off_deg < 1.0 + 4 * sd_deg).all(), leds
        assert (track.flags[~posed] & PoseFlag.AMBIGUOUS).all()
    assert n_refused < 0.1 * 34 * 12


def test_a_frame_of_few_leds_does_not_turn_away_alone_from_its_neighbours():
    rng = np.random.default_rng(0)
    uv, R = swung_pixels(12, rng, tilt_deg=15.0, hz=2.5)
    uv += rng.normal(0, 0.05, uv.shape)
    uv[3:8, [0, 2, 5]] = np.nan
    track = solve_poses(observations(uv, sd=0.05), CAMERA, BRICK)
    # The motion that a pose 35 degrees off makes of the frames around it lets that pose fit.
    assert turn_deg(track.R_camera_brick, R).max() < 3


def test_a_frame_alone_with_two_poses_has_none_and_its_neighbours_give_it_one():
    # LEDs in a small square far away, tilted to either side, look the same.
    places = [(0.0, 0.0, 0.0), (8.0, 0.0, 0.0), (8.0, 8.0, 0.0), (0.0, 8.0, 0.0), (4.0, 4.0, -6.0)]
    leds = [
        LedEntry(name=f"s{i}", position_mm=p, axis=(0, 0, -1.0), radius_mm=0.5) for i, p in enumerate(places)
    ]
    profile = ProfileEntry(collar_mm=0.0, source="test")
    brick = brick_model_from_file(LayoutFile(led=leds, led_profile=profile), where="test")
    R = np.tile(Rotation.from_rotvec([np.radians(12.0), 0.0, 0.0]).as_matrix(), (3, 1, 1))
    t_mm = np.tile([-4.0, -4.0, 160.0], (3, 1))
    prediction, _ = predict_brick(R, t_mm, CAMERA, brick, collar_mm=0.0)
    uv = prediction.uv_px.copy()
    uv[1, 4] = np.nan
    # Given a start in either pose, as a run's identities may: nothing but the frames beside it decides.
    seen = observations(uv, sd=0.3)
    first = start_poses(observations(prediction.uv_px, sd=0.3), CAMERA, brick)
    flat = np.array([True] * 4 + [False])
    twin_R, twin_t_mm = mirrored_poses(np.tile(flat, (3, 1)), R, t_mm, np.zeros(3), brick)
    for start_R, start_t_mm in ((R, t_mm), (twin_R, twin_t_mm)):
        started = replace(
            first,
            uv_px=uv,
            R_camera_brick=np.concatenate([R[:1], start_R[1:2], R[2:]]),
            t_camera_brick_mm=np.concatenate([t_mm[:1], start_t_mm[1:2], t_mm[2:]]),
        )
        track = solve_poses(seen, CAMERA, brick, first=started, rolling_shutter=False)
        assert turn_deg(track.R_camera_brick, R).max() < 1.5
        alone = solve_poses(
            rows_of(seen, slice(1, 2)),
            CAMERA,
            brick,
            first=rows_of(started, slice(1, 2)),
            rolling_shutter=False,
        )
        assert alone.flags[0] & PoseFlag.AMBIGUOUS
        assert alone.flags[0] & PoseFlag.NO_POSE
        assert np.isnan(alone.t_camera_brick_mm).all()
