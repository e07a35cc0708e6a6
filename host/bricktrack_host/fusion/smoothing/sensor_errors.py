"""Errors of the inertial sensor that stand still over a run: scale, crossed axes, and its place in the brick.

A data sheet allows one part in a hundred for scale and axes, and a sensor is glued in to a millimetre. Left
alone, that limits the position in a dropout more than noise does. Frames tell these errors where the motion
shows them; where it does not, the prior holds them at zero. They are constant, so they need not be states of
the filter: how its innovations depend on them is carried along beside it, and one weighted least squares over
the run gives them as the states would (B. Friedland, Treatment of bias in recursive filtering, IEEE Trans.
Automatic Control 14, 1969). What stays unsure of them makes the motion unsure by the same derivatives,
carried back as the smoother's are.
"""

from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.rotations import skew
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.smoothing.camera_errors import CameraErrors, CameraWay, camera_prior_sd
from bricktrack_host.fusion.smoothing.sensor_errors_kernel import carry_back, carry_forward
from bricktrack_host.fusion.smoothing.smoother import (
    BG,
    POS,
    SKEW,
    TAU,
    Estimate,
    Filter,
    Problem,
    State,
    residuals_of,
)

N_ERRORS = 21
_GAINS, _ARM = slice(0, 18), slice(18, N_ERRORS)


@dataclass(frozen=True, slots=True, eq=False)
class SensorErrors:
    """What of a sensor's signals is error in proportion, and how far it lies from where it should be.

    Attributes
    ----------
    gyro, acc : ndarray, shape (3, 3)
        Sample = (1 + this) @ truth, to first order.
    arm_m : ndarray, shape (3,), brick axes
        True lever arm less the one given.
    covariance : ndarray, shape (21, 21), or (44, 44) where the camera moves
        Of gyro and acc, row by row, and arm_m; and of the camera's sensor, see `CameraErrors.values`.
    camera : CameraErrors or None
        Of the sensor that moves with the camera.
    """

    gyro: FloatArray
    acc: FloatArray
    arm_m: FloatArray
    covariance: FloatArray
    camera: CameraErrors | None = None


def sensor_prior_sd(settings: FusionSettings) -> FloatArray:
    """Return what is believed of the errors' sizes before a run speaks, shape (21,)."""
    return np.repeat([settings.sensor_gain_sd, settings.lever_arm_sd_mm * 1e-3], [18, 3])


@dataclass(frozen=True, slots=True, eq=False)
class _Way:
    """One run's way forwards: frames at nodes ``at``, and how errors change what is predicted.

    Attitude R, rows of the covariance, and derivatives of the states wanted, ``changed``, are of all nodes.
    """

    at: IntArray
    R: FloatArray
    rows: FloatArray
    y: FloatArray
    H: FloatArray
    S: FloatArray
    gain: FloatArray
    changed: FloatArray
    dy: FloatArray


def _way(problem: Problem, passed: Filter, b: int, *, of: IntArray, camera: CameraWay | None = None) -> _Way:
    at = np.flatnonzero(problem.has_frame[:, b])
    before = passed.predicted(at, b, of=of)
    R, x = before.R[at], before.x
    y, H = residuals_of(problem, State(R, x), at, b)
    HP = H @ before.P
    S = HP @ np.swapaxes(H, 1, 2) + problem.cov_seen[at, b] * passed.inflation[at, b][:, None, None]
    gain = np.ascontiguousarray(np.swapaxes(np.linalg.solve(S, HP), 1, 2))
    # The frame's own part: what it says of the origin depends on the arm to the sensor.
    since_mid = problem.since_mid_s[at, b]
    ahead = (x[:, TAU] - problem.tau_lin[b]) + since_mid * (x[:, SKEW] - problem.skew_lin[b])
    own = np.zeros((len(at), 6, N_ERRORS))
    turn = problem.omega_radps[at, b] - x[:, BG]
    own[:, 3:, _ARM] = R + R @ skew(turn) * ahead[:, None, None]
    further = np.zeros((len(problem.dt_s), 3, 0))
    if camera is not None:
        theirs = camera.of_seen(R, problem.p_seen_m[at, b], camera.t_s[at])
        own = np.concatenate([own, theirs], axis=2)
        further = np.ascontiguousarray(camera.velocity)
    H = np.ascontiguousarray(H)
    changed, dy = carry_forward(passed.runs[b], at, before.R, H, gain, own, further, of)
    return _Way(at, before.R, before.rows, y, H, S, gain, changed, dy)


