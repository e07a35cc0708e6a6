"""The simulated lens against OpenCV's projection and undistortion."""

import cv2
import numpy as np
import pytest

from bricktrack_common.arrays import FloatArray
from bricktrack_device.sim.lens import Lens, lens_of


def opencv_model(lens: Lens) -> tuple[FloatArray, FloatArray]:
    K = np.array([[lens.focal_px, 0, lens.cx_px], [0, lens.focal_px, lens.cy_px], [0, 0, 1.0]])
    return K, np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])


@pytest.mark.parametrize("lens", [Lens(), lens_of(1), lens_of(77)])
def test_points_fall_where_opencv_projects_them(lens: Lens) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-70, -40, 100], [70, 40, 165], (500, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), *opencv_model(lens))
    np.testing.assert_allclose(lens.project(points), expected[:, 0], atol=1e-9)


def test_every_pixel_sees_the_ray_that_leads_back_to_it() -> None:
    lens = lens_of(3)
    slopes = lens.pixel_slopes
    assert slopes.shape == (1080, 1920, 2)
    points = np.concatenate([slopes, np.ones((1080, 1920, 1))], axis=-1)[::7, ::11].reshape(-1, 3)
    uv, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), *opencv_model(lens))
    v, u = np.mgrid[0:1080:7, 0:1920:11]
    # 1e-3 px is a tenth of the best centroid; the table interpolates between every eighth pixel.
    np.testing.assert_allclose(uv[:, 0], np.stack([u, v], axis=-1).reshape(-1, 2), atol=1e-3)


def test_the_distortion_is_one_to_one_over_the_picture() -> None:
    slopes = lens_of(1).pixel_slopes
    assert np.diff(slopes[..., 0], axis=1).min() > 0 and np.diff(slopes[..., 1], axis=0).min() > 0


def test_the_picture_spans_what_the_paper_s_plane_a_shows() -> None:
    # The paper's target is 124 x 68 mm and about fills the picture at z = 101.117 mm; pitch 4 mm is some 63 px.
    slopes = Lens().pixel_slopes * 101.117
    width, height = np.ptp(slopes[540, :, 0]), np.ptp(slopes[:, 960, 1])
    assert 110 < width < 130 and 62 < height < 72
    assert 4 / (slopes[540, 960, 0] - slopes[540, 959, 0]) == pytest.approx(65, abs=3)


def test_the_distortion_is_strong_enough_to_matter() -> None:
    lens = Lens()
    corner = lens.slopes(np.array([0.0, 0.0]))
    pinhole = np.array([lens.cx_px, lens.cy_px]) + lens.focal_px * corner
    assert np.linalg.norm(pinhole) > 25
