from dataclasses import replace

import numpy as np
import pytest
from led_scenes import leds_in_camera, random_poses, seven_leds
from pinhole import PinholeCamera
from scipy.spatial.transform import Rotation

from bricktrack_common.brick_model import LayoutFile, LedEntry, ProfileEntry, brick_model_from_file
from bricktrack_common.errors import TrackingError
from bricktrack_host.quality import LedFlag, PoseFlag
from bricktrack_host.tracking.led_model.led_profile import predict_brick
from bricktrack_host.tracking.optical_track import solve_poses, start_poses
from bricktrack_host.tracking.pose.frame_motion import (
    led_motion,
    led_times_ns,
    motion_to_leds,
    within_exposure_ns,
)
from bricktrack_host.tracks import FusedTrack, LedObservations

CAMERA = PinholeCamera()
BRICK = seven_leds(collar_mm=0.7)
PERIOD_NS = 33_326_871
EXPOSURE_NS = 4_000_000
LINE_NS = 18903.5


def observations(uv, *, sd=0.03, first_ns=7_000_000_000):
    n, n_leds = uv.shape[:2]
    seen = np.isfinite(uv).all(axis=-1)
    return LedObservations(
        sensor_timestamp_ns=first_ns + np.arange(n) * PERIOD_NS,
        exposure_ns=np.full(n, EXPOSURE_NS),
        uv_px=uv,
        cov_px2=np.broadcast_to(sd**2 * np.eye(2), (n, n_leds, 2, 2)).copy(),
        area_px2=np.full((n, n_leds), 3500.0),
        led_flags=np.where(seen, 0, int(LedFlag.MISSING)).astype(np.int64),
        frame_flags=np.where(seen.sum(axis=1) >= 4, 0, int(PoseFlag.NO_POSE)).astype(np.int64),
    )


def shake(seconds, hz=5.0):
    """4 mm and 2 degrees: at 5 Hz up to 130 mm/s."""
    w = 2 * np.pi * hz
    t = np.stack(
        [
            -26 + 4 * np.sin(w * seconds),
            -24 + 2 * np.cos(w * seconds + 1),
            130 + 3 * np.sin(w * seconds + 2),
        ],
        axis=-1,
    )
    turn = np.radians(
        np.stack([1.5 * np.sin(w * seconds), 2 * np.cos(w * seconds), np.sin(w * seconds + 1)], axis=-1)
    )
    return Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix().reshape(*turn.shape[:-1], 3, 3), t


def rolling_pixels(n, brick=BRICK, hz=5.0):
    """Pixels of LEDs each seen at its own row's mid-exposure, and the poses at the centre row's."""
    first = np.arange(n) * PERIOD_NS * 1e-9 - EXPOSURE_NS * 0.5e-9
    v = np.full((n, brick.n_leds), 539.5)
    for _ in range(6):  # the row decides the instant, the instant the row
        R, t = shake(first[:, None] + v * LINE_NS * 1e-9, hz)
        prediction, _ = predict_brick(R, t, CAMERA, brick, collar_mm=0.7)
        v = prediction.uv_px[..., 1]
    return prediction.uv_px, *shake(first + 539.5 * LINE_NS * 1e-9, hz)


def test_poses_and_leds_carry_the_instants_of_their_rows():
    uv = np.full((1, 7, 2), 100.0)
    uv[0, 1, 1] = 500.0
    uv[0, 2] = np.nan
    t_ns, led_t_ns = led_times_ns(observations(uv, first_ns=10**9), CAMERA)
    # DESIGN 3: stamp - exposure / 2 + row * line time.
    assert t_ns.tolist() == [10**9 - 2_000_000 + round(539.5 * LINE_NS)]
    assert led_t_ns[0, 0] == 10**9 - 2_000_000 + round(100 * LINE_NS)
    assert led_t_ns[0, 1] == 10**9 - 2_000_000 + round(500 * LINE_NS)
    assert led_t_ns[0, 2] == t_ns[0]


