"""Ray models fitted to dots seen by cameras whose rays are known: a Brown-Conrady pinhole and one with a
wandering pupil. The cameras are written here, apart from the product.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.errors import CalibrationError, ShapeError
from bricktrack_host.calibration.dots.disc_bias import disc_bias_px, disc_diameter_mm
from bricktrack_host.calibration.dots.dot_observations import DotObservations
from bricktrack_host.calibration.rays.central_rays import fit_central_rays
from bricktrack_host.calibration.rays.cross_validation import left_out_errors_mm
from bricktrack_host.calibration.rays.dot_data import gather
from bricktrack_host.calibration.rays.gross_outliers import gross_outliers
from bricktrack_host.calibration.rays.irt import fit_two_plane_irt
from bricktrack_host.calibration.rays.ray_calibration import calibrate_rays, centrality_test, choose_model
from bricktrack_host.calibration.rays.ray_families import CentralFamily, TwoPlaneFamily
from bricktrack_host.calibration.rays.ray_fit import fit_rays, terms_needed

A_MM, B_MM = 101.117, 161.111
FOCAL_PX, K1, K2, K3, P1, P2 = 1650.0, -0.28, 0.10, -0.02, 3e-4, -2e-4
CENTRE_PX = (963.2, 534.8)


def pinhole_px(xyz_mm, *, wander_mm=0.0):
    """Brown-Conrady; with ``wander_mm`` the pupil of a ray of slope r moves by wander r^2 along the axis."""
    xyz = np.asarray(xyz_mm, dtype=float)
    z0 = np.zeros(xyz.shape[:-1])
    for _ in range(30 if wander_mm else 1):
        x, y = xyz[..., 0] / (xyz[..., 2] - z0), xyz[..., 1] / (xyz[..., 2] - z0)
        r2 = x * x + y * y
        z0 = wander_mm * r2
    radial = 1 + K1 * r2 + K2 * r2**2 + K3 * r2**3
    u = x * radial + 2 * P1 * x * y + P2 * (r2 + 2 * x * x)
    v = y * radial + P1 * (r2 + 2 * y * y) + 2 * P2 * x * y
    return FOCAL_PX * np.stack([u, v], axis=-1) + CENTRE_PX


def see(z_mm, *, columns=32, rows=18, noise_px=0.0, seed=0, turn_deg=0.0, shift_mm=(0.0, 0.0), **camera):
    """Dots of a board in the plane z, in camera millimetres, as many as the picture shows."""
    i, j = np.meshgrid(np.arange(columns), np.arange(rows))
    xy = 4.0 * np.stack([i - (columns - 1) / 2, j - (rows - 1) / 2], axis=-1).reshape(-1, 2)
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    xy = xy @ np.array([[c, s], [-s, c]]) + shift_mm
    uv = pinhole_px(np.column_stack([xy, np.full(len(xy), z_mm)]), **camera)
    keep = np.all((uv > 16) & (uv < [1920 - 17, 1080 - 17]), axis=1)
    uv = uv[keep] + np.random.default_rng(int(seed)).normal(0, noise_px, (int(keep.sum()), 2))
    cov = np.broadcast_to(np.eye(2) * max(noise_px, 1e-3) ** 2, (len(uv), 2, 2))
    index = np.stack([i.ravel(), j.ravel()], axis=1)[keep]
    return DotObservations(uv, xy[keep], cov, np.full(len(uv), 800.0), index)


def errors_um(model, z_mm, uv_from_mm=(54, 40), inside=None, **camera):
    """Distances on the plane between true points and where the model says their pixels look."""
    i, j = np.meshgrid(np.linspace(-1, 1, uv_from_mm[0]), np.linspace(-1, 1, uv_from_mm[1]))
    xy = np.column_stack([i.ravel() * 0.62 * z_mm, j.ravel() * 0.36 * z_mm])
    uv = pinhole_px(np.column_stack([xy, np.full(len(xy), z_mm)]), **camera)
    keep = np.all((uv >= 0) & (uv <= [1919, 1079]), axis=1)
    if inside is not None:
        keep &= inside(uv)
    assert keep.sum() > 300
    return 1e3 * np.hypot(*(model.points_on_plane(uv[keep], z_mm) - xy[keep]).T)


def fit_both(order_two=5, order_central=9, **scene):
    a, b = see(A_MM, **scene), see(B_MM, seed=scene.pop("seed", 0) + 1, **scene)
    return (
        fit_two_plane_irt([(A_MM, a), (B_MM, b)], sensor_mode=IMX219_1080P, order=order_two),
        fit_central_rays([(A_MM, a), (B_MM, b)], sensor_mode=IMX219_1080P, order=order_central),
    )


@pytest.fixture(scope="module")
def exact():
    """Both models from noise-free dots."""
    return dict(zip(("two-plane", "central"), fit_both(), strict=True))


@pytest.fixture(scope="module")
def noisy_planes():
    return [(A_MM, see(A_MM, noise_px=0.02, seed=1)), (B_MM, see(B_MM, noise_px=0.02, seed=2))]


def test_central_rays_find_the_pinhole(exact):
    model = exact["central"]
    # The lens has terms of order 7 at slopes up to 0.7; what order 9 leaves is below a micrometre.
    assert np.abs(model.centre_mm).max() < 0.002
    for z_mm in (A_MM, 130.0, B_MM):
        assert errors_um(model, z_mm).max() < 1.0


def test_two_planes_see_as_the_pinhole_does_where_dots_were(exact):
    model = exact["two-plane"]
    for z_mm in (A_MM, 130.0, B_MM):
        inside = errors_um(model, z_mm, inside=model.is_covered)
        assert inside.mean() < 3.0
        assert inside.max() < 20.0
    # Beyond the dots of plane B the order-5 polynomial leaves the lens: known, and the reason for coverage.
    assert errors_um(model, B_MM).max() > 5 * errors_um(model, B_MM, inside=model.is_covered).max()


def test_the_fit_reproduces_a_polynomial_camera_exactly():
    """A map that *is* of order 5 comes back to rounding, with the paper's 21 coefficients a coordinate."""
    rng = np.random.default_rng(3)
    i, j = np.meshgrid(np.linspace(30, 1890, 25), np.linspace(30, 1050, 15))
    uv = np.stack([i.ravel(), j.ravel()], axis=1)
    s, t = (uv - [959.5, 539.5]).T / np.array([[959.5], [539.5]])
    C = rng.normal(0, 0.5, (4, 6, 6))
    C[0, 1, 0], C[1, 0, 1], C[2, 1, 0], C[3, 0, 1] = 60, 34, 96, 54
    xy = np.array([sum(c[r, q] * s**r * t**q for r in range(6) for q in range(6 - r)) for c in C])
    cov, index = np.broadcast_to(np.eye(2), (len(uv), 2, 2)), np.zeros((len(uv), 2), dtype=np.int64)
    a, b = (DotObservations(uv, xy[k : k + 2].T, cov, np.ones(len(uv)), index) for k in (0, 2))
    model = fit_two_plane_irt([(A_MM, a), (B_MM, b)], sensor_mode=IMX219_1080P, order=5)
    assert model.coefficients_a.shape == (2, 21)
    np.testing.assert_allclose(model.coefficients_a[0, 1], C[0, 1, 0], rtol=1e-9)  # s^1 t^0
    np.testing.assert_allclose(model.coefficients_b[1, 4], C[3, 1, 1], rtol=1e-7)  # s^1 t^1
    assert max(r.max_um for r in model.residuals) < 1e-6
    middle = (xy[0:2] + xy[2:4]).T / 2  # halfway between the planes
    np.testing.assert_allclose(model.points_on_plane(uv, (A_MM + B_MM) / 2), middle, atol=1e-9)


