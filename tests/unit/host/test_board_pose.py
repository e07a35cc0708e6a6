"""Tilt, turn and focal length of boards drawn at known poses; means of pictures; the checks' figures."""

import os
from pathlib import Path

import numpy as np
import pytest
from board_pictures import BoardPose, Faults, camera_of, picture_of_board

from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dots.averaging import mean_picture, shift_between_px
from bricktrack_host.calibration.dots.board_pose import board_pose
from bricktrack_host.calibration.dots.dot_grid import GridOrigin
from bricktrack_host.calibration.dots.plane_pictures import place_dots, read_grey
from bricktrack_host.calibration.target.printed_target import DotTarget

TARGET = DotTarget(columns=32, rows=20, pitch_mm=4.0, diameter_mm=2.0)
SIZE = (960, 540)


@pytest.mark.parametrize("lens", [{"k1": -0.12}, {"k1": -0.3, "k2": 0.08}, {"k1": 0.06, "k2": -0.02}])
@pytest.mark.parametrize(
    ("pose", "recedes_deg"),
    [
        (BoardPose((0, 0, 110)), None),
        # Worked by hand: the board's lower edge goes back by sin(1.5 degrees).
        (BoardPose((3, -2, 101), 0.0, 1.5, 0.0), 90.0),
        # A turn about y by +1 degree brings the right edge nearer: the left one recedes.
        (BoardPose((3, -2, 130), 2.0, 0.0, 1.0), 182.0),
    ],
)
def test_a_boards_tilt_is_told_from_one_picture(lens, pose, recedes_deg):
    camera = camera_of(**lens)
    placed = place_dots(picture_of_board(TARGET, camera, pose, samples=2).grey, TARGET)[1]
    found = board_pose(placed, z_mm=pose.at_mm[2], size_px=SIZE)
    true = np.hypot(pose.tilt_x_deg, pose.tilt_y_deg)
    assert found.tilt_deg == pytest.approx(true, abs=0.05)  # the stated uncertainty
    assert found.turn_deg == pytest.approx(pose.turn_deg, abs=0.05)
    # The depth is meant on the axis; a tilted board's middle lies some um off that.
    assert found.f_px == pytest.approx(camera.f_px, rel=2e-3)
    if recedes_deg is not None:
        assert (found.recedes_deg - recedes_deg + 180) % 360 - 180 == pytest.approx(0, abs=3)


@pytest.mark.skipif(
    "BRICKTRACK_SAMPLES" not in os.environ, reason="BRICKTRACK_SAMPLES names no samples folder"
)
@pytest.mark.parametrize(("name", "z_mm"), [("calib_A_32x18.png", 101.117), ("calib_B_32x18.png", 161.111)])
def test_path_traced_boards_stand_square(name, z_mm):
    """Its README: the camera is exactly square to the planes."""
    grey, _ = read_grey(Path(os.environ["BRICKTRACK_SAMPLES"]) / "path-traced" / name)
    target = DotTarget(columns=32, rows=18, pitch_mm=4.0, diameter_mm=2.0, coded=False)
    _, placed = place_dots(grey, target, origin=GridOrigin((960, 540)))
    found = board_pose(placed, z_mm=z_mm, size_px=(1920, 1080))
    assert found.tilt_deg < 2 * found.tilt_sd_deg
    assert abs(found.turn_deg) < 0.1


def test_means_keep_what_rounding_loses():
    rng = np.random.default_rng(4)
    pictures = [(100.3 + rng.uniform(0, 1, (40, 60))).astype(np.uint8) for _ in range(64)]
    mean = mean_picture(pictures)
    assert mean.dtype == np.uint16
    # floor(100.3 + x): 100 with 70 %, 101 with 30 %; 64 x 2400 pixels.
    assert mean.mean() / 257 == pytest.approx(100.3, abs=0.01)
    assert mean_picture(pictures[:1]) is pictures[0]
    sixteen = [np.full((2, 3), v, np.uint16) for v in (65535, 65535, 65534)]
    np.testing.assert_array_equal(mean_picture(sixteen), 65535)
    with pytest.raises(CalibrationError, match="expected one size and type"):
        mean_picture([pictures[0], sixteen[0]])
    with pytest.raises(CalibrationError, match="none"):
        mean_picture([])


def test_movement_between_pictures_is_measured():
    camera = camera_of(640, 360)
    small = DotTarget(columns=14, rows=9, pitch_mm=4.0, diameter_mm=2.0)
    a, b = (
        place_dots(
            picture_of_board(
                small, camera, BoardPose((x, 0, 75)), size=(640, 360), faults=Faults(seed=k)
            ).grey,
            small,
        )[1]
        for k, x in enumerate((0.0, 0.03))
    )
    # f is 566 px: 0.03 / 75 * 566 = 0.226 px in the middle.
    assert shift_between_px(a, b) == pytest.approx(0.226, abs=0.02)
    assert shift_between_px(a, a) == 0
