"""Errors that stand still over a run seen LED by LED, against simulated runs of a unit."""

from dataclasses import replace

import numpy as np
import pytest
from daemon_runs import simulate_run

from bricktrack_common.brick_model import ProfileEntry
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix
from bricktrack_host.fusion.estimate import FusionInput, prepare_run
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.led_by_led import led_smoothing, standing_errors
from bricktrack_host.fusion.led_by_led.led_measurements import SeenLeds
from bricktrack_host.fusion.led_by_led.led_smoothing import LedSmoother
from bricktrack_host.fusion.led_by_led.shared_with_rest import shared_with_rest
from bricktrack_host.fusion.led_by_led.standing_errors import StandingPrior, StandingWay, _likeliest
from bricktrack_host.fusion.pose_by_pose.fused_output import sample_poses
from bricktrack_host.fusion.pose_by_pose.pose_level import smooth_poses
from bricktrack_host.fusion.smoothing.smoother import POS, Filter
from bricktrack_host.tracking.led_model.led_profile import collar_of, predict_brick
from bricktrack_host.tracking.optical_track import led_times_ns, solve_poses

SETTINGS = FusionSettings()
PROFILE, SPREAD, SMEAR, FIRST_LED, BY_VIEW = 21, 23, 24, 30, 44


def smoothed(run):
    optical = solve_poses(run.observations, run.camera, run.brick)
    item = FusionInput(optical, run.imu, run.lever_arm_mm, optical.t_ns[5:-5])
    first = smooth_poses([prepare_run(item, SETTINGS)], SETTINGS)[0]
    leds = SeenLeds.of(run.observations, run.camera)
    arm_m = run.lever_arm_mm * 1e-3
    return LedSmoother(leds, first, run.camera, run.brick, lever_arm_m=arm_m, settings=SETTINGS).smooth()


def plain_run():
    """Return a simulated run without standing errors."""
    run = simulate_run(31, duration_s=4.0)
    return replace(run, brick=replace(run.brick, led_profile=ProfileEntry(collar_mm=0.7, source="simulated")))


def origin_m(states):
    """Return where the brick's origin is at the nodes, shape (K, 3)."""
    return states.estimate.state.x[:, 0, POS] - states.estimate.state.R[:, 0] @ states.run.lever_arm_m


@pytest.fixture(scope="module")
def plain():
    """Return a run without standing errors, and its last pass, with what it was made of."""
    passes = []
    whole = LedSmoother._pass

    def keep(*args):
        passes.append(whole(*args))
        return passes[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LedSmoother, "_pass", keep)
        done = smoothed(plain_run())
    return done, passes[-1]


def test_a_run_without_standing_errors_shows_none(plain):
    done, _ = plain
    z = done.errors.value / np.sqrt(np.diagonal(done.errors.covariance))
    assert np.abs(z[PROFILE:]).max() < 3.5  # 20 of them, about one in 2000 each
    assert done.errors.offset_sd_px < 0.02  # noise of 0.05 px in 120 frames says little below 0.005


def test_the_leds_noise_is_found_where_pictures_move_and_where_they_stand(plain):
    # Simulated white noise of 0.05 px, as stated, at rest as well.
    assert plain[0].noise_scales == pytest.approx([1, 1], abs=0.12)


def test_the_derivative_of_the_smoothed_motion_is_that_of_the_filter(plain):
    # An LED seen 0.1 px off all the time. With noise three times what it is nothing surprises the filter, which
    # would believe it less.
    done, last = plain
    now, leds = last.states, done.leds
    arrays = now.problem.leds._replace(cov_px2=9 * now.problem.leds.cov_px2)
    problem = replace(now.problem, leds=arrays)
    passed = Filter(problem)
    before = passed.smooth()
    way = StandingWay(problem, passed, leds, last.pictured, 7, n_views=done.errors.n_views)
    sure = np.zeros_like(done.errors.covariance)
    sure[FIRST_LED + 6, FIRST_LED + 6] = 1.0  # u of the fourth LED, px
    doubt = way.doubt(replace(done.errors, covariance=sure), before.of)
    more = doubt.added_to(before, 0).covariance[:, 0]
    found = np.sqrt(np.diagonal(more - before.covariance[:, 0], axis1=1, axis2=2)[:, 3:6])
    off_px = np.where(leds.led == 3, 0.1, 0.0)[:, None] * [1, 0]
    moved = replace(problem, leds=arrays._replace(residual_px=arrays.residual_px + off_px))
    shift_m = np.abs(Filter(moved).smooth().state.x - before.state.x)[:, 0, POS]
    # Of the largest; each LED moves the state at which the next is linearised.
    assert np.abs(found - shift_m / 0.1).max() < 0.04 * found.max()
    assert found.max() > 1e-6