def estimate_sensor_errors(
    problem: Problem,
    passed: Filter,
    b: int,
    settings: FusionSettings,
    *,
    R_still_camera: FloatArray | None = None,
) -> SensorErrors | None:
    """Return the errors that make the innovations of a forward pass least, or None where none are believed.

    Parameters
    ----------
    problem, passed : Problem, Filter
        Of frames.
    b : int
        The run's place in the batch.
    R_still_camera : ndarray, shape (K, 3, 3), optional
        Attitudes of a moving camera at the run's nodes.
    """
    camera = None if R_still_camera is None else CameraWay.of(problem, R_still_camera, b)
    prior_sd = sensor_prior_sd(settings)
    if camera is not None:
        prior_sd = np.append(prior_sd, camera_prior_sd(settings))
    believed = prior_sd > 0
    if not believed.any() or not problem.has_frame[:, b].any():
        return None
    way = _way(problem, passed, b, of=np.zeros(0, dtype=np.int64), camera=camera)
    dy = way.dy[..., believed]
    weighted = np.linalg.solve(way.S, dy)
    normal = np.einsum("nij,nik->jk", dy, weighted) + np.diag(prior_sd[believed] ** -2)
    errors, covariance = np.zeros(len(prior_sd)), np.zeros((len(prior_sd), len(prior_sd)))
    covariance[np.ix_(believed, believed)] = np.linalg.inv(normal)
    errors[believed] = -np.linalg.solve(normal, np.einsum("nij,ni->j", weighted, way.y))
    gyro, acc = errors[_GAINS].reshape(2, 3, 3)
    found = SensorErrors(gyro, acc, errors[_ARM], covariance)
    if camera is None:
        return found
    return replace(found, camera=CameraErrors.of(errors[N_ERRORS:]))


def with_sensor_doubt(
    problem: Problem,
    passed: Filter,
    estimate: Estimate,
    sensor_covariance: list[FloatArray],
    *,
    R_still_camera: list[FloatArray | None] | None = None,
) -> Estimate:
    """Return smoothed states with what the errors of the sensors leave unsure added to their covariance.

    ``sensor_covariance``: of each run of the batch, shape (21, 21), or (44, 44) where the camera moves; zero
    where all is known. ``R_still_camera``: as `estimate_sensor_errors`, of each run whose camera moves.
    """
    covariance, variance = estimate.covariance.copy(), estimate.variance.copy()
    doubt = np.zeros((*covariance.shape[:3], max(len(unsure) for unsure in sensor_covariance)))
    for b, unsure in enumerate(sensor_covariance):
        if not unsure.any():
            continue
        still = None if R_still_camera is None else R_still_camera[b]
        camera = None if still is None else CameraWay.of(problem, still, b)
        way = _way(problem, passed, b, of=estimate.of, camera=camera)
        weighted = np.linalg.solve(way.S, way.dy)
        changed = way.changed
        carry_back(passed.runs[b], way.at, way.R, way.H, way.gain, weighted, way.rows, changed)
        # The origin is known as well as before: what an error of the arm moves is the point of the IMU.
        at_arm = np.arange(_ARM.start, _ARM.stop)
        changed[:, np.searchsorted(estimate.of, np.arange(POS.start, POS.stop))[:, None], at_arm] -= way.R
        if camera is not None:
            changed[:, :, N_ERRORS:] += camera.of_output(
                estimate.state.R[:, b], estimate.state.x[:, b, POS], estimate.of
            )
        of_run = changed @ root_of(unsure)
        doubt[:, b, :, : len(unsure)] = of_run
        more = of_run @ np.swapaxes(of_run, 1, 2)
        covariance[:, b] += more
        variance[:, b, estimate.of] += np.diagonal(more, axis1=1, axis2=2)
    return replace(estimate, covariance=covariance, variance=variance, doubt=doubt)


def root_of(covariance: FloatArray) -> FloatArray:
    """Return A with A A^T = covariance, which may lack rank; shape (q, q)."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