def test_row_times_take_the_rolling_shutter_out():
    uv, _, t = rolling_pixels(40)
    seen = observations(uv)
    with_rows = solve_poses(seen, CAMERA, BRICK)
    without = solve_poses(seen, CAMERA, BRICK, rolling_shutter=False)
    inner = slice(3, -3)  # a spline's ends are free
    better = np.sqrt(np.mean((with_rows.t_camera_brick_mm - t)[inner] ** 2, axis=0))
    worse = np.sqrt(np.mean((without.t_camera_brick_mm - t)[inner] ** 2, axis=0))
    # At 5 Hz and 30 frames a second a cubic spline's velocity is 0.8 % off: 1 mm/s over the rows' 6 ms is 6 um,
    # some ten times that in z.
    assert better[:2].max() < 0.02
    assert better[2] < 0.1
    assert worse[2] > 5 * better[2]
    assert with_rows.t_ns.tolist() == without.t_ns.tolist()


def test_a_gap_in_the_frames_ends_a_spline_but_costs_no_pose():
    uv, _, t = rolling_pixels(40)
    uv[15:25] = np.nan
    track = solve_poses(observations(uv), CAMERA, BRICK)
    posed = np.isfinite(track.t_camera_brick_mm).all(axis=1)
    assert np.flatnonzero(~posed).tolist() == list(range(15, 25))
    assert (track.flags[15:25] & PoseFlag.NO_POSE).all()
    assert np.abs((track.t_camera_brick_mm - t)[posed]).max() < 1.0


@pytest.mark.parametrize("hidden", [(0,), (1,), (2,), (0, 2), (1, 6)])
def test_every_frame_with_five_leds_has_its_true_pose(hidden):
    R, t = random_poses(60, seed=11, tilt_deg=30.0)
    prediction, _ = predict_brick(R, t, CAMERA, BRICK, collar_mm=0.7)
    uv = prediction.uv_px.copy()
    uv[::2, list(hidden)] = np.nan
    track = solve_poses(observations(uv), CAMERA, BRICK, rolling_shutter=False)
    posed = np.isfinite(track.t_camera_brick_mm).all(axis=1)
    wrong = posed & (np.abs(track.t_camera_brick_mm - t).max(axis=1) > 0.05)
    assert not wrong.any()
    # These frames do not follow each other: what one of them leaves ambiguous no neighbour can settle.
    assert posed.mean() > 0.95
    assert (track.flags[::2][posed[::2]] & PoseFlag.LED_MISSING).all()
    assert (track.flags[~posed] & PoseFlag.AMBIGUOUS).all()


@pytest.mark.parametrize("fifth", [[], [(4.0, 4.0, 0.0)]])
def test_two_poses_that_fit_alike_are_not_chosen_between(fifth):
    # LEDs in a small square far away, one deep LED hidden: tilted to either side they look the same.
    places = [(0.0, 0.0, 0.0), (8.0, 0.0, 0.0), (8.0, 8.0, 0.0), (0.0, 8.0, 0.0), *fifth, (4.0, 4.0, -6.0)]
    leds = [
        LedEntry(name=f"s{i}", position_mm=p, axis=(0, 0, -1.0), radius_mm=0.5) for i, p in enumerate(places)
    ]
    profile = ProfileEntry(collar_mm=0.0, source="test")
    brick = brick_model_from_file(LayoutFile(led=leds, led_profile=profile), where="test")
    R = Rotation.from_rotvec([[np.radians(12.0), 0.0, 0.0]]).as_matrix()
    t = np.array([[-4.0, -4.0, 160.0]])
    prediction, _ = predict_brick(R, t, CAMERA, brick, collar_mm=0.0)
    uv = prediction.uv_px.copy()
    whole = solve_poses(observations(uv, sd=0.3), CAMERA, brick)
    np.testing.assert_allclose(whole.t_camera_brick_mm, t, atol=1e-3)
    uv[:, -1] = np.nan
    track = solve_poses(observations(uv, sd=0.3), CAMERA, brick)
    assert track.flags[0] & PoseFlag.AMBIGUOUS
    assert np.isnan(track.t_camera_brick_mm).all()
    assert np.isnan(track.covariance).all()