@pytest.mark.parametrize("kind", ["two-plane", "central"])
@settings(max_examples=60, deadline=None)
@given(u=st.floats(0, 1919), v=st.floats(0, 1079), z_mm=st.floats(85, 250), du=st.floats(-40, 40))
def test_points_project_back_to_their_pixels(exact, kind, u, v, z_mm, du):
    model = exact[kind]
    uv = np.array([[u, v], [np.clip(u + du, 0, 1919), v]])
    xy = model.points_on_plane(uv, z_mm)
    back = model.project(np.column_stack([xy, np.full(2, z_mm)])).uv_px
    np.testing.assert_allclose(back, uv, atol=1e-9)


@pytest.mark.parametrize("kind", ["two-plane", "central"])
def test_the_jacobian_meets_finite_differences(exact, kind):
    model = exact[kind]
    rng = np.random.default_rng(4)
    uv = rng.uniform([20, 20], [1900, 1060], (200, 2))
    z_mm = rng.uniform(95, 170, 200)
    points = np.column_stack([model.points_on_plane(uv, z_mm), z_mm])
    J = model.project(points).J_px_per_mm
    step = 1e-4
    for axis in range(3):
        d = np.zeros(3)
        d[axis] = step
        numeric = (model.project(points + d).uv_px - model.project(points - d).uv_px) / (2 * step)
        # Truncation J''' step^2 and rounding 1e-12 px / step are both below 1e-7 px/mm.
        np.testing.assert_allclose(J[..., axis], numeric, atol=2e-6)


