"""Filter and smoother: Jacobians against finite differences, estimates against the dense Gaussian solution."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bricktrack_host.fusion.smoothing.smoother import (
    ATT,
    BA,
    BG,
    GRAV,
    LAG,
    LOSS,
    N_STATES,
    POS,
    SKEW,
    TAU,
    VEL,
    Filter,
    Problem,
    State,
    observe,
    score_noise,
)

N_NODES, DT = 40, 0.01
ALL = np.arange(N_STATES)
ARM = np.array([0.026, 0.053, 0.014])


def turning_problem(seed=3):
    """Return one run of 40 steps that turns and accelerates, without frames and without noise."""
    rng = np.random.default_rng(seed)
    steps = (N_NODES - 1, 1)
    omega = rng.normal(0, 2, (N_NODES, 1, 3))
    turn = Rotation.from_rotvec(omega[:-1, 0] * DT).as_matrix()[:, None]
    half = Rotation.from_rotvec(omega[:-1, 0] * DT / 2).as_matrix()[:, None]
    force = rng.normal(0, 5, (*steps, 3))
    x = np.zeros((1, N_STATES))
    x[0, POS], x[0, VEL], x[0, GRAV] = [0.01, -0.02, 0.03], [0.1, 0.2, -0.1], [0.3, 9.7, -1.0]
    return Problem(
        dt_s=np.full(steps, DT),
        R_step=turn,
        R_half=half,
        dv_mps=(half @ force[..., None])[..., 0] * DT,
        dp_m=(half @ force[..., None])[..., 0] * DT**2 / 2,
        f_rate_mps3=rng.normal(0, 100, (*steps, 3)),
        f_curve_mps4=rng.normal(0, 1e4, (*steps, 3)),
        known=rng.normal(0, 1, (*steps, 4, 3)) * np.array([0.05, 3e-4, 100, 1e4])[:, None],
        gyro_var=np.zeros(steps),
        acc_var=np.zeros(steps),
        gyro_bias_walk=np.zeros(steps),
        acc_bias_walk=np.zeros(steps),
        omega_radps=omega,
        camera_omega_radps=np.zeros((N_NODES, 1, 3)),
        has_frame=np.zeros((N_NODES, 1), dtype=bool),
        R_seen=np.broadcast_to(np.eye(3), (N_NODES, 1, 3, 3)).copy(),
        p_seen_m=np.zeros((N_NODES, 1, 3)),
        cov_seen=np.broadcast_to(np.eye(6), (N_NODES, 1, 6, 6)).copy(),
        since_mid_s=(np.arange(N_NODES)[:, None] - N_NODES / 2) * DT,
        lever_arm_m=ARM[None],
        bg_lin=np.zeros((1, 3)),
        ba_lin=np.zeros((1, 3)),
        tau_lin=np.zeros(1),
        skew_lin=np.zeros(1),
        lag_lin=np.zeros(1),
        loss_lin=np.zeros(1),
        start=State(Rotation.random(rng=rng).as_matrix()[None], x),
        P_start=np.eye(N_STATES)[None] * 1e-6,
    )


def moved(state, d):
    """Return a state displaced by an error vector, by scipy's rotations."""
    x = state.x + d
    x[..., ATT] = 0
    return State(state.R @ Rotation.from_rotvec(d[ATT]).as_matrix(), x)


def difference(a, b):
    """Return the error vector from state b to state a, shape (24,) less unused, of the only run."""
    d = (a.x - b.x)[0]
    d[ATT] = Rotation.from_matrix(b.R[0].T @ a.R[0]).as_rotvec()
    return d


def end_of(problem):
    e = Filter(problem).forward(of=ALL)
    return State(e.state.R[-1], e.state.x[-1]), e.covariance[-1, 0]


def test_covariance_is_carried_by_the_true_derivative_of_the_motion():
    problem = turning_problem()
    base, _ = end_of(problem)
    size = np.full(N_STATES, 1e-5)
    size[LAG] = 1e-6
    for i in range(N_STATES):
        d = np.zeros(N_STATES)
        d[i] = size[i]
        plus, _ = end_of(replace(problem, start=moved(problem.start, d)))
        minus, _ = end_of(replace(problem, start=moved(problem.start, -d)))
        column = (difference(plus, base) - difference(minus, base)) / (2 * size[i])
        _, P = end_of(replace(problem, P_start=np.outer(d, d)[None]))
        # 39 steps: what the design's F leaves out is of order dt^2 (a bias acting on attitude inside a step).
        assert np.allclose(P, np.outer(column, column) * size[i] ** 2, rtol=0.02, atol=2e-4 * P.max()), i


