"""Pictures of several planes, and of a board that was shifted in its plane, come in one set of millimetres."""

import cv2
import numpy as np
import pytest
from board_pictures import BoardPose, Faults, camera_of, picture_of_board

from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dots.merged_boards import merge_boards
from bricktrack_host.calibration.dots.plane_pictures import (
    merged_planes,
    observe_pictures,
    place_dots,
    read_grey,
)
from bricktrack_host.calibration.target.printed_target import DotTarget

TARGET = DotTarget(columns=18, rows=12, pitch_mm=4.0, diameter_mm=2.0)
CAMERA = camera_of()
SHIFTED = (
    BoardPose((0.0, 0.0, 101.0), 1.0),
    BoardPose((28.0, -9.0, 101.0), -2.0),
    BoardPose((-25.0, 12.0, 101.0), 91.0),
)


def placed(pose, target=TARGET, **faults):
    picture = picture_of_board(target, CAMERA, pose, faults=Faults(**faults), samples=4)
    return place_dots(picture.grey, target)[1]


def test_shifted_and_turned_boards_become_one():
    merged = merge_boards([placed(p) for p in SHIFTED])
    assert len(merged.dots) > 2.2 * 150
    # Truth: each dot's centroid is on the plane where the camera says. The bias of the discs is left in
    # (0.02 px), so 1 px = 0.12 mm makes some um; the first board's pose takes camera to board axes.
    on_plane = CAMERA.points_on_plane(merged.dots.uv_px, 101.0)
    first = SHIFTED[0]
    true = (on_plane - np.array(first.at_mm)[:2]) @ first.rotation[:2, :2]
    error_um = 1e3 * np.hypot(*(merged.dots.xy_mm - true).T)
    assert np.median(error_um) < 4
    assert error_um.max() < 30
    np.testing.assert_allclose(merged.turns_deg, [0, -3, 90], atol=0.02)
    for k, pose in enumerate(SHIFTED):
        shift = (np.array(pose.at_mm) - first.at_mm)[:2] @ first.rotation[:2, :2]
        np.testing.assert_allclose(merged.shifts_mm[k], shift, atol=0.005)


def test_boards_that_do_not_belong_together_are_refused():
    here, there = placed(BoardPose((-30, 0, 110))), placed(BoardPose((38, 0, 110)))
    with pytest.raises(
        CalibrationError, match=r"board 2 of 2: \d+ of its dots lie among those of the others"
    ):
        merge_boards([here, there])
    nearer = placed(BoardPose((5, 0, 107.0)))
    with pytest.raises(CalibrationError, match="2 boards disagree by .* µm where they overlap"):
        merge_boards([placed(BoardPose((-10, 0, 110))), nearer])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures")
    for name, z, turn, bits in (("a.png", 80.0, 178.0, 8), ("b.png", 125.0, 181.0, 16)):
        picture = picture_of_board(TARGET, CAMERA, BoardPose((2, 1, z), turn), bits=bits)
        cv2.imwrite(str(folder / name), picture.grey)
    return folder


def test_planes_share_their_axes_and_know_their_files(folder):
    steps = []
    pictures = observe_pictures(
        [(125.0, folder / "b.png"), (80.0, folder / "a.png")],
        TARGET,
        progress=lambda done, of: steps.append((done, of)),
    )
    assert steps == [(1, 2), (2, 2)]
    assert [p.size_px for p in pictures] == [(960, 540)] * 2
    assert len(pictures[0].sha256) == 64
    for p in pictures:
        # Upside down, but x runs along +u as on the picture: mm and px grow together.
        assert np.corrcoef(p.placed.xy_mm[:, 0], p.placed.uv_px[:, 0])[0, 1] > 0.99
    planes = merged_planes(pictures)
    assert [z for z, _ in planes] == [80.0, 125.0]
    np.testing.assert_array_equal(planes[0][1].shifts_mm, [[0, 0]])


def test_sixteen_bits_are_kept_and_no_picture_is_named(folder, tmp_path):
    assert read_grey(folder / "b.png")[0].dtype == np.uint16
    assert read_grey(folder / "a.png")[0].dtype == np.uint8
    (tmp_path / "x.png").write_text("no picture")
    with pytest.raises(CalibrationError, match=r"x\.png: not a picture"):
        read_grey(tmp_path / "x.png")
    with pytest.raises(CalibrationError, match=r"none\.png: No such file"):
        observe_pictures([(80.0, tmp_path / "none.png")], TARGET)
    cv2.imwrite(str(tmp_path / "dark.png"), np.zeros((540, 960), np.uint8))
    with pytest.raises(CalibrationError, match=r"dark\.png: no dots found"):
        observe_pictures([(80.0, tmp_path / "dark.png")], TARGET)