def test_a_flagged_led_is_not_used_and_an_outlier_is_left_out():
    R, t = random_poses(8, seed=12)
    prediction, _ = predict_brick(R, t, CAMERA, BRICK, collar_mm=0.7)
    uv = prediction.uv_px.copy()
    uv[2, 5] += [4.0, -3.0]
    uv[4, 6] += [6.0, 6.0]
    seen = observations(uv)
    seen.led_flags[2, 5] |= LedFlag.PARTLY_COVERED
    track = solve_poses(seen, CAMERA, BRICK, rolling_shutter=False)
    np.testing.assert_allclose(track.t_camera_brick_mm, t, atol=0.01)
    assert np.isnan(track.residual_px[2, 5]).all()
    assert np.isnan(track.residual_px[4, 6]).all()
    assert np.isfinite(track.residual_px).sum() == 2 * (8 * 7 - 2)
    assert (track.flags[[2, 4]] & PoseFlag.LED_MISSING).all()
    assert (track.flags[[0, 1, 3, 5, 6, 7]] == 0).all()


def test_the_covariance_is_honest_under_noise():
    n = 400
    R, t = random_poses(n, seed=13)
    prediction, _ = predict_brick(R, t, CAMERA, BRICK, collar_mm=0.7)
    uv = prediction.uv_px + np.random.default_rng(14).normal(0, 0.05, (n, 7, 2))
    track = solve_poses(observations(uv, sd=0.05), CAMERA, BRICK, rolling_shutter=False)
    turn = Rotation.from_matrix(np.swapaxes(track.R_camera_brick, 1, 2) @ R).as_rotvec()
    error = np.hstack([turn, t - track.t_camera_brick_mm])
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(track.covariance), error)
    # Six where the profile's residual uncertainty is not used up; never above.
    assert 3.0 < nees.mean() < 6.5


def test_too_confident_centroids_are_found_out_by_their_residuals():
    n = 200
    R, t = random_poses(n, seed=15)
    prediction, _ = predict_brick(R, t, CAMERA, BRICK, collar_mm=0.7)
    uv = prediction.uv_px + np.random.default_rng(16).normal(0, 0.12, (n, 7, 2))
    track = solve_poses(observations(uv, sd=0.04), CAMERA, BRICK, rolling_shutter=False)
    turn = Rotation.from_matrix(np.swapaxes(track.R_camera_brick, 1, 2) @ R).as_rotvec()
    error = np.hstack([turn, t - track.t_camera_brick_mm])
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(track.covariance), error)
    # Nine times too small in variance as given: 54 without the scaling.
    assert np.median(nees) < 15.0


def test_an_unknown_profile_is_told():
    R, t = random_poses(3, seed=17)
    uv = CAMERA.project(leds_in_camera(R, t, BRICK)).uv_px
    track = solve_poses(observations(uv), CAMERA, seven_leds(), rolling_shutter=False)
    assert (track.flags & PoseFlag.LED_PROFILE_UNKNOWN).all()


def test_four_leds_give_a_pose_that_says_it_is_unverified():
    uv, _, _ = rolling_pixels(10)
    uv[5, [0, 3, 4]] = np.nan
    track = solve_poses(observations(uv), CAMERA, BRICK)
    assert track.flags[5] & (PoseFlag.UNVERIFIED | PoseFlag.AMBIGUOUS)
    uv[5, 5] = np.nan
    assert solve_poses(observations(uv), CAMERA, BRICK).flags[5] & PoseFlag.NO_POSE


def test_prsoi_alone_can_be_had_for_comparison():
    R, t = random_poses(5, seed=18)
    uv = CAMERA.project(leds_in_camera(R, t, BRICK)).uv_px
    for form in ("safe", "printed"):
        track = solve_poses(observations(uv), CAMERA, BRICK, form=form, refined=False)
        np.testing.assert_allclose(track.t_camera_brick_mm, t, atol=1e-4)
        assert np.isnan(track.covariance).all()


def test_observations_of_another_layout_are_refused():
    with pytest.raises(TrackingError, match="6 LEDs"):
        solve_poses(observations(np.zeros((2, 6, 2))), CAMERA, BRICK)


