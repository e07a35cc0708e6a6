import logging

import numpy as np
import pytest
from led_scenes import picture_of_brick, picture_of_light, random_poses, seven_leds
from pinhole import PinholeCamera
from scipy.spatial.transform import Rotation

from bricktrack_common.errors import TrackingError
from bricktrack_host.quality import LedFlag, PoseFlag
from bricktrack_host.tracking import led_tracker
from bricktrack_host.tracking.led_tracker import observe_leds
from bricktrack_host.tracking.optical_track import solve_poses
from bricktrack_host.tracking.pictures.run_lights import usual_radius_px
from bricktrack_host.tracks import LedObservations

CAMERA = PinholeCamera()
COLLAR = 0.7
BRICK = seven_leds(collar_mm=COLLAR)
N = 12
STAMPS = 1_000_000_000 + np.arange(N) * 33_327_000
EXPOSURE = np.full(N, 4_000_000)


def moving_poses():
    """A brick that jumps by up to 15 mm and 6 degrees between frames: far beyond any smooth prediction."""
    phase = np.arange(N)
    R = Rotation.from_rotvec(
        np.radians(np.column_stack([3 * np.sin(phase), 4 * np.cos(2.1 * phase), 3 * np.sin(1.7 * phase)]))
    ).as_matrix()
    t = np.column_stack(
        [-26 + 7 * np.sin(2.3 * phase), -24 + 5 * np.cos(1.9 * phase), 132 + 6 * np.sin(phase)]
    )
    return R, t


def draw(i, **options):
    R, t = moving_poses()
    return picture_of_brick(R[i], t[i], BRICK, collar=COLLAR, camera=CAMERA, **options)


@pytest.fixture(scope="module")
def run():
    """Frame 2 without m0 and m5, 5 lost, 6 with m3 half covered, 7 dark, two lamps all the time."""
    lamps = [(150.0, 900.0), (1800.0, 100.0)]
    pictures = []
    for i in range(N):
        if i == 5:
            continue
        if i == 7:
            pictures.append((i, picture_of_light(np.full((1080, 1920), 0.001))))
            continue
        hidden = (0, 5) if i == 2 else ()
        cover = {3: 0.8} if i == 6 else None
        pictures.append((i, draw(i, hidden=hidden, covered_right_of=cover, lamps=lamps)))
    return pictures


@pytest.fixture(scope="module")
def observed(run):
    return observe_leds(iter(run), CAMERA, BRICK, sensor_timestamp_ns=STAMPS, exposure_ns=EXPOSURE)


def test_every_led_in_view_is_identified_through_jumps_hiding_and_loss(observed):
    seen = np.isfinite(observed.uv_px).all(axis=-1)
    assert seen[[0, 1, 3, 4, 8, 9, 10, 11]].all()
    assert seen[2].tolist() == [False, True, True, True, True, False, True]
    assert not seen[[5, 7]].any()
    assert ((observed.led_flags & LedFlag.MISSING) != 0).tolist() == (~seen).tolist()


def test_lost_and_dark_frames_say_so(observed):
    assert observed.frame_flags[5] == PoseFlag.FRAME_LOST | PoseFlag.NO_POSE
    assert observed.frame_flags[7] == PoseFlag.NO_POSE
    assert observed.frame_flags[2] == PoseFlag.LED_MISSING
    assert observed.frame_flags[0] == PoseFlag.NONE


def test_a_partly_covered_led_is_flagged_and_no_other(observed):
    covered = (observed.led_flags & LedFlag.PARTLY_COVERED) != 0
    assert np.argwhere(covered).tolist() == [[6, 3]]


def test_lights_are_doubted_by_their_shape_in_radii(run, observed, monkeypatch):
    asked = {}

    def doubt(log_area_ratio, cov_px2, usable, R, t_mm):
        asked.update(usable=usable, t_mm=t_mm)
        return np.where(np.arange(7) == 4, 0.01, 0.0) * np.ones((len(R), 1))

    monkeypatch.setattr(led_tracker, "doubt_by_shape", doubt)
    doubted = observe_leds(iter(run), CAMERA, BRICK, sensor_timestamp_ns=STAMPS, exposure_ns=EXPOSURE)
    more_px2 = doubted.cov_px2[0] - observed.cov_px2[0]
    np.testing.assert_allclose(more_px2[4], 1e-4 * observed.area_px2[0, 4] / np.pi * np.eye(2), rtol=1e-9)
    assert not np.delete(more_px2, 4, axis=0).any()
    # Ten frames have poses; the LEDs that are hidden in frame 2, or covered in frame 6, are not asked about.
    posed = [0, 1, 2, 3, 4, 6, 8, 9, 10, 11]
    # Identity takes rows for seen one after the other, and these were not: its poses are off by millimetres.
    np.testing.assert_allclose(asked["t_mm"], moving_poses()[1][posed], atol=2.0)
    assert np.argwhere(~asked["usable"]).tolist() == [[2, 0], [2, 5], [5, 3]]


