import numpy as np
import pytest
from led_scenes import random_poses, seven_leds
from pinhole import PinholeCamera
from scipy.stats import multivariate_normal

from bricktrack_host.tracking.identity.evidence import Given, Shown, evidence_of, log_area_ratio
from bricktrack_host.tracking.led_model.led_profile import predict_brick

N_PIXELS = 1920 * 1080
COLLAR = 0.7
BRICK = seven_leds(collar_mm=COLLAR)
POSE = random_poses(1, seed=3, tilt_deg=15.0)
SEEN, J = predict_brick(*POSE, PinholeCamera(), BRICK, collar_mm=COLLAR)
TWIST_SD = np.repeat([1.0, 300.0], 3)
WITHOUT_THE_LAST = np.arange(7) < 6


def evidence(
    off_px, *, kept=None, area=1.0, sd_px=0.06, whole=True, n_lights=7, guesses=1, dt_s=0.0, tilt=None,
    J_tilt=None,
):  # fmt: skip
    """Of one assignment, whose lights are off from where a pose shows the LEDs."""
    given = Given(
        uv_px=SEEN.uv_px + np.asarray(off_px, dtype=float),
        cov_px2=np.broadcast_to(sd_px**2 * np.eye(2), (1, 7, 2, 2)),
        area_px2=SEEN.area_px2 * area,
        is_whole=np.broadcast_to(np.asarray(whole), (1, 7)),
        dt_s=np.broadcast_to(np.asarray(dt_s, dtype=float), (1, 7)),
        twist_sd=TWIST_SD[None],
        n_lights=np.array([n_lights]),
    )
    tilt = np.zeros(3) if tilt is None else np.asarray(tilt)
    J_tilt = np.zeros((3, 3)) if J_tilt is None else J_tilt
    shown = Shown(SEEN.uv_px, SEEN.area_px2, SEEN.facing, J, SEEN.model_shift_px, tilt[None], J_tilt[None])
    kept = np.ones((1, 7), dtype=bool) if kept is None else np.asarray(kept)[None]
    return evidence_of(
        given, [shown] * guesses, kept, POSE[1][:, 2], n_pixels=N_PIXELS, min_leds=4, axes_length=0.5
    )


def noise(sd_px, seed=1):
    return np.random.default_rng(seed).normal(0, sd_px, (7, 2))


def test_an_led_more_that_fits_is_evidence_by_what_lights_anywhere_would_need():
    r = noise(0.06)
    gain = evidence(r).log_ratio - evidence(r, kept=WITHOUT_THE_LAST).log_ratio
    # Half a pixel about where the others show it, in two million; nine to one that it is not hidden; the area.
    assert np.log(N_PIXELS / (2 * np.pi * 0.5**2)) < gain[0] < np.log(N_PIXELS / (2 * np.pi * 0.05**2)) + 5


def test_places_at_rest_have_the_density_of_normal_lights_over_all_poses():
    """All that is unknown as one covariance of all lights' places: the density by another way."""
    r = noise(0.06)
    rows = J[0].reshape(14, 6)
    profile = SEEN.model_shift_px[0].reshape(14, 1)
    own = np.repeat(0.25 * (SEEN.model_shift_px[0] ** 2).sum(axis=1), 2)
    radius2 = np.repeat(SEEN.area_px2[0] / np.pi, 2)
    wide = np.repeat([np.sqrt(10.0), 50.0], 3)  # rad, mm: flat, but for its known height
    log_p = []
    for share, radii in ((0.8, 0.0), (0.15, 0.01), (0.05, 0.04)):
        S = (
            np.diag(0.06**2 + 0.05**2 + own + radii**2 * radius2)
            + (rows * wide**2) @ rows.T
            + profile @ profile.T
        )
        log_p.append(np.log(share) + multivariate_normal(np.zeros(14), S).logpdf(r.ravel()))
    flat = np.logaddexp.reduce(log_p) + 3 * np.log(2 * np.pi) + np.log(wide).sum()
    # Seven LEDs shown, none hidden, no false light; bricks wherever a camera sees them.
    m2 = np.abs(np.linalg.det(J[0, :, :, 3:5])).mean()
    z = POSE[1][0, 2]
    # Over the sphere, a weight of exp(4 (cos - 1)) of how the LEDs face: 2 pi (1 - exp(-8)) / 4; any roll.
    n_poses = 2 * np.pi * (2 * np.pi * (1 - np.exp(-8.0)) / 4) * 2.6 * N_PIXELS * z / m2
    # Areas as predicted, of one scatter in all LEDs; other lights' logarithms are anywhere in ln 81.
    by_scatter = 0.95 * np.log(81.0) / (np.sqrt(2 * np.pi) * np.array([0.03, 0.1, 0.2])) + 0.05
    areas = np.log(np.mean(by_scatter**7))
    others = 7 * np.log(0.8 * 1.2 * N_PIXELS) - np.log(5040) + areas - np.log(n_poses)
    # Motion that shows nothing, at dt = 0, changes nothing; det(AB) of a wide Gauss: to a part in 10^4 or so.
    assert evidence(r).log_ratio[0] == pytest.approx(flat + others, abs=0.02)