@pytest.mark.parametrize("camera", [None, np.array([0.4, -0.2, 0.7])])
def test_observation_jacobian_is_the_derivative(camera):
    rng = np.random.default_rng(4)
    x = np.zeros(N_STATES)
    x[POS], x[VEL] = rng.normal(0, 0.1, 3), rng.normal(0, 0.3, 3)
    state = State(Rotation.random(rng=rng).as_matrix(), x)
    omega, since = np.array([1.0, -2.0, 0.5]), np.array(3.2)

    def seen(d):
        dt = np.array(d[TAU] + since * d[SKEW])
        return observe(moved(state, d), omega, ARM, since, dt, camera_omega_radps=camera)

    R, p, H = seen(np.zeros(N_STATES))
    assert np.allclose(p, x[POS] - state.R @ ARM)
    for i in range(N_STATES):
        d = np.zeros(N_STATES)
        d[i] = 1e-6
        R_d, p_d, _ = seen(d)
        turn = Rotation.from_matrix(R.T @ R_d).as_rotvec()
        assert np.allclose(np.r_[turn, p_d - p] / 1e-6, H[:, i], atol=1e-5), i


def straight_problem(seed):
    """Return a run that does not turn, noise in everything, frames every fourth node but for a dropout."""
    rng = np.random.default_rng(seed)
    base = turning_problem()
    steps = (N_NODES - 1, 1)
    eye = np.broadcast_to(np.eye(3), (*steps, 3, 3)).copy()
    force = rng.normal(0, 5, (*steps, 3))
    has_frame = np.zeros((N_NODES, 1), dtype=bool)
    has_frame[[0, 4, 8, 12, 30, 34, 38], 0] = True
    P = np.zeros((N_STATES, N_STATES))
    P[ATT, ATT] = P[BG, BG] = np.eye(3) * 1e-16  # held: the problem is linear then
    P[[TAU, SKEW, LAG, LOSS], [TAU, SKEW, LAG, LOSS]] = 1e-18
    P[POS, POS], P[VEL, VEL] = np.eye(3) * 0.1**2, np.eye(3) * 0.3**2
    P[BA, BA], P[GRAV, GRAV] = np.eye(3) * 0.2**2, np.eye(3) * 0.1**2
    acc_var = rng.uniform(0.5, 2.0, steps) * 1e-4
    x = base.start.x[0]
    p, v = x[POS] + rng.normal(0, 0.1, 3), x[VEL] + rng.normal(0, 0.3, 3)
    ba, g = rng.normal(0, 0.2, 3), x[GRAV] + rng.normal(0, 0.1, 3)
    p_true = [p]
    for k in range(N_NODES - 1):
        a = force[k, 0] + g - ba + rng.normal(0, np.sqrt(acc_var[k] / DT), 3)
        p, v = p + v * DT + a * DT**2 / 2, v + a * DT
        p_true.append(p)
    return replace(
        base,
        R_step=eye,
        R_half=eye,
        dv_mps=force * DT,
        dp_m=force * DT**2 / 2,
        f_rate_mps3=np.zeros((*steps, 3)),
        f_curve_mps4=np.zeros((*steps, 3)),
        known=np.zeros((*steps, 4, 3)),
        acc_var=acc_var,
        acc_bias_walk=np.full(steps, 1e-3),
        omega_radps=np.zeros((N_NODES, 1, 3)),
        has_frame=has_frame,
        p_seen_m=(np.array(p_true) + rng.normal(0, 1e-4, (N_NODES, 3)))[:, None],
        cov_seen=np.broadcast_to(np.diag([1.0] * 3 + [1e-8] * 3), (N_NODES, 1, 6, 6)).copy(),
        lever_arm_m=np.zeros((1, 3)),
        start=State(np.eye(3)[None], base.start.x),
        P_start=P[None],
    )


def dense_posterior(problem):
    """Return mean and sd of position and velocity at all nodes by conditioning one joint Gaussian.

    One axis at a time: state p, v, ba, g; every node written out as a linear map of all start values and noises.
    """
    means, sds = np.empty((N_NODES, 3, 2)), np.empty((N_NODES, 3, 2))
    for axis in range(3):
        n_noise = 4 + 3 * (N_NODES - 1)
        A, mean = np.zeros((N_NODES, 4, n_noise)), np.zeros((N_NODES, 4))
        A[0, :4, :4] = np.diag([0.1, 0.3, 0.2, 0.1])
        x = problem.start.x[0]
        mean[0] = [x[3 + axis], x[6 + axis], x[12 + axis], x[15 + axis]]
        F = np.array([[1, DT, -(DT**2) / 2, DT**2 / 2], [0, 1, -DT, DT], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        for k in range(N_NODES - 1):
            q = problem.acc_var[k, 0]
            L = np.linalg.cholesky(q * np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]]))
            A[k + 1] = F @ A[k]
            A[k + 1, :2, 4 + 3 * k : 6 + 3 * k] += L
            A[k + 1, 2, 6 + 3 * k] += np.sqrt(problem.acc_bias_walk[k, 0] * DT)
            mean[k + 1] = F @ mean[k]
            mean[k + 1, :2] += [problem.dp_m[k, 0, axis], problem.dv_mps[k, 0, axis]]
        seen = np.flatnonzero(problem.has_frame[:, 0])
        H = A[seen, 0]
        S = H @ H.T + 1e-8 * np.eye(len(seen))
        gain = np.linalg.solve(S, H).T  # of the unit noises
        noise = gain @ (problem.p_seen_m[seen, 0, axis] - mean[seen, 0])
        cov = np.eye(n_noise) - gain @ H
        means[:, axis] = (mean + A @ noise)[:, :2]
        sds[:, axis] = np.sqrt(np.einsum("kij,jl,kil->ki", A, cov, A))[:, :2]
    return means, sds


