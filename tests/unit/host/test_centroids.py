import numpy as np
import pytest
from led_scenes import draw_disc, luma_of_light

from bricktrack_host.tracking.pictures.centroids import light_levels, measure_spot
from bricktrack_host.tracking.pictures.light_kernel import FLOOR_SD_PX

# Codes are whole numbers and Rec. 709's curve is steep: over a rim of 200 pixels that leaves some 0.003 px.
QUANTISED_PX = 0.01


def window(**disc):
    light = np.full((120, 120), disc.pop("background", 0.01))
    light[:, 70:] = disc.pop("background_right", light[0, 0])
    draw_disc(light, disc.pop("centre"), disc.pop("radii", (30.0, 30.0)), **disc)
    return light


@pytest.mark.parametrize("level", [0.9, 0.4, 0.1])
def test_the_centroid_does_not_depend_on_exposure(level):
    light = window(centre=(58.3, 61.7), level=level, background=0.01 * level)
    spot = measure_spot(luma_of_light(light), origin_px=(100, 200))
    np.testing.assert_allclose(spot.uv_px, [158.3, 261.7], atol=QUANTISED_PX)
    assert spot.area_px2 == pytest.approx(np.pi * 30**2, rel=2e-3)
    assert spot.eccentricity < 0.05
    assert spot.fill == pytest.approx(1.0, abs=3e-3)


def test_a_wall_brighter_on_one_side_does_not_pull():
    spot = measure_spot(
        luma_of_light(window(centre=(60.2, 59.6), level=0.8, background_right=0.08)), origin_px=(0, 0)
    )
    # A plain grey-weighted mean of this window lies 3 px off. Here the rim against the brighter wall keeps up
    # to a tenth of the wall's light: 0.08 of 0.8.
    np.testing.assert_allclose(spot.uv_px, [60.2, 59.6], atol=0.06)


def test_motion_blur_leaves_the_centroid_at_mid_exposure():
    light = window(centre=(60.4, 57.1), level=0.8, smear=(24.0, 10.0), radii=(25.0, 25.0))
    spot = measure_spot(luma_of_light(light), origin_px=(0, 0))
    np.testing.assert_allclose(spot.uv_px, [60.4, 57.1], atol=2 * QUANTISED_PX)


def test_a_saturated_light_is_measured_by_its_rim():
    light = np.minimum(window(centre=(60.4, 57.1), level=3.0), 1.0)
    spot = measure_spot(luma_of_light(light), origin_px=(0, 0))
    np.testing.assert_allclose(spot.uv_px, [60.4, 57.1], atol=2 * QUANTISED_PX)


def test_a_dim_led_is_not_lost_beside_a_brighter_glint():
    light = window(centre=(60.4, 57.1), level=0.35, background=0.04)
    draw_disc(light, (108.0, 80.0), (5.0, 5.0), level=1.0)
    spot = measure_spot(luma_of_light(light), origin_px=(0, 0))
    np.testing.assert_allclose(spot.uv_px, [60.4, 57.1], atol=2 * QUANTISED_PX)
    assert spot.area_px2 == pytest.approx(np.pi * 30**2, rel=5e-3)


def test_the_covariance_is_no_smaller_than_the_scatter_under_noise():
    rng = np.random.default_rng(3)
    codes = luma_of_light(window(centre=(60.4, 57.1), level=0.8)).astype(float)
    spots = [
        measure_spot(
            np.clip(np.rint(codes + rng.normal(0, 2.0, codes.shape)), 0, 255).astype(np.uint8),
            origin_px=(0, 0),
        )
        for _ in range(60)
    ]
    scatter = np.cov(np.array([s.uv_px for s in spots]).T)
    claimed = np.mean([s.cov_px2 for s in spots], axis=0)
    noise_part = claimed - FLOOR_SD_PX**2 * np.eye(2)
    assert np.linalg.eigvalsh(claimed - scatter).min() > 0
    # Without the floor the propagated noise is of the right size: sixty samples know it to a third or so.
    np.testing.assert_array_less(np.diag(scatter), 3 * np.diag(noise_part))


def test_the_light_nearest_to_the_expected_place_is_taken():
    light = np.full((120, 200), 0.01)
    draw_disc(light, (50, 60), (20, 20), level=0.8)
    draw_disc(light, (140, 60), (20, 20), level=0.8)
    for near, expected in (((55.0, 60.0), 50), ((120.0, 60.0), 140)):
        spot = measure_spot(luma_of_light(light), origin_px=(0, 0), near_px=near)
        assert spot.uv_px[0] == pytest.approx(expected, abs=QUANTISED_PX)


def test_a_light_that_goes_on_beyond_the_window_says_so():
    light = np.full((60, 60), 0.01)
    full = np.full((120, 120), 0.01)
    draw_disc(full, (60, 60), (30, 30), level=0.8)
    light[:] = full[:60, 30:90]
    assert measure_spot(luma_of_light(light), origin_px=(0, 0)).touches_window


@pytest.mark.parametrize("level", [0.0, 0.005])
def test_a_window_without_light_gives_nothing(level):
    light = np.full((40, 40), 0.05)
    light[10:20, 10:20] += level
    assert light_levels(luma_of_light(light)) is None
    assert measure_spot(luma_of_light(light), origin_px=(0, 0)) is None


def test_a_crescent_has_a_fill_below_one():
    light = window(centre=(60, 60), level=0.8)
    draw_disc(light, (70, 60), (26, 26), level=0.01)
    assert measure_spot(luma_of_light(light), origin_px=(0, 0)).fill < 0.9