def test_the_poses_are_true_to_micrometres(observed):
    track = solve_poses(observed, CAMERA, BRICK, rolling_shutter=False)
    _, t = moving_poses()
    posed = np.isfinite(track.t_camera_brick_mm).all(axis=1)
    assert np.flatnonzero(~posed).tolist() == [5, 7]
    # Rendered at an eighth of a pixel and 8 bits: centroids good to 0.02 px, 1.5 um on the brick, times ten in z.
    error = np.abs(track.t_camera_brick_mm - t)[posed]
    assert error[:, :2].max() < 0.01
    assert error[:, 2].max() < 0.05
    assert track.flags[6] & PoseFlag.LED_MISSING


def test_the_papers_method_identifies_the_same_leds(run, observed):
    paper = observe_leds(
        iter(run), CAMERA, BRICK, sensor_timestamp_ns=STAMPS, exposure_ns=EXPOSURE, method="paper"
    )
    both = np.isfinite(paper.uv_px) & np.isfinite(observed.uv_px)
    assert both.any(axis=2).sum() >= 65
    # Hard thresholds against soft ones on clean pictures: the half-covered LED apart, the same to 0.1 px.
    difference = np.abs(paper.uv_px - observed.uv_px)
    difference[6, 3] = np.nan
    assert np.nanmax(difference) < 0.1


def test_a_light_of_an_leds_size_in_an_leds_place_is_not_believed():
    R, t = random_poses(1, seed=3)
    uv = CAMERA.project(BRICK.led_positions_mm @ R[0].T + t[0]).uv_px
    decoy = tuple(uv[4] + [25.0, 60.0])
    picture = picture_of_brick(R[0], t[0], BRICK, collar=COLLAR, camera=CAMERA, hidden=(4,), lamps=[decoy])
    seen = observe_leds(
        [(0, picture)], CAMERA, BRICK, sensor_timestamp_ns=STAMPS[:1], exposure_ns=EXPOSURE[:1]
    )
    assert np.isnan(seen.uv_px[0, 4]).all()
    assert np.isfinite(seen.uv_px[0, [0, 1, 2, 3, 5, 6]]).all()


def test_progress_is_told(run):
    told = []
    observe_leds(
        iter(run[:2]), CAMERA, BRICK, sensor_timestamp_ns=STAMPS, exposure_ns=EXPOSURE, progress=told.append
    )
    assert told == [1, 2]


def test_a_picture_of_another_size_is_refused():
    small = picture_of_light(np.full((480, 640), 0.1))
    with pytest.raises(TrackingError, match="640 x 480"):
        observe_leds([(0, small)], CAMERA, BRICK, sensor_timestamp_ns=STAMPS, exposure_ns=EXPOSURE)


@pytest.mark.parametrize("indices", [(0, 0), (3, 2), (N,), (-1,)])
def test_frames_out_of_order_are_refused(indices):
    dark = picture_of_light(np.full((1080, 1920), 0.001))
    with pytest.raises(TrackingError, match="rising"):
        observe_leds(
            [(i, dark) for i in indices], CAMERA, BRICK, sensor_timestamp_ns=STAMPS, exposure_ns=EXPOSURE
        )


def test_times_that_do_not_fit_each_other_and_unknown_methods_are_refused():
    with pytest.raises(TrackingError, match="one of each"):
        observe_leds([], CAMERA, BRICK, sensor_timestamp_ns=STAMPS, exposure_ns=EXPOSURE[:3])
    with pytest.raises(TrackingError, match="'guess'"):
        observe_leds([], CAMERA, BRICK, sensor_timestamp_ns=STAMPS, exposure_ns=EXPOSURE, method="guess")


def test_a_run_without_pictures_is_all_lost(caplog):
    with caplog.at_level(logging.WARNING):
        seen = observe_leds([], CAMERA, BRICK, sensor_timestamp_ns=STAMPS, exposure_ns=EXPOSURE)
    assert (seen.frame_flags & PoseFlag.FRAME_LOST).all()
    assert f"{N} of {N} frames" in caplog.text


def test_the_usual_radius_is_the_pinholes():
    # 3 mm midway between the planes, 131.1 mm: 1560 * 3 / 131.1 px.
    assert usual_radius_px(CAMERA, BRICK) == pytest.approx(1560 * 3 / 131.114, rel=0.01)


def test_a_smear_widens_a_centroid_along_it_and_some_across():
    n = 4
    uv = np.zeros((n, 1, 2))
    uv[:, 0, 0] = 200.0 * np.arange(n)
    seen = LedObservations(
        sensor_timestamp_ns=np.arange(n, dtype=np.int64) * 40_000_000,
        exposure_ns=np.full(n, 8_000_000),
        uv_px=uv,
        cov_px2=np.zeros((n, 1, 2, 2)),
        area_px2=np.full((n, 1), 100.0),
        led_flags=np.zeros((n, 1), dtype=np.int64),
        frame_flags=np.zeros(n, dtype=np.int64),
    )
    led_tracker._widen_blurred(seen)
    # 200 px in 40 ms are 40 px in 8 ms: 3 % of it along, half a per cent each way.
    expected = np.diag([(0.03 * 40) ** 2 + (0.005 * 40) ** 2, (0.005 * 40) ** 2])
    np.testing.assert_allclose(seen.cov_px2[:, 0], np.broadcast_to(expected, (n, 2, 2)), atol=1e-12)
    assert (seen.led_flags == LedFlag.BLURRED).all()
