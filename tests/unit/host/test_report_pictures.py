"""The pictures of a report come back from disk as they were shown, and old ones in the size of today."""

import cv2
import numpy as np
import pytest

from bricktrack_common.errors import RunFormatError
from bricktrack_host.reporting.page_picture import page_picture
from bricktrack_host.reporting.plots import CalibrationPicture, FrameOverlay
from bricktrack_host.reporting.report_pictures import load_pictures, save_pictures

CALIBRATION = CalibrationPicture(1920, 1080, [np.array([[0.0, 0], [9, 0], [9, 9]])], np.empty((0, 2)))
UV_PX = np.array([[700.0, 400.0], [np.nan, np.nan]])


def photo():
    image = np.zeros((1080, 1920), np.uint8)
    image[380:420, 680:720] = 240
    return image


def test_pictures_come_back_as_they_were_shown(tmp_path):
    shown = FrameOverlay("frame 7, 0.23 s", page_picture(photo()), UV_PX, UV_PX + 0.25)
    save_pictures(tmp_path / "pictures.npz", [shown], CALIBRATION)
    (back,), calibration = load_pictures(tmp_path / "pictures.npz")
    assert (back.title, back.picture) == (shown.title, shown.picture)
    np.testing.assert_array_equal(back.predicted_uv_px, UV_PX + 0.25)
    np.testing.assert_array_equal(calibration.covered_uv_px[0], CALIBRATION.covered_uv_px[0])


def test_a_picture_for_a_page_is_the_same_scene_in_half_the_size():
    picture = page_picture(photo())
    small = cv2.imdecode(np.frombuffer(picture.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert (picture.width_px, picture.height_px, small.shape) == (1920, 1080, (540, 960))
    lit = np.argwhere(small > 120)
    assert lit.min(axis=0).tolist() == [190, 340] and lit.max(axis=0).tolist() == [209, 359]


def test_pictures_of_earlier_versions_are_shrunk_when_they_are_read(tmp_path):
    # As versions before wrote them: the whole picture, and no word on its size.
    np.savez(
        tmp_path / "pictures.npz", size_px=np.array([1920, 1080]), n_outlines=np.array(0),
        titles=np.array(["frame 0, 0.00 s"]), jpeg_0=cv2.imencode(".jpg", photo())[1],
        detected_0=UV_PX, predicted_0=UV_PX,
    )  # fmt: skip
    (back,), _ = load_pictures(tmp_path / "pictures.npz")
    small = cv2.imdecode(np.frombuffer(back.picture.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert (back.picture.width_px, back.picture.height_px, small.shape) == (1920, 1080, (540, 960))


def test_what_is_no_picture_is_refused(tmp_path):
    np.savez(
        tmp_path / "pictures.npz", size_px=np.array([9, 9]), n_outlines=np.array(0), titles=np.array(["a"]),
        jpeg_0=np.zeros(9, np.uint8), detected_0=UV_PX, predicted_0=UV_PX,
    )  # fmt: skip
    with pytest.raises(RunFormatError, match="picture 0 is no JPEG. Process the run again"):
        load_pictures(tmp_path / "pictures.npz")
