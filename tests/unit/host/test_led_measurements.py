"""What LEDs say one by one: how far each lies from the others, by hand-made residuals."""

from types import SimpleNamespace

import numpy as np
import pytest

from bricktrack_host.fusion.led_by_led.led_measurements import _leaning_px, led_chi2


def chi2_of(cov_px2, of_state_px2, *, use=True):
    leds = SimpleNamespace(cov_px2=cov_px2[None], inflation=np.ones(1), use=np.array([use]))
    found = SimpleNamespace(led_residual_px=np.array([[0.3, -0.1]]), led_cov_px2=of_state_px2[None])
    return led_chi2(SimpleNamespace(leds=leds), found)[0]


def test_an_led_that_was_not_used_is_judged_by_its_own_noise_and_the_states():
    # S = diag(0.02, 0.05) + diag(0.01, 0.05): 0.09 / 0.03 + 0.01 / 0.1
    far = chi2_of(np.diag([0.02, 0.05]), np.diag([0.01, 0.05]), use=False)
    assert far == pytest.approx(3.1, rel=1e-12)


def test_an_led_that_says_nothing_new_is_judged_as_if_it_had_not_been_used():
    # The smoothed state already has its share: taken out again, one LED of 0.02 px^2 beside a prior of 0.02 leaves
    # half the residual and 0.01 px^2. Its innovation is then twice as far, of 0.04 px^2. What keeps the division off
    # zero takes 4 % of the residual.
    far = chi2_of(0.02 * np.eye(2), 0.01 * np.eye(2))
    assert far == pytest.approx((0.6**2 + 0.2**2) / 0.04, rel=0.08)


@pytest.mark.parametrize(
    "of_state_px2", [np.diag([0.03, 0.01]), np.array([[0.01, 0.018], [0.018, 0.01]]), np.diag([np.nan, 0.01])]
)
def test_a_state_less_sure_than_the_led_that_it_was_made_from_says_nothing(of_state_px2):
    assert np.isnan(chi2_of(0.02 * np.eye(2), of_state_px2))


def leaning(smear_px, axis_px):
    """Return what `_leaning_px` gives for one LED of 20 px, ``axis_px`` being one radius along its axis."""
    seen = SimpleNamespace(model_shift_px=np.array([axis_px]), area_px2=np.array([np.pi * 20.0**2]))
    return _leaning_px(seen, np.array([smear_px]))[0]


def test_a_smear_draws_a_leaning_light_as_the_integral_over_its_rim():
    phi = (np.arange(720) + 0.5) * np.pi / 360
    normal = np.stack([np.cos(phi), np.sin(phi)], axis=1)
    smear, axis = np.array([3.0, 7.0]), np.array([12.0, -4.0])
    rim = np.abs(normal @ smear) * (normal @ axis / 20.0)
    mean = (rim[:, None] * normal).sum(axis=0) * np.pi / 360
    assert leaning(smear, axis) == pytest.approx(mean * 3 / 4, rel=1e-4)
    assert leaning(-smear, axis) == pytest.approx(leaning(smear, axis))  # to and fro alike


def smeared_disc_px(length, direction):
    """Return the centroid of a disc of 20 px, brighter towards +x and overexposed, smeared by ``length`` px.

    Each pixel counts by how far it is from 0.15 to 0.85 of full light, as in `light_kernel`.
    """
    grid = np.arange(-40.0, 40.5, 0.5)
    x, y = np.meshgrid(grid, grid)
    light = np.zeros_like(x)
    ways = (np.arange(64) + 0.5) / 64 - 0.5
    for way in ways * length:
        u, v = x - way * direction[0], y - way * direction[1]
        light += np.where(u * u + v * v < 20.0**2, 1.6 * (1 + 0.2 * u / 20.0), 0.0) / 64
    weight = np.clip((np.minimum(light, 1.0) - 0.15) / 0.7, 0.0, 1.0)
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


def test_an_uneven_disc_that_is_smeared_lies_aside_as_is_modelled():
    # Brightness falls along x, so the axis of the model is x; one share fits smears of both sizes and directions.
    drawn = [smeared_disc_px(L, d)[0] for L, d in ((4, (1, 0)), (8, (1, 0)), (8, (0, 1)))]
    still = smeared_disc_px(0, (1, 0))[0]
    modelled = [leaning(L * np.array(d, dtype=float), np.array([20.0, 0.0]))[0]
                for L, d in ((4, (1, 0)), (8, (1, 0)), (8, (0, 1)))]  # fmt: skip
    share = (np.array(drawn) - still) / modelled
    assert share.min() > 0.005
    # Pixels of half a px make some hundredths.
    assert share == pytest.approx(np.full(3, share.mean()), rel=0.1)