def test_states_share_with_the_rest_what_each_error_moves_there(plain):
    # Against poses at rest of states that are moved by one error after the other.
    s = plain[0].states
    n_nodes, estimate = len(s.nodes.t_s), s.estimate
    moved = np.empty((n_nodes, 8, len(s.doubt.root)), dtype=np.float32)
    for nodes, by_errors in s.doubt.stretches(estimate.state, 0):
        moved[nodes] = by_errors
    at_rest_ns = plain[0].leds.t_ns.min() + np.arange(0, 500_000_000, 5_000_000)
    R, t_mm = sample_poses(s.run, s.nodes, estimate.state, 0, at_rest_ns)
    expected, variance = np.zeros((n_nodes, 8, 6)), np.zeros(6)
    for by_error in np.moveaxis(moved.astype(np.float64), 2, 0):
        x = estimate.state.x.copy()
        x[:, 0, POS] += by_error[:, 3:6]
        turned = replace(estimate.state, R=estimate.state.R @ matrix_from_rvec(by_error[:, None, :3]), x=x)
        R_now, t_now_mm = sample_poses(s.run, s.nodes, turned, 0, at_rest_ns)
        turn = rvec_from_matrix(np.swapaxes(R, 1, 2) @ R_now)
        rest = np.concatenate([turn, t_now_mm - t_mm], axis=1).mean(axis=0)
        expected += by_error[:, :, None] * rest
        variance += rest**2
    found = shared_with_rest(s, moved, at_rest_ns[[0, -1]])
    sd = np.sqrt(np.square(moved.astype(np.float64)).sum(axis=2))
    # 0.9 is believed to be alike. As correlations: means over other instants of the same half second.
    off = (found / 0.9 - expected) / (sd[:, :, None] * np.sqrt(variance))
    assert np.abs(off).max() < 0.01
    assert shared_with_rest(s, moved, at_rest_ns[[0, -1]] - 10**12) is None


def test_what_acceleration_draws_centroids_by_is_not_told_but_makes_all_unsure(plain, monkeypatch):
    # Centroids drawn by a tenth less than they are predicted: what that does to the errors estimated.
    done, last = plain
    problem, pictured, leds = last.states.problem, last.pictured, done.leds
    n_views = done.errors.n_views

    def errors(drawn, spread_sd):
        monkeypatch.setattr(standing_errors, "_SPREAD_SD", spread_sd)
        seen = problem.leds.residual_px - drawn * pictured.accelerated_px
        moved = replace(problem, leds=problem.leds._replace(residual_px=seen))
        way = StandingWay(moved, Filter(moved), leds, pictured, 7, n_views=n_views)
        prior = StandingPrior.of(leds, pictured, 7, SETTINGS, n_views=n_views, camera_moves=False)
        return way.estimate(prior, np.zeros_like(done.errors.value))

    sure, unsure, shifted = errors(0.0, 0.0), errors(0.0, 0.4), errors(0.1, 0.0)
    assert sure.value[SPREAD] == sure.covariance[SPREAD, SPREAD] == shifted.value[SPREAD] == 0.0
    np.testing.assert_array_equal(unsure.value, sure.value)
    wrong = (shifted.value - sure.value) / -0.1  # estimate less truth, where they are drawn by as much again
    wrong[SPREAD] = -1.0
    more = unsure.covariance - sure.covariance
    scale = np.sqrt(np.diagonal(unsure.covariance)) + 1e-12
    off = (more - 0.4**2 * np.outer(wrong, wrong)) / np.outer(scale, scale)
    assert np.abs(off).max() < 0.01  # each LED moves the state at which the next is linearised
    # What low-passes take has the same shape: most of it goes to the gyro's.
    assert abs(wrong[-1]) * 0.4 / scale[-1] > 0.05