@pytest.mark.parametrize("kind", ["two-plane", "central"])
def test_batches_have_the_shape_of_their_points(exact, kind):
    model = exact[kind]
    points = np.array([[3.0, -4.0, 120.0], [np.nan, 0.0, 120.0], [-20.0, 10.0, 150.0]])
    seen = model.project(np.broadcast_to(points, (5, 7, 3, 3)))
    assert seen.uv_px.shape == (5, 7, 3, 2)
    assert seen.J_px_per_mm.shape == (5, 7, 3, 2, 3)
    np.testing.assert_allclose(seen.uv_px[4, 6, 0], model.project(points[0]).uv_px, atol=1e-10)
    assert np.isnan(seen.uv_px[:, :, 1]).all()
    assert np.isfinite(seen.uv_px[:, :, [0, 2]]).all()
    assert model.project(np.empty((0, 7, 3))).uv_px.shape == (0, 7, 2)
    with pytest.raises(ShapeError):
        model.project(np.zeros((4, 2)))


@pytest.mark.parametrize("kind", ["two-plane", "central"])
def test_what_no_pixel_sees_is_nan(exact, kind):
    nowhere = exact[kind].project(
        [[5.0, 5.0, -50.0], [0.0, 0.0, 0.0], [500.0, 0.0, 100.0], [0.0, 1e6, 100.0], [-90.0, 60.0, 100.0]]
    )
    assert np.isnan(nowhere.uv_px).all()
    assert np.isnan(nowhere.J_px_per_mm).all()


def test_coverage_is_where_dots_were(exact):
    two, central = exact["two-plane"], exact["central"]
    corner_of_b = pinhole_px([-58.0, -34.0, B_MM])  # inside the board at B, well inside the picture
    inside, outside = corner_of_b + 40.0, corner_of_b - 40.0
    assert two.is_covered(inside) and not two.is_covered(outside)
    assert central.is_covered(outside)  # there were dots at plane A
    assert not central.is_covered([3.0, 3.0])
    assert not two.is_covered([np.nan, 500.0])
    assert two.is_covered(np.full((4, 7, 2), 500.0)).shape == (4, 7)


