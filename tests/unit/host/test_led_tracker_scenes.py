"""What happens to LEDs at a shaking table, on rendered pictures with noise: borders, cards, merging, darkness.

The truth is the poses that the pictures were drawn from, by a renderer and a camera that share no code with the
product.
"""

from dataclasses import replace

import numpy as np
import pytest
from led_scenes import leds_in_camera, picture_of_brick, picture_of_light, seven_leds
from pinhole import PinholeCamera
from scipy.spatial.transform import Rotation

from bricktrack_host.quality import LedFlag, PoseFlag
from bricktrack_host.tracking.led_tracker import NOT_USED, observe_leds
from bricktrack_host.tracking.optical_track import solve_poses
from bricktrack_host.tracking.pictures.segment import Picture

CAMERA = PinholeCamera()
COLLAR = 0.7
BRICK = seven_leds(collar_mm=COLLAR)
CENTRE = np.array([26.0, 24.0, 3.0])
NOISE_CODES = 1.5
ERROR_MM = np.array([0.02, 0.02, 0.15])
"""Of a pose from six or seven LEDs whose centroids are good to 0.03 px: eight bits, noise, rendering; 0.002 mm
on the brick, times three for one LED in the worst place, and ten times that along the view."""


def noisy(picture, seed):
    codes = picture.luma + np.random.default_rng(seed).normal(0, NOISE_CODES, picture.luma.shape)
    return Picture(np.clip(np.rint(codes), 0, 255).astype(np.uint8), picture.chroma_u, picture.chroma_v)


def drawn(poses, *, brick=BRICK, axis=(0.0, 1.0, 0.0), **options):
    """Pictures of a brick whose middle is at (x, y, z), mm, turned about an axis, deg: (x, y, z, tilt) rows."""
    R = Rotation.from_rotvec(np.radians(np.outer([p[3] for p in poses], axis))).as_matrix()
    t = np.array([p[:3] for p in poses]) - R @ CENTRE
    pictures = []
    for i in range(len(poses)):
        chosen = {k: v[i] for k, v in options.items()}
        pictures.append(noisy(picture_of_brick(R[i], t[i], brick, collar=COLLAR, camera=CAMERA, **chosen), i))
    return pictures, R, t


def tracked(pictures, brick=BRICK):
    """Observations and optical track of pictures of one instant each; `None` is a dark one."""
    dark = picture_of_light(np.full((1080, 1920), 0.002))
    stamps = 1_000_000_000 + np.arange(len(pictures)) * 33_327_000
    observed = observe_leds(
        ((i, dark if p is None else p) for i, p in enumerate(pictures)),
        CAMERA, brick, sensor_timestamp_ns=stamps, exposure_ns=np.full(len(pictures), 1_000_000),
    )  # fmt: skip
    return observed, solve_poses(observed, CAMERA, brick, rolling_shutter=False)


def assert_identities_are_true(observed, R, t, brick=BRICK):
    uv = CAMERA.project(leds_in_camera(R, t, brick)).uv_px
    away_px = np.linalg.norm(observed.uv_px - uv, axis=-1)
    # A dome's outline and half a disc lie within a radius of the base's centre; the next LED two and more away.
    assert np.nanmax(away_px) < 40


def test_an_led_that_crosses_the_border_is_flagged_and_pulls_no_pose():
    # m2 and m6 leave to the right, a third of an LED's diameter a frame, until they are gone, and come back.
    out = np.concatenate([np.linspace(44, 62, 9), np.linspace(60, 44, 4)])
    pictures, R, t = drawn([(x, 0.0, 132.0, 0.0) for x in out])
    observed, track = tracked(pictures)
    assert_identities_are_true(observed, R, t)
    cut = (observed.led_flags & LedFlag.BORDER) != 0
    gone = (observed.led_flags & LedFlag.MISSING) != 0
    assert cut[:, [2, 6]].any(axis=0).all()
    assert gone[8, [2, 6]].all()
    assert not (cut | gone)[:, [0, 1, 3, 4, 5]].any()
    assert ((observed.led_flags[:, [2, 6]] & NOT_USED) == 0)[[0, -1]].all()
    # The outline drawn of each LED: cut where it reaches over the last column of pixels, to a pixel of rim.
    right_px = CAMERA.project(leds_in_camera(R, t, BRICK)[:, [2, 6]]).uv_px[..., 0]
    for inside, flagged in zip(right_px.ravel(), cut[:, [2, 6]].ravel(), strict=True):
        if inside < 1919 - 50:
            assert not flagged
    assert (np.abs(track.t_camera_brick_mm - t) < 3 * ERROR_MM).all()  # five LEDs on one side of the picture