def test_three_leds_at_once_do_not_tell_how_far_single_ones_are_off(plain):
    done, last = plain
    problem, leds, n_views = last.states.problem, done.leds, done.errors.n_views
    few = replace(problem, leds=problem.leds._replace(use=problem.leds.use & (leds.led < 3)))
    way = StandingWay(few, Filter(few), leds, last.pictured, 7, n_views=n_views)
    prior = StandingPrior.of(leds, last.pictured, 7, SETTINGS, n_views=n_views, camera_moves=False)
    found = way.estimate(prior, np.zeros_like(done.errors.value))
    assert np.isnan(found.offset_sd_px)
    assert np.isfinite(found.value).all() and np.isfinite(found.covariance).all()


def test_how_far_a_smear_draws_leaning_lights_is_found(plain):
    # Centroids drawn by a fiftieth of their smear times how far their axes lean, as the last pass pictures it.
    done, last = plain
    problem, pictured, leds = last.states.problem, last.pictured, done.leds
    n_views = done.errors.n_views

    def errors(share):
        seen = problem.leds.residual_px + share * pictured.leaning_px
        drawn = replace(problem, leds=problem.leds._replace(residual_px=seen))
        way = StandingWay(drawn, Filter(drawn), leds, pictured, 7, n_views=n_views)
        prior = StandingPrior.of(leds, pictured, 7, SETTINGS, n_views=n_views, camera_moves=False)
        return way.estimate(prior, np.zeros_like(done.errors.value))

    none, drawn = errors(0.0), errors(0.02)
    sd = np.sqrt(none.covariance[SMEAR, SMEAR])
    assert sd < 0.005
    assert abs(none.value[SMEAR]) < 3.5 * sd
    # The prior of 0.01 keeps what its share of the information is.
    assert drawn.value[SMEAR] - none.value[SMEAR] == pytest.approx(0.02 * (1 - (sd / 0.01) ** 2), rel=0.03)


def test_the_likeliest_errors_are_those_of_the_dense_gaussian_formulas():
    # Direct: y = -A e + noise of one, e about zero with covariance P; the likelihood is that of y itself.
    rng = np.random.default_rng(8)
    A, known = rng.normal(size=(12, 5)), np.array([0.3, -0.2, 0.1, 0.4, 0.0])
    sd = np.array(
        [[0.5, 2.0, 0.3, 0.0, 1.0], [1.5, 0.1, 0.3, 0.0, 1.0]]
    )  # the fourth has no variance: it stays
    y = rng.normal(size=12)
    prior = sd[:, :, None] ** 2 * np.eye(5)
    belief, value = _likeliest(prior, known, A.T @ A, A.T @ y)
    out_already = np.where(sd[0] > 0, known, 0.0)
    direct = []
    for P, found in zip(prior, value, strict=True):
        whole = y - A @ out_already  # as it was before the errors that are known were taken out
        S = np.eye(12) + A @ P @ A.T
        np.testing.assert_allclose(
            found, np.where(sd[0] > 0, -P @ A.T @ np.linalg.solve(S, whole), known), atol=1e-12
        )
        direct.append(-0.5 * (whole @ np.linalg.solve(S, whole) + np.linalg.slogdet(S)[1]))
    assert belief[1] - belief[0] == pytest.approx(direct[1] - direct[0], abs=1e-10)


def test_pictures_predicted_once_serve_while_the_motion_moves_them_little(plain, monkeypatch):
    # Predicted anew in each pass they give the same motion: apart by less than a twentieth of its sd.
    held = plain[0]
    monkeypatch.setattr(led_smoothing, "_PICTURES_HOLD_PX", 0.0)
    anew = smoothed(plain_run())
    off_m = np.abs(origin_m(held.states) - origin_m(anew.states))
    sd_m = np.sqrt(anew.states.estimate.variance[:, 0, POS])
    assert (off_m / sd_m).max() < 0.05


def test_further_passes_would_move_the_motion_by_little_of_its_sd(plain, monkeypatch):
    # The last pass moved it by less than a fifth of its sd; what is left to go is less.
    monkeypatch.setattr(led_smoothing, "_STANDS_SDS", 0.0)
    further = smoothed(plain_run())
    sd_m = np.sqrt(further.states.estimate.variance[:, 0, POS])
    off_sds = (origin_m(plain[0].states) - origin_m(further.states)) / sd_m
    assert np.sqrt(np.mean(off_sds**2)) < 0.1