@pytest.mark.parametrize("kind", ["two-plane", "central"])
def test_a_turned_and_shifted_board_gives_the_same_rays(kind):
    pick = 0 if kind == "two-plane" else 1
    square = fit_both()[pick]
    turned = fit_both(turn_deg=17.0, shift_mm=(5.0, -3.0))[pick]
    uv = np.array([[400.0, 300.0], [960.0, 540.0], [1500.0, 800.0], [1300.0, 250.0]])
    # Not equal: order 5 leaves some micrometres, differently at other dots.
    tolerance_mm = 6e-3 if kind == "two-plane" else 3e-4
    np.testing.assert_allclose(
        turned.points_on_plane(uv, B_MM), square.points_on_plane(uv, B_MM), atol=tolerance_mm
    )


def test_the_covariance_is_that_of_repeated_calibrations():
    depths, points, sd = [], [], []
    uv = np.array([[960.0, 540.0], [500.0, 200.0]])
    for seed in range(40):
        planes = [(z, see(z, columns=20, noise_px=0.3, seed=100 * z + seed)) for z in (A_MM, B_MM)]
        model = fit_central_rays(planes, sensor_mode=IMX219_1080P, order=5)
        depths.append(model.centre_mm[2])
        points.append(model.points_on_plane(uv, 140.0))
        sd.append(model.point_sd_mm(uv, 140.0))
    # 40 samples know a standard deviation to 11 %.
    assert 0.7 < np.std(depths) / np.sqrt(model.covariance[-1, -1]) < 1.35
    spread = np.std(points, axis=0).max(axis=1)
    np.testing.assert_allclose(spread / np.mean(sd, axis=0), 1.0, atol=0.35)


def test_two_plane_covariance_is_that_of_repeated_calibrations():
    uv = np.array([[960.0, 540.0], [660.0, 300.0]])
    points, sd = [], []
    for seed in range(20):
        a, b = (see(z, columns=20, noise_px=0.3, seed=100 * z + seed) for z in (A_MM, B_MM))
        model = fit_two_plane_irt([(A_MM, a), (B_MM, b)], sensor_mode=IMX219_1080P)
        points.append(model.points_on_plane(uv, 140.0))
        sd.append(model.point_sd_mm(uv, 140.0))
    spread = np.std(points, axis=0).mean(axis=1)
    np.testing.assert_allclose(spread / np.mean(sd, axis=0), 1.0, atol=0.45)  # 20 samples know it to 16 %


def test_too_little_is_refused_with_words():
    a, b = see(A_MM), see(B_MM)
    few = a.select(np.arange(len(a)) < 15)
    with pytest.raises(CalibrationError, match="15 dots for 21 coefficients"):
        fit_two_plane_irt([(A_MM, few), (B_MM, b)], sensor_mode=IMX219_1080P)
    with pytest.raises(CalibrationError, match="different depths over 0"):
        fit_two_plane_irt([(-A_MM, a), (B_MM, b)], sensor_mode=IMX219_1080P)
    with pytest.raises(CalibrationError, match="undetermined"):
        lines = np.isin(a.column_row[:, 1], (5, 6, 7))
        fit_two_plane_irt([(A_MM, a.select(lines)), (B_MM, b)], sensor_mode=IMX219_1080P)
    with pytest.raises(CalibrationError, match="different depths"):
        fit_central_rays([(A_MM, a), (A_MM, a)], sensor_mode=IMX219_1080P)
    with pytest.raises(CalibrationError, match="projection centre is not found"):
        fit_central_rays([(A_MM, a), (B_MM, a)], sensor_mode=IMX219_1080P, order=3)