def test_a_card_over_half_an_led_at_most_doubles_the_error():
    # A card's edge goes over m3 in seven steps, from its left end to its right.
    covers = np.linspace(0.05, 0.95, 7)
    places = [(2.0 * np.sin(i), 1.5 * np.cos(2 * i), 132.0, 4 * np.sin(1.3 * i)) for i in range(13)]
    free = [None] * 6
    covered = [{3: c} for c in covers] + free
    pictures, R, t = drawn(places, covered_right_of=covered)
    clear, _, _ = drawn(places)
    observed, track = tracked(pictures)
    _, reference = tracked(clear)
    assert_identities_are_true(observed, R, t)
    unused = (observed.led_flags[:, 3] & NOT_USED) != 0
    # Hidden up to nearly all of it, down to a tenth of it: what is less moves the centroid as little.
    assert unused[:6].all()
    assert not unused[7:].any()
    assert not (observed.led_flags[:, [0, 1, 2, 4, 5, 6]] & NOT_USED).any()
    with_card = np.sqrt(np.mean((track.t_camera_brick_mm - t)[:7] ** 2, axis=0))
    without = np.sqrt(np.mean((reference.t_camera_brick_mm - t)[:7] ** 2, axis=0))
    assert (with_card <= 2 * np.maximum(without, ERROR_MM / 4)).all()


def test_two_leds_that_run_together_are_left_out_until_they_part():
    places = BRICK.led_positions_mm.copy()
    places[4, 1] = 22.0  # 7 mm beside m3: 84 px apart, and 52 px when tilted by 55 degrees
    brick = replace(BRICK, led_positions_mm=places)
    tilts = np.concatenate([np.linspace(15, 55, 8), np.linspace(55, 15, 8)[1:]])
    pictures, R, t = drawn([(0.0, 0.0, 132.0, tilt) for tilt in tilts], brick=brick, axis=(1.0, 0.0, 0.0))
    uv = CAMERA.project(leds_in_camera(R, t, brick)).uv_px
    apart_px = np.linalg.norm(uv[:, 3] - uv[:, 4], axis=-1)
    observed, track = tracked(pictures, brick)
    assert_identities_are_true(observed, R, t, brick)
    used = (observed.led_flags & NOT_USED) == 0
    assert (apart_px < 60).any()
    assert not used[apart_px < 60][:, [3, 4]].any()
    assert used[apart_px > 80].all()
    assert used[:, [0, 1, 2, 5, 6]].all()
    assert (np.abs(track.t_camera_brick_mm - t) < 2 * ERROR_MM).all()


def test_all_lost_for_half_a_second_and_found_again_elsewhere():
    before, after = [(-6.0, 3.0, 128.0, -8.0)] * 3, [(9.0, -5.0, 138.0, 12.0)] * 3
    pictures, _, t = drawn(before + after)
    observed, track = tracked(pictures[:3] + [None] * 15 + pictures[3:])
    lit = np.r_[0:3, 18:21]
    assert (observed.frame_flags[lit] == PoseFlag.NONE).all()
    assert ((observed.frame_flags[3:18] & PoseFlag.NO_POSE) != 0).all()
    assert np.isnan(track.t_camera_brick_mm[3:18]).all()
    assert (np.abs(track.t_camera_brick_mm[lit] - t) < ERROR_MM).all()


@pytest.mark.parametrize("visible", [0.5, 0.35])
def test_the_light_left_of_a_covered_led_is_told_by_its_shape_alone(visible):
    """One frame, so that no other says how large the LED is: half a disc has another outline than a dome."""
    pictures, _, _ = drawn([(0.0, 0.0, 132.0, 0.0)], covered_right_of=[{3: visible}])
    observed, _ = tracked(pictures)
    flags = observed.led_flags[0]
    assert flags[3] & NOT_USED
    assert not (flags[[0, 1, 2, 4, 5, 6]] & NOT_USED).any()
