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

from bricktrack_common.arrays import FloatArray
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.smoothing.camera_errors import (
    N_CAMERA_ERRORS,
    CameraErrors,
    CameraWay,
    camera_prior_sd,
)
from bricktrack_host.fusion.smoothing.smoother import Estimate, Filter, Problem
from bricktrack_host.fusion.smoothing.standing_doubt import ARM, Doubt, ErrorWay, root_of
from bricktrack_host.fusion.smoothing.standing_errors_kernel import N_GAINS, Sight

N_ERRORS = ARM.stop


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
    gyro_loss_s2 : float
        What the gyro's low-pass takes from the second derivative, over what it was believed to.
    """

    gyro: FloatArray
    acc: FloatArray
    arm_m: FloatArray
    covariance: FloatArray
    camera: CameraErrors | None = None
    gyro_loss_s2: float = 0.0


def sensor_prior_sd(settings: FusionSettings) -> FloatArray:
    """Return what is believed of the errors' sizes before a run speaks, shape (21,)."""
    return np.repeat([settings.sensor_gain_sd, settings.lever_arm_sd_mm * 1e-3], [18, 3])


def _way(problem: Problem, passed: Filter, b: int, R_still_camera: FloatArray | None) -> ErrorWay:
    """Return the run's way over its frames; what these say of the origin depends on the arm to the sensor."""
    camera = None if R_still_camera is None else CameraWay.of(problem, R_still_camera, b)
    has_frame = problem.has_frame[:, b]
    at = np.flatnonzero(has_frame)
    arm, last = np.zeros((len(at), 6, 3)), np.zeros((len(at), 6, 0))
    arm[:, 3:] = R = problem.R_seen[at, b]
    if camera is not None:
        last = camera.of_seen(R, problem.p_seen_m[at, b], camera.t_s[at])
    sight = Sight(
        first=np.append(0, np.cumsum(has_frame, dtype=np.int64)),
        use=np.ones(len(at), dtype=np.bool_),
        shared=arm, by_view=np.zeros((len(at), 0)), led=np.zeros(len(at), dtype=np.int64), n_leds=0,
        last=last,
    )  # fmt: skip
    return ErrorWay.of(passed, b, sight, camera)


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
    prior_sd = sensor_prior_sd(settings)
    if R_still_camera is not None:
        prior_sd = np.append(prior_sd, camera_prior_sd(settings))
    believed = prior_sd > 0
    if not believed.any() or not problem.has_frame[:, b].any():
        return None
    way, part = _way(problem, passed, b, R_still_camera), np.ix_(believed, believed)
    normal = way.normal[part] + np.diag(prior_sd[believed] ** -2)
    errors, covariance = np.zeros(len(prior_sd)), np.zeros((len(prior_sd), len(prior_sd)))
    covariance[part] = np.linalg.inv(normal)
    errors[believed] = -np.linalg.solve(normal, way.pull[believed])
    gyro, acc = errors[:N_GAINS].reshape(2, 3, 3)
    found = SensorErrors(gyro, acc, errors[ARM], covariance)
    if R_still_camera is None:
        return found
    return replace(found, camera=CameraErrors.of(errors[-N_CAMERA_ERRORS:]))


def with_sensor_doubt(
    problem: Problem,
    passed: Filter,
    estimate: Estimate,
    sensor_covariance: list[FloatArray],
    *,
    R_still_camera: list[FloatArray | None] | None = None,
) -> tuple[Estimate, list[Doubt | None]]:
    """Return smoothed states with what the errors of the sensors leave unsure added to their covariance.

    And this doubt of each run, None where all is known.

    ``sensor_covariance``: of each run of the batch, shape (21, 21), or (44, 44) where the camera moves; zero
    where all is known. ``R_still_camera``: as `estimate_sensor_errors`, of each run whose camera moves.
    """
    doubts: list[Doubt | None] = [None] * len(sensor_covariance)
    for b, unsure in enumerate(sensor_covariance):
        if unsure.any():
            still = None if R_still_camera is None else R_still_camera[b]
            doubts[b] = doubt = Doubt(_way(problem, passed, b, still), root_of(unsure), estimate.of)
            estimate = doubt.added_to(estimate, b)
    return estimate, doubts
