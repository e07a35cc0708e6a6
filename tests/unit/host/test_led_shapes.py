import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bricktrack_host.tracking.led_shapes import doubt_by_shape
from bricktrack_host.tracking.pictures.light_kernel import FLOOR_SD_PX

N, N_LEDS, RADIUS_PX = 120, 7, 37.0


def light(edge=None, towards_rad=0.0, grow=None):
    """Area, centroid and second moments of a disc of radius 1 that ends at an edge, or that another adds to."""
    y, x = np.mgrid[-1.5:1.5:401j, -1.5:1.5:401j]
    lit = x**2 + y**2 < 1
    along = x * np.cos(towards_rad) + y * np.sin(towards_rad)
    if edge is not None:
        lit &= along < edge
    if grow is not None:  # the rim of a lamp as wide as an eighth of the LED
        across = y * np.cos(towards_rad) - x * np.sin(towards_rad)
        lit |= (along > 0) & (along < 1 + grow) & (np.abs(across) < 0.25) & (along**2 + across**2 > 0.9)
    points = np.stack([x[lit], y[lit]])
    return lit.sum() * (3 / 400) ** 2, points.mean(axis=1), np.cov(points)


def covariance_px2(moments):
    """What the segmentation states of a light: its moments by a factor of its noise, and the floor."""
    return 1.3e-4 * moments + FLOOR_SD_PX**2 * np.eye(2)


def poses(n=N, seed=3):
    """A brick that wanders by some 8 mm and 6 degrees, as a cubic through ten places."""
    knots = np.random.default_rng(seed).normal(0, 1, (10, 6)) * [0.05, 0.05, 0.05, 4, 4, 6]
    x = np.stack([np.interp(np.linspace(0, 9, n), np.arange(10), k) for k in knots.T], axis=1)
    x = np.stack(
        [np.convolve(np.pad(c, 8, mode="edge"), np.ones(17) / 17, mode="valid") for c in x.T], axis=1
    )
    return Rotation.from_rotvec(x[:, :3]).as_matrix(), x[:, 3:] + [-26, -24, 130]


def seen_from(R, t, *, noise=4e-4, seed=5):
    """Areas and moments that change smoothly with the view, each LED's in its own way, and scatter."""
    rng = np.random.default_rng(seed)
    view = np.hstack([Rotation.from_matrix(R).as_rotvec() / 0.1, (t - t.mean(axis=0)) / 10])
    log_area = 0.01 * view @ rng.normal(0, 1, (6, N_LEDS)) + rng.normal(0, noise, (len(R), N_LEDS))
    turned = 0.05 * view @ rng.normal(0, 1, (6, 2 * N_LEDS))
    stretch = turned.reshape(-1, N_LEDS, 2) + rng.normal(0, noise, (len(R), N_LEDS, 2))
    moments = 0.25 * np.eye(2) + 0.25 * (
        stretch[..., :1, None] * np.diag([1.0, -1.0]) + stretch[..., 1:, None] * np.eye(2)[::-1]
    )
    return log_area, covariance_px2(moments)


USABLE = np.ones((N, N_LEDS), dtype=bool)


def disturbed(log_area, cov, i, k, what):
    """Give a light of a frame the shape of a disturbed disc on top of its own; return how far it moves, radii."""
    area, middle, moments = what
    whole = light()
    log_area[i, k] += np.log(area / whole[0])
    cov[i, k] += covariance_px2(moments) - covariance_px2(whole[2])
    return float(np.linalg.norm(middle - whole[1]))


def test_what_the_view_changes_and_noise_raise_hardly_a_doubt():
    log_area, cov = seen_from(*poses())
    doubt = doubt_by_shape(log_area, cov, USABLE, *poses())
    # Three sigmas of one number and of the length of two: 0.3 and 1.1 % of lights.
    assert (doubt > 0).mean() < 0.03


@pytest.mark.parametrize("towards_deg", [0, 40, 90, 200, 315])
@pytest.mark.parametrize("what", [{"edge": 0.97}, {"edge": 0.9}, {"grow": 0.02}, {"grow": 0.1}])
def test_a_light_that_begins_to_be_cut_or_joined_is_doubted_by_what_it_moved(what, towards_deg):
    log_area, cov = seen_from(*poses())
    moved = disturbed(log_area, cov, 60, 4, light(towards_rad=np.radians(towards_deg), **what))
    doubt = doubt_by_shape(log_area, cov, USABLE, *poses())
    # The rim's share is not all at one place, which the area and the moments feel differently.
    assert 0.6 * moved < doubt[60, 4] < 1.6 * moved
    assert (np.delete(doubt[60], 4) > 0).sum() <= 1


def test_a_card_that_stays_for_half_a_second_does_not_become_the_usual():
    run = poses(450)
    log_area, cov = seen_from(*run)
    what = light(edge=0.9)
    moved = [disturbed(log_area, cov, i, 2, what) for i in range(200, 214)]
    doubt = doubt_by_shape(log_area, cov, np.ones((450, N_LEDS), dtype=bool), *run)
    assert doubt[200:214, 2].min() > 0.5 * moved[0]


def test_lights_that_all_change_as_by_blur_are_not_doubted():
    log_area, cov = seen_from(*poses())
    smear = 0.25 * np.diag([0.02, -0.02]) * np.random.default_rng(2).uniform(0.6, 1.4, (N_LEDS, 1, 1))
    cov[60] += 1.3e-4 * smear
    doubt = doubt_by_shape(log_area, cov, USABLE, *poses())
    assert not doubt[60].any()


def test_unknown_lights_are_not_doubted_and_spoil_nothing():
    log_area, cov = seen_from(*poses())
    usable = USABLE.copy()
    usable[30:60, 1], usable[:, 3], usable[70] = False, False, False
    log_area[~usable], cov[~usable] = np.nan, np.nan
    moved = disturbed(log_area, cov, 40, 5, light(edge=0.93))
    doubt = doubt_by_shape(log_area, cov, usable, *poses())
    assert np.isfinite(doubt).all()
    assert not doubt[~usable].any()
    assert doubt[40, 5] > 0.6 * moved
    assert not doubt_by_shape(log_area, cov, np.zeros_like(usable), *poses()).any()


def test_runs_of_one_frame_or_a_few_have_no_usual():
    for n in (1, 3, 30):
        R, t = poses()
        log_area, cov = seen_from(R[:n], t[:n])
        disturbed(log_area, cov, n // 2, 4, light(edge=0.9))
        assert not doubt_by_shape(log_area, cov, USABLE[:n], R[:n], t[:n]).any()
