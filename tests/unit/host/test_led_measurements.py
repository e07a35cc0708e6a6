"""What LEDs say one by one: how far each lies from the others, by hand-made residuals."""

from types import SimpleNamespace

import numpy as np
import pytest

from bricktrack_host.fusion.led_by_led.led_measurements import led_chi2


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
