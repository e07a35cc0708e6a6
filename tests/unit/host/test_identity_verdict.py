"""Pictures whose assignments are proposed: true ones with a false light among them, and rivals."""

import numpy as np
import pytest
from led_scenes import random_poses, seven_leds
from pinhole import PinholeCamera

from bricktrack_common.rotations import matrix_from_rvec
from bricktrack_host.tracking.identity.identity_verdict import Pictures
from bricktrack_host.tracking.led_model.led_profile import predict_brick
from bricktrack_host.tracking.pictures.segment import Blobs

CAMERA = PinholeCamera()
COLLAR = 0.7
BRICK = seven_leds(collar_mm=COLLAR)
R, T = random_poses(1, seed=8, tilt_deg=15.0)
SEEN, _ = predict_brick(R, T, CAMERA, BRICK, collar_mm=COLLAR)
COLUMN = np.array([0, 3, 4, 5])
P = BRICK.led_positions_mm


def blobs_of(uv, area):
    n = len(uv)
    return Blobs(
        uv_px=np.asarray(uv),
        cov_px2=np.broadcast_to(0.0025 * np.eye(2), (n, 2, 2)),
        area_px2=np.asarray(area),
        eccentricity=np.zeros(n),
        fill=np.ones(n),
        flags=np.zeros(n, dtype=np.int64),
    )


def verdict(proposals, *, off=(), collar=COLLAR):
    """Of a picture that shows the seven LEDs, then lights so far from some of them: (LED, (u, v))."""
    uv = SEEN.uv_px[0] + np.random.default_rng(1).normal(0, 0.05, (7, 2))
    more = np.array([uv[k] + d for k, d in off]).reshape(-1, 2)
    area = np.append(SEEN.area_px2[0], [SEEN.area_px2[0, k] for k, _ in off])
    pictures = Pictures(
        [blobs_of(np.concatenate([uv, more]), area)],
        CAMERA,
        BRICK,
        collar_mm=collar,
        gate_px=np.array([12.0]),
    )
    m = len(proposals)
    return pictures.decide(
        np.zeros(m, dtype=np.int64), np.array(proposals), (np.repeat(R, m, 0), np.repeat(T, m, 0))
    )


@pytest.mark.parametrize(
    ("off_px", "collar"),
    [(1.1, COLLAR), (1.5, COLLAR), (3.0, COLLAR), (3.0, None), (6.0, COLLAR), (6.0, None), (11.0, None)],
)
def test_a_false_light_within_the_gate_of_a_hidden_led_is_left_out(off_px, collar):
    # m0 and m4 are hidden: of a rigid brick at rest no light lies so far from where the others show the LED.
    found = verdict([[-1, 1, 2, 3, 7, 5, 6]], off=[(4, (0.6 * off_px, -0.8 * off_px))], collar=collar)
    assert found.blob_of_led[0].tolist() == [-1, 1, 2, 3, -1, 5, 6]
    assert not found.has_rival[0] and not found.is_chance[0]
    np.testing.assert_allclose(found.poses.t_camera_brick_mm[found.row[0]], T[0], atol=0.1 if collar else 0.7)


def test_two_false_lights_within_the_gates_of_hidden_leds_are_both_left_out():
    # Each bends the pose so that the other one fits the better: without one of them alone little is gained.
    found = verdict([[7, 1, 2, 8, 4, 5, 6]], off=[(0, (6.0, -7.0)), (3, (6.0, -7.0))])
    assert found.blob_of_led[0].tolist() == [-1, 1, 2, -1, 4, 5, 6]
    assert not found.has_rival[0]


def test_what_lights_cannot_tell_apart_is_left_out_and_the_rest_stands():
    # Two lights a tenth of a pixel apart, either of which may be m3.
    found = verdict([[0, 1, 2, 3, 4, 5, 6], [0, 1, 2, 7, 4, 5, 6]], off=[(3, (0.1, 0.0))])
    assert found.blob_of_led[0].tolist() == [0, 1, 2, -1, 4, 5, 6]
    assert not found.has_rival[0]


def test_leds_in_one_line_are_no_answer():
    found = verdict([[0, -1, -1, 3, 4, 5, 6], [0, -1, -1, 3, 4, 5, 7]], off=[(6, (0.1, 0.0))])
    assert found.blob_of_led[0, COLUMN].tolist() == COLUMN.tolist() or found.is_chance[0]
    assert found.has_rival[0]


def test_the_one_led_beside_a_line_stands_by_lesser_odds_than_leds_that_can_be_spared():
    found = verdict([[0, -1, -1, 3, 4, 5, 6]])
    assert found.blob_of_led[0].tolist() == [0, -1, -1, 3, 4, 5, 6] and not found.has_rival[0]


def test_the_one_led_beside_a_line_is_doubted_where_another_turn_about_the_line_fits_as_well():
    """Of m2 where it is, and a false light where m6 would be, were the brick turned about the column."""
    middle = P[COLUMN].mean(axis=0)
    turn = R[0] @ matrix_from_rvec(np.radians([0.0, 5.0, 0.0]))
    turned, _ = predict_brick(turn[None], T + (R[0] - turn) @ middle, CAMERA, BRICK, collar_mm=COLLAR)
    off = turned.uv_px[0, 6] - SEEN.uv_px[0, 6]
    assert np.linalg.norm(off) > 10  # px: of m6 as it is there is no light
    found = verdict([[0, -1, 2, 3, 4, 5, -1], [0, -1, -1, 3, 4, 5, 7]], off=[(6, off)])
    assert found.has_rival[0]


def test_no_pose_is_no_answer():
    found = verdict([[6, 5, 4, 3, 2, 1, 0]])
    assert found.row[0] == -1 or found.is_chance[0] or found.has_rival[0]
