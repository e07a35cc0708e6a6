import numpy as np

from bricktrack_host.tracking.identity.evidence import evidence_of

N_PIXELS = 1920 * 1080
AREA = 3000.0


def evidence(residual, *, kept=None, area=AREA, sd_px=0.06, whole=True, shift_sd=0.005):
    """Of one assignment of seven LEDs that face the camera squarely."""
    residual = np.asarray(residual, dtype=float)[None]
    kept = np.ones((1, 7), dtype=bool) if kept is None else np.asarray(kept)[None]
    return evidence_of(
        residual,
        np.broadcast_to(sd_px**2 * np.eye(2), (1, 7, 2, 2)),
        np.broadcast_to(np.asarray(whole), (1, 7)),
        kept,
        np.broadcast_to(np.asarray(area, dtype=float), (1, 7)),
        np.full((1, 7), AREA),
        np.ones((1, 7)),
        shift_sd_per_radius=shift_sd,
        n_pixels=N_PIXELS,
        min_leds=4,
    )


def noise(sd_px, seed=1):
    return np.random.default_rng(seed).normal(0, sd_px, (7, 2))


def test_an_led_more_that_fits_is_evidence_by_what_lights_anywhere_would_need():
    r = noise(0.06)
    six = np.arange(7) < 6
    gain = evidence(r).log_ratio - evidence(r, kept=six).log_ratio
    # A light within a few hundredths of a pixel of its place, in two million: log of 2e6 / (2 pi 0.08^2), about.
    assert 14 < gain[0] < 21


def test_one_false_light_among_six_that_fit_is_worse_than_none():
    r = noise(0.06)
    r[6] = [5.0, -4.0]
    six = np.arange(7) < 6
    assert evidence(r, kept=six).log_ratio > evidence(r).log_ratio
    assert evidence(r).is_scattered.all() and not evidence(r, kept=six).is_scattered.any()


def test_a_moving_brick_keeps_its_leds_though_all_residuals_are_large():
    r = noise(2.0)
    six = np.arange(7) < 6
    assert evidence(r).log_ratio > evidence(r, kept=six).log_ratio + 5


def test_a_light_of_another_size_is_less_like_an_led_and_a_common_factor_is_not():
    r = noise(0.06)
    area = np.full(7, AREA)
    brighter = evidence(r, area=1.3 * area).log_ratio
    np.testing.assert_allclose(brighter, evidence(r, area=area).log_ratio, atol=1e-9)
    area[3] *= 3
    assert evidence(r, area=area).log_ratio < evidence(r).log_ratio - 3
    whole = np.arange(7) != 3  # a cut light's size says nothing
    assert evidence(r, area=area, whole=whole).log_ratio > evidence(r, area=area).log_ratio - 3


def test_too_few_leds_and_no_pose_are_no_evidence():
    assert evidence(noise(0.06), kept=np.arange(7) < 3).log_ratio == -np.inf
    assert evidence(np.full((7, 2), np.nan)).log_ratio == -np.inf


def test_without_a_fitted_profile_small_residuals_speak_less_and_large_ones_more():
    fits, scatters = noise(0.06), noise(1.5)
    assert evidence(fits).log_ratio > evidence(fits, shift_sd=None).log_ratio
    assert evidence(scatters, shift_sd=None).log_ratio > evidence(scatters).log_ratio
