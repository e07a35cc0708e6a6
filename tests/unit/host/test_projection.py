import numpy as np
import pytest
from pinhole import PinholeCamera

from bricktrack_host.evaluation.true_camera import TrueCamera
from bricktrack_host.tracking.led_model.projection import project_points

CAMERAS = {
    "pinhole": PinholeCamera(),
    "calibrated": TrueCamera.of_seed(3).calibrated(noise_px=0.05, rng=np.random.default_rng(3)),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_points_fall_where_the_camera_model_has_them(name):
    camera = CAMERAS[name]
    rng = np.random.default_rng(1)
    points = rng.uniform([-110, -70, 60], [110, 70, 320], (4000, 3)).reshape(40, 100, 3)
    expected = camera.project(points).uv_px
    uv = project_points(points, camera)
    inside = ((expected >= 0) & (expected <= [1919, 1079])).all(axis=-1)
    assert 0.2 < inside.mean() < 0.9
    # The cells' cubics follow the rays to 1e-6 mm, 1e-5 px.
    np.testing.assert_allclose(uv[inside], expected[inside], atol=3e-5)
    np.testing.assert_array_equal(uv[~inside], expected[~inside])


def test_points_behind_the_camera_and_unknown_ones_are_not_seen():
    points = np.array([[0.0, 0.0, -100.0], [np.nan, 0.0, 130.0], [0.0, 0.0, 130.0]])
    camera = CAMERAS["calibrated"]
    np.testing.assert_array_equal(np.isfinite(project_points(points, camera)[:, 0]), [False, False, True])