def test_no_frames_give_an_empty_track():
    assert len(solve_poses(observations(np.empty((0, 7, 2))), CAMERA, BRICK).t_ns) == 0


def track_at(t_ns):
    """The true motion as a fused track."""
    R, t = shake((t_ns - 7_000_000_000) * 1e-9)
    n = len(t_ns)
    return FusedTrack(
        t_ns=t_ns,
        R_camera_brick=R,
        t_camera_brick_mm=t,
        omega_brick_radps=np.zeros((n, 3)),
        v_camera_mmps=np.zeros((n, 3)),
        covariance=np.broadcast_to(np.eye(6), (n, 6, 6)),
        flags=np.zeros(n, dtype=np.int64),
    )


def true_motion(seen, t_ns, led_t_ns):
    within_ns = within_exposure_ns(led_t_ns, seen.exposure_ns)
    return led_motion(track_at(t_ns), track_at(within_ns.ravel()), n_instants=2)


def test_a_motion_that_is_known_otherwise_takes_the_place_of_splines():
    uv, _, t = rolling_pixels(6)
    seen = observations(uv)
    t_ns, led_t_ns = led_times_ns(seen, CAMERA)
    motion = led_motion(track_at(t_ns), track_at(led_t_ns.ravel()))
    np.testing.assert_allclose(motion.dt_s, (led_t_ns - t_ns[:, None]) * 1e-9)
    known = solve_poses(seen, CAMERA, BRICK, motion=motion)
    # Six frames are few for a spline; the true motion leaves the profile's and the lens terms' micrometres.
    np.testing.assert_allclose(known.t_camera_brick_mm, t, atol=0.01)


def test_light_gathered_over_a_long_exposure_is_no_pose_of_its_middle():
    exposure_s = 0.012
    first = np.arange(12) * PERIOD_NS * 1e-9 - 0.5 * exposure_s
    instants = exposure_s * ((np.arange(24) + 0.5) / 24 - 0.5)  # the mean of many is what a blur shows
    v = np.full((12, 7), 539.5)
    for _ in range(6):
        at = first[:, None] + v * LINE_NS * 1e-9
        uv = np.mean(
            [predict_brick(*shake(at + dt), CAMERA, BRICK, collar_mm=0.7)[0].uv_px for dt in instants], axis=0
        )
        v = uv[..., 1]
    seen = replace(observations(uv), exposure_ns=np.full(12, int(exposure_s * 1e9)))
    _, t_mm = shake(first + 539.5 * LINE_NS * 1e-9)
    t_ns, led_t_ns = led_times_ns(seen, CAMERA)
    over_it = true_motion(seen, t_ns, led_t_ns)
    of_its_middle = true_motion(replace(seen, exposure_ns=np.zeros(12, dtype=np.int64)), t_ns, led_t_ns)
    error_mm = [
        np.abs(solve_poses(seen, CAMERA, BRICK, motion=m).t_camera_brick_mm - t_mm).max()
        for m in (over_it, of_its_middle)
    ]
    # The blur takes (w T)^2 / 24 = 0.6 % off 4 mm.
    assert error_mm[0] < 0.01
    assert error_mm[1] > 0.02


def test_first_poses_had_once_serve_every_motion():
    uv, _, _ = rolling_pixels(12)
    uv[4:7, 2] = np.nan
    seen = observations(uv)
    t_ns, led_t_ns = led_times_ns(seen, CAMERA)
    first = start_poses(seen, CAMERA, BRICK)
    for motion in (None, true_motion(seen, t_ns, led_t_ns)):
        anew = solve_poses(seen, CAMERA, BRICK, motion=motion)
        again = solve_poses(seen, CAMERA, BRICK, motion=motion, first=first)
        np.testing.assert_array_equal(again.t_camera_brick_mm, anew.t_camera_brick_mm)
        np.testing.assert_array_equal(again.covariance, anew.covariance)
        np.testing.assert_array_equal(again.flags, anew.flags)