def test_an_led_that_is_off_all_the_time_is_found():
    run = simulate_run(32, duration_s=4.0)
    uv = run.observations.uv_px.copy()
    uv[:, 4, 0] += 0.3
    done = smoothed(replace(run, observations=replace(run.observations, uv_px=uv)))
    offset = done.errors.value[FIRST_LED:BY_VIEW].reshape(7, 2)
    sd = np.sqrt(np.diagonal(done.errors.covariance))[FIRST_LED:BY_VIEW].reshape(7, 2)
    assert np.argmax(np.abs(offset[:, 0])) == 4
    # A part of it looks like a pose, which the sd says.
    assert abs(offset[4, 0] - 0.3) < 3 * sd[4, 0]
    assert offset[4, 0] > 0.12
    assert done.errors.offset_sd_px > 0.03
    assert sd[4, 0] < 0.2


@pytest.mark.parametrize(("beside_px", "is_used"), [(0.3, True), (3.0, False)])
def test_an_led_a_little_beside_its_place_is_left_out_of_no_pass(beside_px, is_used, monkeypatch):
    # Else it is in and out by turns, and each pass believes what the one before did not.
    used = []
    learn = LedSmoother._learn

    def keep(self, *args, **kwargs):
        learn(self, *args, **kwargs)
        used.append(self._use[self._sights.leds.led == 4].mean())

    monkeypatch.setattr(LedSmoother, "_learn", keep)
    run = simulate_run(32, duration_s=4.0)
    uv = run.observations.uv_px.copy()
    uv[:, 4, 0] += beside_px
    smoothed(replace(run, observations=replace(run.observations, uv_px=uv)))
    assert min(used) > 0.99 if is_used else used[0] < 0.5


def test_three_sharp_leds_at_the_start_leave_no_variance_to_rounding():
    # Where the start was as wide as bricks move, variances were negative and the filter went astray for frames.
    run = simulate_run(31, duration_s=3.0, centroid_sd_px=0.002)
    uv = run.observations.uv_px.copy()
    uv[:7, :4] = np.nan
    done = smoothed(replace(run, observations=replace(run.observations, uv_px=uv)))
    assert np.all(done.states.estimate.variance[:, 0] > 0)
    assert done.states.problem.leds.inflation.max() < 5


def with_darker_limb(run):
    """Return a run whose lights lean forward by up to 0.08 of radius times sine, the more from in front."""
    _, t_ns = led_times_ns(run.observations, run.camera)
    R, t_mm = (x.reshape(*t_ns.shape, *x.shape[1:]) for x in run.world.pose(t_ns.ravel()))
    there, _ = predict_brick(R, t_mm, run.camera, run.brick, collar_mm=collar_of(run.brick))
    side_on_px = there.model_shift_px / run.brick.led_profile.shift_sd_per_radius
    angle_rad = np.arccos(np.clip(there.facing, -1, 1))
    shift_px = (0.08 * np.clip(1 - angle_rad / 0.5, 0, 1))[..., None] * side_on_px
    observations = replace(run.observations, uv_px=run.observations.uv_px + shift_px)
    return replace(run, observations=observations)


def test_a_shape_that_shows_from_in_front_alone_turns_no_pose():
    # One LED of the seven looks into the camera, and stands out of the others' plane.
    run = simulate_run(31, duration_s=4.0)
    now = smoothed(with_darker_limb(run)).states
    t_ns = run.observations.sensor_timestamp_ns[10:-10]
    R, _ = sample_poses(now.run, now.nodes, now.estimate.state, 0, t_ns)
    turn_deg = np.degrees(rvec_from_matrix(np.swapaxes(run.truth(t_ns)[0], 1, 2) @ R))
    # 0.058 where it was believed of each LED by itself, 0.008 where there is no such shape.
    assert np.sqrt(np.mean(np.sum(turn_deg**2, axis=1))) < 0.02


def test_what_the_gyros_low_pass_takes_is_found():
    # The simulated chip's is critically damped, with a delay of 7 ms. Poses alone put it at 2.7 to 3.5 ms / 2.
    run = simulate_run(13, duration_s=16.0)
    done = smoothed(run)
    loss_s2 = done.states.run.alignment.gyro_filter_s**2 + done.errors.value[-1]
    sd_s2 = np.sqrt(done.errors.covariance[-1, -1])
    assert sd_s2 < 1e-6
    assert abs(loss_s2 - 3.5e-3**2) < 3 * sd_s2
    arm_sds = done.errors.value[18:21] / np.sqrt(np.diagonal(done.errors.covariance))[18:21]
    assert np.abs(arm_sds).max() < 3.5