@pytest.mark.parametrize("kind", ["central", "two-plane"])
def test_left_out_errors_are_those_of_fits_without_the_block(noisy_planes, kind):
    """Against refitting: the closed form must give what leaving dots out gives."""
    fold = np.concatenate([np.arange(len(d)) % 5 for _, d in noisy_planes])
    data = gather(noisy_planes, sensor_mode=IMX219_1080P, order=terms_needed(5, 400))
    family = CentralFamily() if kind == "central" else TwoPlaneFamily(0.0)
    errors = left_out_errors_mm(fit_rays(data, family, order=5), fold)
    left = fold == 2
    ends = np.cumsum([len(d) for _, d in noisy_planes])[:-1]
    rest = [(z, d.select(~out)) for (z, d), out in zip(noisy_planes, np.split(left, ends), strict=True)]
    fit = fit_central_rays if kind == "central" else fit_two_plane_irt
    refitted = fit(rest, sensor_mode=IMX219_1080P, order=5)
    for (z, d), out, error in zip(noisy_planes, np.split(left, ends), np.split(errors, ends), strict=True):
        expected = refitted.points_on_plane(d.uv_px[out], z) - d.xy_mm[out]
        # The refit finds its own noise and depth of the centre; both move by their standard deviation's share.
        np.testing.assert_allclose(error[out], expected, atol=4e-4)
        assert np.sqrt(np.mean((error[out] - expected) ** 2)) < 0.05 * np.sqrt(np.mean(expected**2))


def test_a_pinhole_is_recognised_as_central(noisy_planes):
    choice, _ = choose_model(noisy_planes, sensor_mode=IMX219_1080P)
    assert choice.model == "central"
    assert choice.p_value is not None and choice.p_value > 1e-3
    assert choice.held
    # Noise of 0.02 px is 1.3 um at plane A and 2 um at plane B, in each of x and y.
    best = min(c.rms_um for c in choice.candidates)
    assert 2.0 < best < 3.2


def test_a_walking_pupil_is_recognised_and_its_rays_are_true_without_dots():
    planes = [
        (A_MM, see(A_MM, noise_px=0.02, seed=1, wander_mm=3.0)),
        (B_MM, see(B_MM, noise_px=0.02, seed=2, wander_mm=3.0)),
    ]
    choice, _ = choose_model(planes, sensor_mode=IMX219_1080P)
    assert choice.model == "walking-pupil"
    assert choice.p_value is not None and choice.p_value < 1e-3
    assert "do not meet in one point" in choice.reason
    fitted = calibrate_rays(planes, sensor_mode=IMX219_1080P, dot_diameter_mm=0.01)
    # Noise of 0.02 px is 2 um at plane B; half of the picture has no dots there.
    assert errors_um(fitted.model, B_MM, wander_mm=3.0).max() < 20.0
    central = fit_central_rays(planes, sensor_mode=IMX219_1080P, order=7)
    assert errors_um(central, B_MM, wander_mm=3.0).max() > 100.0


def test_rays_that_meet_nowhere_are_kept_as_two_planes():
    """The far board read 2 % too large and sheared: no pupil explains it, two free planes do."""
    a, b = see(A_MM, noise_px=0.02, seed=1), see(B_MM, noise_px=0.02, seed=2)
    bent = b.xy_mm + 2e-3 * np.stack([b.xy_mm[:, 1] ** 2 / 10, b.xy_mm[:, 0] * b.xy_mm[:, 1] / 10], axis=1)
    b = DotObservations(b.uv_px, bent, b.cov_px2, b.area_px2, b.column_row)
    choice, _ = choose_model([(A_MM, a), (B_MM, b)], sensor_mode=IMX219_1080P)
    assert choice.model == "two-plane"


def test_the_test_of_centrality_is_fair():
    """Under a true pinhole p is uniform: small values come as often as they say."""
    p = []
    for seed in range(30):
        planes = [
            (A_MM, see(A_MM, noise_px=0.1, seed=2 * seed)),
            (B_MM, see(B_MM, noise_px=0.1, seed=2 * seed + 1)),
        ]
        p.append(centrality_test(planes, 7, sensor_mode=IMX219_1080P)[1])
    # Of 30 uniform numbers the mean is 0.5 with a standard deviation of 0.053.
    assert 0.3 < np.mean(p) < 0.7
    assert min(p) > 1e-4