def test_an_impact_that_no_spline_follows_is_corrected_by_the_frames_own_rows():
    first = np.arange(30) * PERIOD_NS * 1e-9 - EXPOSURE_NS * 0.5e-9

    def kicked(seconds):
        R, t = shake(np.zeros_like(seconds))
        late = np.maximum(seconds - 0.5, 0.0)[..., None] * np.array([120.0, -40.0, 60.0])  # mm/s, at once
        return R, t + np.minimum(late, [[4.0]] if late.ndim == 2 else 4.0)

    v = np.full((30, 7), 539.5)
    for _ in range(6):
        prediction, _ = predict_brick(
            *kicked(first[:, None] + v * LINE_NS * 1e-9), CAMERA, BRICK, collar_mm=0.7
        )
        v = prediction.uv_px[..., 1]
    _, t = kicked(first + 539.5 * LINE_NS * 1e-9)
    track = solve_poses(observations(prediction.uv_px), CAMERA, BRICK)
    error = np.abs(track.t_camera_brick_mm - t).max(axis=1)
    at = int(np.argmin(np.abs(first + 0.01 - 0.5)))
    away = np.abs(np.arange(30) - at) > 2
    assert error[away].max() < 0.1
    # 120 mm/s that start or end within a frame's read-out: 1.2 mm over its half.
    assert error.max() < 0.8
    sd_mm = np.sqrt(track.covariance[:, 5, 5])
    assert sd_mm[at] > 3 * np.median(sd_mm)


def test_an_led_that_an_impact_moved_is_no_outlier_and_the_covariance_covers_it():
    first = np.arange(30) * PERIOD_NS * 1e-9 - EXPOSURE_NS * 0.5e-9
    hit_s = first[15] + 300 * LINE_NS * 1e-9  # between the rows of the upper and the lower LEDs

    def struck(seconds):
        R, t = shake(seconds)
        return R, t + np.clip(seconds - hit_s, 0.0, 0.02)[..., None] * np.array([150.0, -60.0, 80.0])

    v = np.full((30, 7), 539.5)
    for _ in range(6):
        prediction, _ = predict_brick(
            *struck(first[:, None] + v * LINE_NS * 1e-9), CAMERA, BRICK, collar_mm=0.7
        )
        v = prediction.uv_px[..., 1]
    noisy = prediction.uv_px + np.random.default_rng(3).normal(0, 0.02, prediction.uv_px.shape)
    R, t = struck(first + 539.5 * LINE_NS * 1e-9)
    track = solve_poses(observations(noisy, sd=0.02), CAMERA, BRICK)
    turn = Rotation.from_matrix(np.swapaxes(track.R_camera_brick, 1, 2) @ R).as_rotvec()
    error = np.hstack([turn, t - track.t_camera_brick_mm])
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(track.covariance), error)
    struck_frames = np.flatnonzero(track.flags & PoseFlag.IMPACT)
    assert 15 in struck_frames
    assert set(struck_frames) <= {0, 14, 15, 16, 29}  # the ends' splines know one side only
    # 99.99 % of chi-square with six degrees of freedom: 27.9.
    assert nees[struck_frames].max() < 28.0


def test_frames_without_the_led_out_of_plane_do_not_doubt_their_own_motion_more_and_more():
    """Their attitude scatters, and with it what splines say of the motion, which would free it to scatter more."""
    z_mm, z_known_mm = [], []
    for seed in range(4):
        uv, R, t = rolling_pixels(40, hz=0.25)
        uv += np.random.default_rng(seed).normal(0, 0.06, uv.shape)
        uv[10:30, 2] = np.nan
        seen = observations(uv, sd=0.06)
        t_ns, led_t_ns = led_times_ns(seen, CAMERA)
        known = motion_to_leds(t_ns, led_t_ns, R, t)
        tracks = (solve_poses(seen, CAMERA, BRICK, motion=motion) for motion in (None, known))
        for errors, track in zip((z_mm, z_known_mm), tracks, strict=True):
            errors.append((track.t_camera_brick_mm - t)[10:30, 2])
    # The motion of the truth, by the same splines, is the best that can be known; 1.64 of it is what doubts
    # that each pass takes from the poses of the one before come to.
    assert np.std(z_mm) < 1.35 * np.std(z_known_mm)
