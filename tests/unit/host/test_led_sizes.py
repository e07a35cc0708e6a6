"""Lights larger than their LEDs are named; the areas are those of outlines drawn by no product code."""

from dataclasses import replace

import numpy as np
import pytest
from led_scenes import leds_in_camera, lit_outline, polygon_centroid, random_poses, seven_leds
from pinhole import PinholeCamera

from bricktrack_common.brick_model import ProfileEntry
from bricktrack_host.quality import LedFlag
from bricktrack_host.tracking.led_sizes import LedSizes, led_sizes
from bricktrack_host.tracking.optical_track import solve_poses
from bricktrack_host.tracks import LedObservations

CAMERA = PinholeCamera()
BRICK = replace(seven_leds(), led_profile=ProfileEntry(collar_mm=0.7, source="drawn"))
N = 8


@pytest.fixture(scope="module")
def scene():
    R, t = random_poses(N, seed=3)
    axes = np.einsum("nij,lj->nli", R, BRICK.led_axes)
    uv, area = np.empty((N, 7, 2)), np.empty((N, 7))
    for i, centres in enumerate(leds_in_camera(R, t, BRICK)):
        for k, centre in enumerate(centres):
            outline = lit_outline(centre, axes[i, k], radius=3.0, collar=0.7, camera=CAMERA, n=120)
            uv[i, k], area[i, k] = polygon_centroid(outline)[:2]
    seen = LedObservations(
        sensor_timestamp_ns=np.arange(N) * 33_000_000,
        exposure_ns=np.full(N, 4_000_000),
        uv_px=uv,
        cov_px2=np.broadcast_to(0.06**2 * np.eye(2), (N, 7, 2, 2)).copy(),
        area_px2=np.abs(area),
        led_flags=np.zeros((N, 7), dtype=np.int64),
        frame_flags=np.zeros(N, dtype=np.int64),
    )
    return seen, solve_poses(seen, CAMERA, BRICK, rolling_shutter=False)


@pytest.mark.parametrize("factor", [0.7, 0.9, 1.1])
def test_lights_of_about_their_leds_size_are_passed_over(scene, factor):
    seen, track = scene
    assert (
        led_sizes(replace(seen, area_px2=factor * seen.area_px2), track, CAMERA, BRICK).words(
            BRICK, in_covariance=True
        )
        == []
    )


def test_lights_that_are_larger_are_named_with_how_much(scene):
    seen, track = scene
    large = replace(seen, area_px2=seen.area_px2 * [1, 1.4, 1, 1.45, 1, 1, 1])
    sizes = led_sizes(large, track, CAMERA, BRICK)
    (words,) = sizes.words(BRICK, in_covariance=True)
    assert "(m1 1.40, m3 1.45 times the area)" in words
    assert np.flatnonzero(sizes.sd_px).tolist() == [1, 3]


def test_two_discs_that_ran_together_have_their_middle_as_far_off_as_is_said():
    radius = 12.0
    v, u = np.mgrid[-40:41, -40:41] / 1.0
    disc = np.hypot(u, v) <= radius
    for apart in (5.0, 8.0):
        both = disc | (np.hypot(u - apart, v) <= radius)
        ratio = both.sum() / disc.sum()
        sizes = LedSizes(np.array([ratio, 1.0, np.nan]), np.array([radius, radius, np.nan]))
        # In either direction; 5 % for discs on whole pixels, and for an overlap that is no rectangle.
        assert sizes.sd_px * np.sqrt(2) == pytest.approx([u[both].mean(), 0, 0], rel=0.05)


def test_an_unknown_profile_is_no_reason_to_doubt(scene):
    seen, track = scene
    assert (
        led_sizes(seen, track, CAMERA, replace(BRICK, led_profile=None)).words(BRICK, in_covariance=True)
        == []
    )


def test_lights_that_are_flagged_anyway_and_frames_without_a_pose_do_not_count(scene):
    seen, track = scene
    large = replace(seen, area_px2=seen.area_px2 * 1.5)
    merged = replace(large, led_flags=np.full((N, 7), int(LedFlag.MERGED)))
    assert led_sizes(merged, track, CAMERA, BRICK).words(BRICK, in_covariance=True) == []
    lost = replace(track, t_camera_brick_mm=np.full((N, 3), np.nan))
    assert led_sizes(large, lost, CAMERA, BRICK).words(BRICK, in_covariance=True) == []