def test_one_false_light_among_six_that_fit_is_worse_than_none():
    r = noise(0.06)
    r[6] = [5.0, -4.0]
    assert evidence(r, kept=WITHOUT_THE_LAST).log_ratio > evidence(r).log_ratio
    assert evidence(r).is_scattered.all() and not evidence(r, kept=WITHOUT_THE_LAST).is_scattered.any()


def test_a_moving_brick_keeps_its_leds_and_a_false_light_is_not_taken_for_motion():
    dt_s = (SEEN.uv_px[0, :, 1] - 540) * 19e-6
    motion_px = np.einsum("lij,j->li", J[0, :, :, 3:], [200.0, 0.0, 0.0]) * dt_s[:, None]
    r = motion_px + noise(0.06)
    assert np.linalg.norm(r, axis=1).max() > 5
    all_seven, six = evidence(r, dt_s=dt_s), evidence(r, kept=WITHOUT_THE_LAST, dt_s=dt_s)
    assert all_seven.is_scattered.all()
    assert all_seven.log_ratio > six.log_ratio + 5
    moved = r.copy()
    moved[6] += [12.0, -9.0]  # no speed shows the LED there
    assert evidence(moved, dt_s=dt_s).log_ratio < six.log_ratio


def test_a_light_of_another_size_is_less_like_an_led_and_a_common_factor_is_not():
    r = noise(0.06)
    area = np.ones(7)
    # But for what exposures leave: a quarter, one standard deviation.
    assert evidence(r, area=np.exp(0.25)).log_ratio == pytest.approx(evidence(r).log_ratio - 0.5, abs=1e-9)
    area[3] *= 3
    assert evidence(r, area=area).log_ratio < evidence(r).log_ratio - 3
    whole = np.arange(7) != 3  # a cut light's size says nothing
    np.testing.assert_allclose(
        evidence(r, area=area, whole=whole).log_ratio, evidence(r, whole=whole).log_ratio, atol=1e-9
    )


def test_more_false_lights_make_each_led_less_sure():
    r = noise(0.06)
    # Of five false lights, rather than none, one is where the LED is six times as likely.
    gain = [
        evidence(r, n_lights=n).log_ratio - evidence(r, n_lights=n, kept=WITHOUT_THE_LAST).log_ratio
        for n in (7, 12)
    ]
    np.testing.assert_allclose(gain[0] - gain[1], np.log(6.0), atol=1e-9)


def test_too_few_leds_and_no_pose_are_no_evidence():
    assert evidence(noise(0.06), kept=np.arange(7) < 3).log_ratio == -np.inf
    assert evidence(np.full((7, 2), np.nan)).log_ratio == -np.inf


def test_without_a_fitted_profile_small_residuals_speak_less():
    fits = noise(0.06)
    assert evidence(fits).log_ratio > evidence(fits, guesses=2).log_ratio


def test_a_brick_turned_away_is_less_likely_by_how_its_leds_face():
    r, chord = noise(0.06), 2 * np.sin(0.5 * np.radians(60.0))
    loss = evidence(r).log_ratio - evidence(r, tilt=[chord, 0.0, 0.0]).log_ratio
    # Of eight from all facing to none facing, axes whose mean is a half have four; at 60 degrees half of that.
    np.testing.assert_allclose(loss, 2.0, atol=1e-9)


def test_what_is_seen_and_how_it_is_turned_may_be_told_from_any_pose_nearby():
    r, turn = noise(0.06), np.array([0.05, -0.04, 0.03])
    tilt, J_tilt = np.array([0.4, -0.2, 0.0]), 0.9 * np.eye(3)
    from_there = evidence(r + J[0, :, :, :3] @ turn, tilt=tilt, J_tilt=J_tilt)
    from_here = evidence(r, tilt=tilt + J_tilt @ turn, J_tilt=J_tilt)
    # But for the width of the prior about either: 0.05 times the squared turn from the pose that is likeliest.
    np.testing.assert_allclose(from_there.log_ratio, from_here.log_ratio, atol=1e-3)


def test_the_area_of_one_led_tells_as_much_as_those_of_a_picture_of_one():
    off = np.array([0.0, 0.1, 1.0])
    own = np.mean(
        [np.exp(-0.5 * (off / sd) ** 2) / (np.sqrt(2 * np.pi) * sd) for sd in (0.03, 0.1, 0.2)], axis=0
    )
    np.testing.assert_allclose(log_area_ratio(off), np.log(0.95 * own * np.log(81.0) + 0.05))
    assert np.isnan(log_area_ratio(np.array([np.nan])))  # and no warning of it
