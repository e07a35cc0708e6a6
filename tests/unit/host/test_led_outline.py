import numpy as np
import pytest
from pinhole import PinholeCamera

from bricktrack_host.tracking.led_model.led_outline import LARGEST_SIZE, LARGEST_TANGENT, outlines_of
from bricktrack_host.tracking.led_model.led_profile import outline_moments, predict_leds

CAMERA = PinholeCamera()  # 1560 px: 12 px/mm at 130 mm
RADIUS_MM = 3.0


def views(n, seed, largest_deg=85.0):
    """LEDs at 130 mm and nearer, seen from all sides."""
    rng = np.random.default_rng(seed)
    centres = np.column_stack([rng.uniform(-30, 30, n), rng.uniform(-15, 15, n), rng.uniform(100, 160, n)])
    away = -centres / np.linalg.norm(centres, axis=1, keepdims=True)
    across = np.cross(away, rng.normal(size=(n, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    psi = np.radians(rng.uniform(0, largest_deg, (n, 1)))
    return centres, np.cos(psi) * away + np.sin(psi) * across


@pytest.mark.parametrize("collar", [-1.0, -0.4, 0.0, 0.4, 0.9, 2.0])
def test_centroids_from_the_table_are_those_of_the_closed_form(collar):
    # On the camera's axis, no distortion: a millimetre along the projected axis is f / z px.
    plain = PinholeCamera(k1=0.0, k2=0.0, p1=0.0, p2=0.0)
    psi = np.radians(np.random.default_rng(1).uniform(0.01, 85, 4000))
    z = np.random.default_rng(2).uniform(90.0, 170.0, psi.size)
    centre = np.column_stack([0 * z, 0 * z, z])
    axis = np.column_stack([np.sin(psi), 0 * psi, -np.cos(psi)])
    area, centroid, _ = outline_moments(np.cos(psi), radius_mm=RADIUS_MM, collar_mm=collar, distance_mm=z)
    seen = predict_leds(centre, axis, RADIUS_MM, plain, collar_mm=collar)
    np.testing.assert_allclose(seen.uv_px[:, 0] - 959.5, centroid * 1560.0 / z, atol=1e-4)
    # Where the dome hides its rim, within two degrees, the table stands, and a tall dome's area still grows.
    np.testing.assert_allclose(seen.area_px2, area * (1560.0 / z) ** 2, rtol=1e-4 if collar >= 0 else 5e-4)


def test_leds_of_several_radii_have_each_their_own_outline():
    centres, axes = views(6, seed=3)
    radii = np.array([3.0, 1.5, 3.0, 2.5, 1.5, 0.001])
    assert len(np.unique(outlines_of(radii, 0.9).kind)) == 4
    together = predict_leds(centres, axes, radii, CAMERA, collar_mm=0.9)
    for k, radius in enumerate(radii):
        alone = predict_leds(centres[k], axes[k], radius, CAMERA, collar_mm=0.9)
        np.testing.assert_array_equal(together.uv_px[k], alone.uv_px)
        np.testing.assert_array_equal(together.area_px2[k], alone.area_px2)


def test_an_unknown_profile_has_the_spheres_outline_from_every_side():
    centres, axes = views(50, seed=4, largest_deg=170.0)
    seen = predict_leds(centres, axes, RADIUS_MM, CAMERA, collar_mm=None)
    front = predict_leds(
        centres, -centres / np.linalg.norm(centres, axis=1, keepdims=True), RADIUS_MM, CAMERA, collar_mm=None
    )
    np.testing.assert_allclose(seen.area_px2, front.area_px2, rtol=1e-9)
    np.testing.assert_allclose(seen.uv_px, front.uv_px, atol=0.005)  # the lens's part goes by e1 and e2


@pytest.mark.parametrize("collar", [None, 0.9])
def test_an_led_inside_the_lens_or_behind_it_is_nothing(collar):
    near_mm = RADIUS_MM / LARGEST_SIZE
    for z, is_seen in ((1.01 * near_mm, True), (0.99 * near_mm, False), (-130.0, False)):
        centre, axis = np.array([0.0, 0.0, z]), np.array([0.0, 0.0, -1.0])
        seen = predict_leds(centre, axis, RADIUS_MM, CAMERA, collar_mm=collar)
        assert bool(np.isfinite(seen.uv_px).all()) is is_seen
        assert bool(np.isfinite(seen.area_px2)) is is_seen


def test_the_tables_reach_beyond_what_can_be_seen():
    assert 2 * np.degrees(np.arctan(LARGEST_TANGENT)) > 110
    table = outlines_of(np.full(7, RADIUS_MM), 0.9).tables
    assert np.isfinite(table).all()
