"""Errors drawn as the smoother believes them, against a dense solution, and the band of their means."""

import numpy as np
import pytest
from brick_shakes import LEVER_ARM_MM, simulate_shake
from scipy.signal import lfilter

from bricktrack_host.fusion.believed_errors import (
    MeanBand,
    draw_pose_errors,
    draw_state_errors,
    pose_errors,
)
from bricktrack_host.fusion.estimate import FusionInput, fused_result, prepare_run
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.pose_by_pose.pose_level import smooth_poses
from bricktrack_host.fusion.smoothing.sensor_errors import with_sensor_doubt
from bricktrack_host.fusion.smoothing.smoother import residuals
from bricktrack_host.fusion.smoothing.transition_kernel import transition
from bricktrack_host.normalised_errors import normalised_squares

N_DRAWS = 4000


@pytest.fixture(scope="module")
def smoothed():
    s = simulate_shake(3, duration_s=0.9)
    item = FusionInput(s.optical, s.imu, LEVER_ARM_MM, s.optical.t_ns)
    return smooth_poses([prepare_run(item, FusionSettings())], FusionSettings())[0]


def dense_covariance(problem, passed, state):
    """Return the covariance of the states of all nodes given all frames, solved at once: (K, K, 22, 22)."""
    n = len(problem.has_frame)
    R = passed.forward().state.R[:, 0]
    C = np.zeros((n, n, 22, 22))
    C[0, 0] = problem.P_start[0]
    for k in range(n - 1):
        F, moving, dt = np.eye(22), np.zeros((9, 22)), problem.dt_s[k, 0]
        transition(passed.runs[0], k, R[k], moving)
        F[:9] = moving
        Q, acc = np.zeros((22, 22)), problem.acc_var[k, 0]
        for i in range(3):
            Q[i, i] = problem.gyro_var[k, 0] * dt
            Q[3 + i, 3 + i], Q[6 + i, 6 + i] = acc * dt**3 / 3, acc * dt
            Q[3 + i, 6 + i] = Q[6 + i, 3 + i] = acc * dt**2 / 2
            Q[9 + i, 9 + i] = problem.gyro_bias_walk[k, 0] * dt
            Q[12 + i, 12 + i] = problem.acc_bias_walk[k, 0] * dt
        for j in range(k + 1):
            C[k + 1, j] = F @ C[k, j]
            C[j, k + 1] = C[k + 1, j].T
        C[k + 1, k + 1] = F @ C[k, k] @ F.T + Q
    at = np.flatnonzero(problem.has_frame[:, 0])
    H = residuals(problem, state, at, 0)[1]
    seen = np.einsum("iab,ikbc->iakc", H, C[at]).reshape(6 * len(at), 22 * n)
    S = np.einsum("iakc,kbc->iakb", seen.reshape(len(at), 6, n, 22)[:, :, at], H)
    S = S.reshape(6 * len(at), 6 * len(at)).copy()
    for i, k in enumerate(at):
        S[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += problem.cov_seen[k, 0] * passed.inflation[k, 0]
    whole = C.transpose(0, 2, 1, 3).reshape(22 * n, 22 * n) - seen.T @ np.linalg.solve(S, seen)
    return whole.reshape(n, 22, n, 22).transpose(0, 2, 1, 3)


def test_drawn_errors_have_the_covariance_of_nodes_and_between_them(smoothed):
    problem, passed = smoothed.problem, smoothed.passed
    estimate = passed.smooth()
    rng = np.random.default_rng(1)
    drawn = draw_state_errors(problem, passed, estimate, 0, doubt=None, n_draws=N_DRAWS, rng=rng)[:, :6]
    dense = dense_covariance(problem, passed, estimate.state)[:, :, :6, :6]
    sd = np.sqrt(np.diagonal(np.diagonal(dense), axis1=0, axis2=1))  # (K, c)
    # Draws scatter their sd by 1 / sqrt(2 N); the filter took H where it was then, the dense solution where it
    # ended.
    assert np.sqrt((drawn**2).mean(axis=2)) == pytest.approx(sd, rel=0.08)
    unit = drawn / sd[..., None]
    for apart in (1, 5, 20):
        found = np.einsum("kan,kbn->kab", unit[apart:], unit[:-apart]) / N_DRAWS
        k = np.arange(len(sd) - apart)
        expected = dense[k + apart, k] / (sd[apart:, :, None] * sd[:-apart, None, :])
        assert np.abs(found - expected).max() < 0.1  # five sd of the draws
        assert np.abs(found - expected).mean() < 0.02
    # Neighbours share their error, and a fifth of a second later most of the position's is new.
    assert np.abs(np.diagonal(expected, axis1=1, axis2=2)[:, 3:6]).mean() < 0.6


def test_a_standing_error_is_one_over_the_whole_run(smoothed):
    problem, passed, estimate = smoothed.problem, smoothed.passed, smoothed.passed.smooth()
    unsure = np.zeros((21, 21))
    unsure[18, 18] = 1e6  # a kilometre of the arm along x: everything else is nothing beside it
    with_doubt, (doubt,) = with_sensor_doubt(problem, passed, estimate, [unsure])
    drawn = draw_state_errors(
        problem, passed, estimate, 0, doubt=doubt, n_draws=N_DRAWS, rng=np.random.default_rng(2)
    )[:, 3:6]
    added = with_doubt.covariance[:, 0] - estimate.covariance[:, 0]
    sd_m = np.sqrt(np.diagonal(added, axis1=1, axis2=2)[:, 3:6])
    assert drawn.std(axis=2) == pytest.approx(sd_m, rel=0.05, abs=0.01)
    # What it does at a node is one number of a draw for all nodes, whichever axis shows it best.
    largest, nodes = np.argmax(sd_m, axis=1), np.arange(len(sd_m))
    unit = drawn[nodes, largest] / sd_m[nodes, largest, None]
    assert sd_m[nodes, largest].min() > 0.3
    assert np.abs(np.abs(unit) - np.abs(unit[0])).max() < 0.05


def test_errors_of_a_run_beside_a_much_longer_one_are_drawn_to_its_end():
    runs = []
    for duration_s in (0.9, 4.0):
        s = simulate_shake(3, duration_s=duration_s)
        item = FusionInput(s.optical, s.imu, LEVER_ARM_MM, s.optical.t_ns)
        runs.append(prepare_run(item, FusionSettings()))
    s = smooth_poses(runs, FusionSettings())[0]
    assert s.doubt is not None
    rng = np.random.default_rng(4)
    drawn = draw_state_errors(s.problem, s.passed, s.estimate, s.b, doubt=s.doubt, n_draws=N_DRAWS, rng=rng)
    assert len(drawn) == np.count_nonzero(s.problem.dt_s[:, s.b] > 0) + 1
    sd = np.sqrt(np.diagonal(s.estimate.covariance[: len(drawn), s.b], axis1=1, axis2=2))
    assert drawn.std(axis=2) == pytest.approx(sd, rel=0.08)  # as above


def correlated_squares(rng, n, n_runs, gain, memory):
    """Return the squares of six errors that remember, ``gain`` times what is stated, shape (n, n_runs)."""
    noise = rng.normal(0, 1, (n + 200, 6, n_runs))
    e = lfilter([np.sqrt(1 - memory**2)], [1, -memory], noise, axis=0)[200:]
    return ((gain * e) ** 2).sum(axis=1)


def test_the_band_of_a_run_counts_what_is_independent_and_holds_honest_runs_alone():
    rng, n, memory = np.random.default_rng(3), 700, np.exp(-0.1)
    band = MeanBand.of(correlated_squares(rng, n, 1000, 1.0, memory))
    # Squares of first-order errors remember by the square of the errors' correlation.
    assert band.n_independent == pytest.approx(n * (1 - memory**2) / (1 + memory**2), rel=0.15)
    assert band.low < 6 < band.high
    held = {
        gain: np.mean([band.holds(run) for run in correlated_squares(rng, n, 400, gain, memory).T])
        for gain in (0.75, 1.0, 1.3)
    }
    assert held[1.0] == pytest.approx(0.95, abs=0.035)  # three sd of 400 runs
    assert held[0.75] < 0.02 and held[1.3] < 0.02


def test_a_simulated_run_errs_as_it_believes():
    settings = FusionSettings(optical_common_share=0.0, sensor_gain_sd=0.0, lever_arm_sd_mm=0.1)
    s = simulate_shake(5, duration_s=4.0, impacts=4, dropouts=((2.0, 2.3),))
    t_ns = np.arange(s.optical.t_ns[2], s.optical.t_ns[-3], 10_000_000)
    item = FusionInput(s.optical, s.imu, LEVER_ARM_MM, t_ns)
    smoothed = smooth_poses([prepare_run(item, settings)], settings)[0]
    track = fused_result(item, smoothed, settings).track
    errors, covariance = draw_pose_errors(
        smoothed, t_ns, common=np.zeros((6, 6)), n_draws=300, rng=np.random.default_rng(4)
    )
    # The nearest node stands for an instant: half a sample away at most.
    sd, of_track = (
        np.sqrt(np.diagonal(c, axis1=1, axis2=2)).mean(axis=0) for c in (covariance, track.covariance)
    )
    assert sd == pytest.approx(of_track, rel=0.1)
    band = MeanBand.of(normalised_squares(errors, covariance))
    squares = normalised_squares(pose_errors(track, *s.truth(t_ns)), track.covariance)
    assert band.high - band.low < 6 and band.holds(squares)
    assert not band.holds(0.4 * squares) and not band.holds(2.5 * squares)
