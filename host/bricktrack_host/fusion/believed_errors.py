"""Whether a fused motion errs as far as it says: its normalised errors, and the band their mean may lie in.

The mean of squared errors over their covariance (NEES) is 6 for a pose when the covariance is honest. How far
from 6 the mean of one run may lie is a matter of how many independent errors the run holds: those of
neighbouring instants are one error, those by a standing cause (an offset of clocks, the lever arm, gravity)
are one over the whole run (Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking
and Navigation, 2001, ch. 5.4: the band of N *independent* values). The smoother knows how many: its own model
holds the covariance of any two instants. So errors of whole runs are drawn from it, and the band is that of
their means.
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.fusion.inertial.imu_samples import seconds_since
from bricktrack_host.fusion.pose_by_pose.pose_level import Smoothed
from bricktrack_host.fusion.smoothing.covariance_kernel import M
from bricktrack_host.fusion.smoothing.smoother import (
    BG,
    N_STATES,
    SKEW,
    TAU,
    Estimate,
    Filter,
    Problem,
    State,
    observe,
)
from bricktrack_host.fusion.smoothing.standing_doubt import Doubt, root_of
from bricktrack_host.fusion.smoothing.transition_kernel import transition
from bricktrack_host.tracks import FusedTrack

POSE_DOF = 6


@dataclass(frozen=True, slots=True)
class MeanBand:
    """Where the mean of a run's squared normalised errors may lie when they are as believed.

    Attributes
    ----------
    low, high : float
        Of 95 runs in 100 the mean lies between.
    n_independent : float
        So many independent errors would scatter their mean as much.
    """

    low: float
    high: float
    n_independent: float

    @classmethod
    def of(cls, drawn: FloatArray) -> "MeanBand":
        """Return the band from squares drawn as believed, shape (k, n_draws), at the k instants judged."""
        means = drawn.mean(axis=0)
        low, high = np.quantile(means, [0.025, 0.975])
        return cls(float(low), float(high), float(2 * POSE_DOF / means.var()))

    def holds(self, squares: FloatArray) -> bool:
        """Return whether the mean of a run's squares lies in the band: neither too sure nor too unsure."""
        return bool(self.low <= squares.mean() <= self.high)


def pose_errors(track: FusedTrack, R: FloatArray, t_mm: FloatArray) -> FloatArray:
    """Return true poses, shape (k, 3, 3) and (k, 3), less a track's: (k, 6), ``[dtheta rad, dt mm]``."""
    turn = rvec_from_matrix(np.swapaxes(track.R_camera_brick, 1, 2) @ R)
    return np.concatenate([turn, t_mm - track.t_camera_brick_mm], axis=1)


def draw_pose_errors(
    s: Smoothed, t_ns: IntArray, *, common: FloatArray, n_draws: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return errors of a smoothed run's poses, drawn as they are believed to be, and their covariance.

    Parameters
    ----------
    s : Smoothed
        Of a camera that stands still.
    t_ns : ndarray of int64, shape (k,), camera time
        Each is taken to be at the node nearest to it, half a sample away at most.
    common : ndarray, shape (6, 6), rad and m
        What is added to the covariance given out for an error that is one over the whole run.

    Returns
    -------
    errors, covariance : ndarray, shape (k, 6, n_draws), (k, 6, 6), ``[dtheta rad, dt mm]``
    """
    x, n = s.estimate.state, len(s.nodes.t_s)
    t_cam = seconds_since(t_ns, s.run.signal.epoch_ns)
    since_mid = t_cam - s.run.t_mid_s
    t = t_cam + x.x[0, s.b, TAU] + x.x[0, s.b, SKEW] * since_mid
    at = np.searchsorted(0.5 * (s.nodes.t_s[1:n] + s.nodes.t_s[: n - 1]), t)
    state = State(x.R[at, s.b], x.x[at, s.b])
    omega = s.problem.omega_radps[at, s.b] - state.x[:, BG]
    H = observe(state, omega, s.run.lever_arm_m, since_mid, np.zeros(len(at)))[2][..., s.estimate.of]
    drawn = draw_state_errors(s.problem, s.passed, s.estimate, s.b, doubt=s.doubt, n_draws=n_draws, rng=rng)
    errors = H @ drawn[at] + root_of(common) @ rng.standard_normal((POSE_DOF, n_draws))
    covariance = H @ s.estimate.covariance[at, s.b] @ np.swapaxes(H, 1, 2) + common
    to_mm = np.repeat([1.0, 1e3], 3)
    return errors * to_mm[:, None], covariance * to_mm[:, None] * to_mm


def draw_state_errors(
    problem: Problem,
    passed: Filter,
    estimate: Estimate,
    b: int,
    *,
    doubt: Doubt | None,
    n_draws: int,
    rng: np.random.Generator,
) -> FloatArray:
    """Return errors of the states ``estimate.of`` of run ``b``, drawn together: (K, c, n_draws), truth less.

    With those of standing errors that ``doubt`` is about.

    Filter forwards, sample backwards: the last state is drawn by its covariance, each one before by what the
    filter knew then and what the state after it tells (C. K. Carter, R. Kohn, On Gibbs sampling for state
    space models, Biometrika 81, 1994). Nodes after a run's last are left out.
    """
    of = estimate.of
    n_steps = int(np.count_nonzero(problem.dt_s[:, b] > 0))
    after = passed.forward(of=np.arange(N_STATES))
    P, R = after.covariance[: n_steps + 1, b], after.state.R[:, b]
    before = passed.predicted(b)[1 : n_steps + 1]
    F, moving = np.tile(np.eye(N_STATES), (n_steps, 1, 1)), np.zeros((M, N_STATES))
    for k in range(n_steps):
        transition(passed.runs[b], k, R[k], moving)
        F[k, :M] = moving
    # The states' units differ by nine orders of magnitude: solved in units of each state's own sd.
    sd = np.sqrt(np.diagonal(before, axis1=1, axis2=2))
    PF = P[:-1] @ np.swapaxes(F, 1, 2)
    unit = before / (sd[:, :, None] * sd[:, None, :])
    gain = np.swapaxes(np.linalg.solve(unit, np.swapaxes(PF / sd[:, None, :], 1, 2)), 1, 2) / sd[:, None, :]
    rest = P[:-1] - gain @ np.swapaxes(PF, 1, 2)
    now = _root_in_own_units(P[-1]) @ rng.standard_normal((N_STATES, n_draws))
    drawn = np.empty((n_steps + 1, len(of), n_draws))
    drawn[-1] = now[of]
    for k in range(n_steps - 1, -1, -1):
        now = gain[k] @ now + _root_in_own_units(rest[k]) @ rng.standard_normal((N_STATES, n_draws))
        drawn[k] = now[of]
    if doubt is not None:
        standing = rng.standard_normal((len(doubt.root), n_draws))
        for nodes, moved in doubt.stretches(estimate.state, b):
            drawn[nodes] += (moved @ standing)[: len(drawn[nodes])]
    return drawn


def _root_in_own_units(covariance: FloatArray) -> FloatArray:
    """Return a root of a covariance of states, which may lack rank: what stands still is not drawn anew."""
    sd = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    scale = np.where(sd > 0, sd, 1.0)
    return np.asarray(sd[:, None] * root_of(covariance / (scale[:, None] * scale)))