def test_smoother_equals_the_dense_gaussian_solution():
    problem = straight_problem(5)
    means, sds = dense_posterior(problem)
    e = Filter(problem).smooth(of=ALL)
    x, P = e.state.x[:, 0], e.covariance[:, 0]
    assert np.nanmax(e.nis) < 12  # else a frame is weighted down, and the problem no longer linear
    assert np.allclose(x[:, POS], means[:, :, 0], atol=2e-8)
    assert np.allclose(x[:, VEL], means[:, :, 1], atol=2e-6)
    sd = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    assert np.allclose(sd[:, POS], sds[:, :, 0], rtol=1e-4)
    assert np.allclose(sd[:, VEL], sds[:, :, 1], rtol=1e-4)


def test_runs_of_a_batch_do_not_touch_each_other():
    a, b = straight_problem(6), straight_problem(7)
    per_run = {"lever_arm_m", "bg_lin", "ba_lin", "tau_lin", "skew_lin", "lag_lin", "loss_lin", "P_start"}
    both = {
        name: np.concatenate([getattr(a, name), getattr(b, name)], axis=0 if name in per_run else 1)
        for name in Problem.__slots__
        if name not in ("start", "leds")
    }
    start = State(np.concatenate([a.start.R, b.start.R]), np.concatenate([a.start.x, b.start.x]))
    together = Filter(Problem(start=start, **both)).smooth()
    for i, problem in enumerate((a, b)):
        alone = Filter(problem).smooth()
        assert np.allclose(together.state.x[:, i], alone.state.x[:, 0], atol=1e-12)
        assert np.allclose(together.covariance[:, i], alone.covariance[:, 0], rtol=1e-9, atol=1e-18)


def test_noise_choices_are_scored_as_if_each_ran_alone():
    a = straight_problem(8)
    factors = np.array([0.1, 1.0, 10.0])
    acc = factors[None, :, None] * a.acc_var[:, 0]
    together = score_noise(a, np.repeat(a.gyro_var.T[:, None], 3, axis=1), acc)[0][0]
    alone = [Filter(replace(a, acc_var=a.acc_var * f)).log_likelihood[0] for f in factors]
    assert np.allclose(together, alone, rtol=1e-9)


def test_a_frame_far_off_is_believed_less_but_pulls_a_lost_filter_back():
    problem = straight_problem(9)
    p = problem.p_seen_m.copy()
    p[34] += 0.05
    smooth = Filter(problem).smooth().state.x[34, 0, POS]
    outlier = Filter(replace(problem, p_seen_m=p)).smooth().state.x[34, 0, POS]
    assert np.abs(outlier - smooth).max() < 0.005
    shifted, looser = problem.p_seen_m.copy(), problem.acc_var * 1e5
    shifted[30:] += 0.05
    back = Filter(replace(problem, p_seen_m=shifted, acc_var=looser)).smooth().state.x[38, 0, POS]
    assert np.abs(back - shifted[38, 0]).max() < 0.005


def test_a_variance_of_which_rounding_leaves_nothing_is_nan_and_one_that_was_never_there_is_zero():
    # The variance is that at the start less what the frames took of it: of 1e12 m^2 a double keeps 1e-4 m^2, and
    # some 1e-9 m^2 are left in truth. Half of what rounding leaves is less than nothing.
    problem = straight_problem(11)
    P = problem.P_start.copy()
    P[0, LAG] = P[0, :, LAG] = 0.0
    P[0, ATT, ATT] = np.eye(3) * 1e-2
    P[0, POS, POS], P[0, VEL, VEL] = np.eye(3) * 1e12, np.eye(3) * 1e12
    e = Filter(replace(problem, P_start=P)).smooth(of=ALL)
    variance = np.diagonal(e.covariance[:, 0], axis1=1, axis2=2)
    assert not (np.delete(variance, LAG, axis=1) <= 0).any()
    assert np.isnan(variance[:, POS]).any()
    assert (variance[:, LAG] == 0).all()
    assert np.array_equal(variance, e.variance[:, 0], equal_nan=True)