def test_the_paper_order_is_kept_when_two_planes_are_asked_for(noisy_planes):
    choice, _ = choose_model(noisy_planes, sensor_mode=IMX219_1080P, model="two-plane")
    assert (choice.model, choice.order) == ("two-plane", 5)
    assert len(choice.candidates) == 1
    asked, _ = choose_model(noisy_planes, sensor_mode=IMX219_1080P, model="central", order=6)
    assert (asked.model, asked.order) == ("central", 6)


def test_cross_validation_sees_an_order_that_is_too_low(noisy_planes):
    choice, _ = choose_model(noisy_planes, sensor_mode=IMX219_1080P, model="central", order="cross-validated")
    by_order = {c.order: c for c in choice.candidates}
    assert by_order[3].rms_um > 3 * by_order[9].rms_um
    assert by_order[3].max_um > by_order[3].rms_um
    assert choice.order in (7, 9)


def test_gross_errors_are_left_out_and_too_many_refused(noisy_planes):
    _, dots = noisy_planes[0]
    wrong = np.array([0, 17, 240, 300])
    uv = dots.uv_px.copy()
    uv[wrong] += [4.0, -3.0]  # 5 px: 0.3 mm
    spoilt = dots.moved_to(uv)
    out = gross_outliers(spoilt, sensor_mode=IMX219_1080P, what="plane A")
    np.testing.assert_array_equal(np.flatnonzero(out), wrong)
    assert not gross_outliers(dots, sensor_mode=IMX219_1080P, what="plane A").any()
    uv[::12] += [9.0, 0.0]
    with pytest.raises(CalibrationError, match="is the board flat"):
        gross_outliers(dots.moved_to(uv), sensor_mode=IMX219_1080P, what="plane A")


def area_centroids(dots, z_mm, diameter_mm):
    """Centroid and area of the image of each disc, from its outline."""
    ring = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    circle = diameter_mm / 2 * np.stack([np.cos(ring), np.sin(ring)], axis=-1)
    rim = dots.xy_mm[:, None] + circle
    a = pinhole_px(np.concatenate([rim, np.full((*rim.shape[:2], 1), z_mm)], axis=-1))
    middle = a.mean(axis=1, keepdims=True)
    a = a - middle
    b = np.roll(a, -1, axis=1)
    cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    centroid = ((a + b) * cross[..., None]).sum(axis=1) / (3 * cross.sum(axis=1))[:, None]
    return centroid + middle[:, 0], np.abs(cross.sum(axis=1)) / 2


def test_disc_bias_is_that_of_the_outlines(exact):
    dots = see(A_MM)
    centroid, area = area_centroids(dots, A_MM, 2.0)
    expected = centroid - dots.uv_px
    assert np.abs(expected).max() > 0.02  # the effect exists
    got = disc_bias_px(exact["central"], dots.xy_mm, z_mm=A_MM, diameter_mm=2.0)
    # The outlines have 720 corners (1e-5 px); the fit's second derivatives err by a few per cent at the rim.
    np.testing.assert_allclose(got, expected, atol=2e-3)
    assert np.sqrt(np.mean((got - expected) ** 2)) < 2e-4
    assert disc_diameter_mm(exact["central"], centroid, area, z_mm=A_MM) == pytest.approx(2.0, abs=1e-3)


def test_calibration_takes_the_bias_of_large_dots_away():
    planes = []
    for z_mm in (A_MM, B_MM):
        dots = see(z_mm)
        centroid, area = area_centroids(dots, z_mm, 3.2)
        planes.append((z_mm, DotObservations(centroid, dots.xy_mm, dots.cov_px2, area, dots.column_row)))
    fitted = calibrate_rays(planes, sensor_mode=IMX219_1080P, model="central", order=9)
    assert fitted.dot_diameter_mm == pytest.approx(3.2, abs=0.01)
    assert errors_um(fitted.model, A_MM).max() < 1.5
    believed = fit_central_rays(planes, sensor_mode=IMX219_1080P, order=9)
    assert errors_um(believed, A_MM).max() > 3.0  # the centroids as they are
