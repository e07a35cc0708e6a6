import numpy as np
import pytest
from led_scenes import lit_outline, polygon_centroid, random_poses, seven_leds
from pinhole import PinholeCamera
from scipy.spatial.transform import Rotation

from bricktrack_host.tracking.led_model.led_profile import outline_moments, predict_brick, predict_leds

CAMERA = PinholeCamera()
FAR_MM = 1e9


@pytest.mark.parametrize("psi_deg", [0.0, 20.0, 59.0, 80.0])
def test_a_bare_hemisphere_from_afar_obeys_the_known_formula(psi_deg):
    c = np.cos(np.radians(psi_deg))
    area, centroid, _ = outline_moments(c, radius_mm=3.0, collar_mm=0.0, distance_mm=FAR_MM)
    # DESIGN 7.1: (4 r / 3 pi)(1 - cos psi); 0.62 mm at 59 degrees.
    assert centroid == pytest.approx(4 * 3.0 / (3 * np.pi) * (1 - c), abs=1e-6)
    assert area == pytest.approx(np.pi * 9 * (1 + c) / 2, rel=1e-8)  # the far distance cancels digits


def test_a_collar_seen_from_the_side_is_a_rectangle_with_a_half_disc():
    # By hand: half disc pi r^2 / 2 at 4 r / 3 pi, rectangle 2 r h at -h / 2.
    r, h = 3.0, 2.0
    half, box = np.pi * r * r / 2, 2 * r * h
    expected = (half * 4 * r / (3 * np.pi) - box * h / 2) / (half + box)
    area, centroid, _ = outline_moments(0.0, radius_mm=r, collar_mm=h, distance_mm=FAR_MM)
    assert area == pytest.approx(half + box, rel=1e-6)
    assert centroid == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("psi_deg", [0.0, 20.0, 59.0, 80.0])
def test_half_an_ellipsoid_from_afar_is_two_half_ellipses(psi_deg):
    # By hand: half axes along the projected axis are sqrt(r^2 cos^2 + (r + 1.5)^2 sin^2) in front and r cos
    # at the rear; the centroid of half an ellipse is 4 / (3 pi) of its half axis from the middle.
    psi = np.radians(psi_deg)
    front, rear = np.hypot(3.0 * np.cos(psi), 4.5 * np.sin(psi)), 3.0 * np.cos(psi)
    area, centroid, half = outline_moments(np.cos(psi), radius_mm=3.0, collar_mm=-1.5, distance_mm=1e5)
    assert centroid == pytest.approx(4 / (3 * np.pi) * (front - rear), abs=1e-4)
    assert area == pytest.approx(np.pi * 3.0 * (front + rear) / 2, rel=1e-4)
    assert half == pytest.approx((front + rear) / 2, rel=1e-4)


@pytest.mark.parametrize("collar", [-1.0, -0.3, 0.0, 0.7, 2.0])
@pytest.mark.parametrize("psi_deg", [0.0, 5.0, 30.0, 57.0, 75.0])
def test_the_centroid_is_that_of_the_projected_surface(collar, psi_deg):
    centre = np.array([-28.0, 15.0, 125.0])
    away = -centre / np.linalg.norm(centre)
    axis = Rotation.from_rotvec(np.radians(psi_deg) * np.array([0.28, 0.96, 0.0])).apply(away)
    expected, area = polygon_centroid(
        lit_outline(centre, axis, radius=3.0, collar=collar, camera=CAMERA, n=720)
    )
    seen = predict_leds(centre, axis, 3.0, CAMERA, collar_mm=collar)
    # The four points take the outline's second moments for an ellipse's: of 0.2 px of distortion across it,
    # 5 % for usual collars, 10 % for long ones.
    np.testing.assert_allclose(seen.uv_px, expected, atol=0.01 if -1 < collar < 1 else 0.02)
    # The picture's scale is taken at the sphere: 0.2 % less than a millimetre beside, where tall domes have
    # their light.
    assert seen.area_px2 == pytest.approx(area, rel=2e-3 if collar >= 0 else 3e-3)
    assert seen.facing == pytest.approx(np.cos(np.radians(psi_deg)), abs=2e-3)


def test_an_unknown_profile_is_a_sphere_with_its_perspective():
    pinhole = PinholeCamera(k1=0.0, k2=0.0, p1=0.0, p2=0.0)
    centre = np.array([40.0, 0.0, 120.0])
    D = np.linalg.norm(centre)
    cos2 = (120.0 / D) ** 2
    seen = predict_leds(centre, np.array([0.0, 0.0, -1.0]), 3.0, pinhole, collar_mm=None)
    # DESIGN 7.1: the ellipse's centre is the image of the centre times cos^2 / (cos^2 - (r / D)^2).
    expected = 1560.0 * (40.0 / 120.0) * cos2 / (cos2 - (3.0 / D) ** 2)
    assert seen.uv_px[0] - 959.5 == pytest.approx(expected, abs=0.002)
    assert seen.uv_px[1] == pytest.approx(539.5, abs=1e-9)


def test_the_unknown_shift_lies_along_the_projected_axis():
    axis = np.array([0.8, 0.0, -0.6])
    seen = predict_leds(np.array([0.0, 0.0, 130.0]), axis, 3.0, CAMERA, collar_mm=None)
    px_per_mm = 1560.0 / 130.0
    assert seen.model_shift_px[0] == pytest.approx(0.1 * 3.0 * 0.8 * px_per_mm, rel=0.02)
    assert abs(seen.model_shift_px[1]) < 0.02


@pytest.mark.parametrize("collar", [None, 0.0, 0.9])
def test_the_derivative_by_the_pose_meets_finite_differences(collar):
    brick = seven_leds()
    R, t = random_poses(4, seed=1)
    _, J = predict_brick(R, t, CAMERA, brick, collar_mm=collar)
    step = 1e-5
    for k in range(6):
        d = np.zeros(6)
        d[k] = step
        turn = Rotation.from_rotvec(d[:3]).as_matrix()
        high, _ = predict_brick(R @ turn, t + d[3:], CAMERA, brick, collar_mm=collar)
        low, _ = predict_brick(R @ turn.T, t - d[3:], CAMERA, brick, collar_mm=collar)
        numeric = (high.uv_px - low.uv_px) / (2 * step)
        # Of the lens's curvature only the change with distance is taken along: the rest is some 0.15 %.
        np.testing.assert_allclose(J[..., k], numeric, atol=2e-3 * np.abs(J).max(axis=(0, 1, 2))[k])
