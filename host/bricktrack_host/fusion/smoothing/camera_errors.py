"""Errors of the sensor at a moving camera that stand still, and how the relative motion depends on them.

They are those of any inertial sensor (`sensor_errors`): scale, crossed axes and place. Its gyro makes the
axes that stand still (`pose_by_pose.moving_camera`), so an error of its gain turns these by what that error
makes of the camera's rocking, and with them all poses seen and the force felt. Its accelerometer's errors act
on the velocity. Its place acts on the poses alone.
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.rotations import skew
from bricktrack_host.fusion.smoothing.smoother import ATT, POS, Problem

N_CAMERA_ERRORS = 21
GYRO, ACC, ARM = slice(0, 9), slice(9, 18), slice(18, N_CAMERA_ERRORS)


@dataclass(frozen=True, slots=True, eq=False)
class CameraErrors:
    """What of the camera's sensor is error in proportion, and how far it lies from where it should be.

    Attributes
    ----------
    gyro, acc : ndarray, shape (3, 3)
        Sample = (1 + this) @ truth, to first order.
    arm_m : ndarray, shape (3,), camera axes
        True way from the sensor to the projection centre less the one given.
    """

    gyro: FloatArray
    acc: FloatArray
    arm_m: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class CameraWay:
    """How taking such errors out changes one run: K nodes, errors in the order gyro, acc (row by row), arm.

    Attributes
    ----------
    R_still_camera : ndarray, shape (K, 3, 3)
    turned : ndarray, shape (K, 3, 9)
        By how much the gyro's errors have turned the still axes, in still axes, rad.
    velocity : ndarray, shape (K - 1, 3, 21), m/s
        Change in each step.
    """

    R_still_camera: FloatArray
    turned: FloatArray
    velocity: FloatArray

    @classmethod
    def of(cls, problem: Problem, R_still_camera: FloatArray, b: int) -> "CameraWay":
        """Return it for run ``b`` of a batch, from the camera's attitudes at the run's own nodes."""
        n_steps = len(problem.dt_s)
        R = np.broadcast_to(np.eye(3), (n_steps + 1, 3, 3)).copy()
        R[: len(R_still_camera)] = R_still_camera
        omega = np.einsum("kji,kj->ki", R, problem.camera_omega_radps[:, b])
        rate = np.einsum("kri,km->krim", R, omega).reshape(-1, 3, 9)
        step = 0.5 * problem.dt_s[:, b, None, None] * (rate[1:] + rate[:-1])
        turned = np.concatenate([np.zeros((1, 3, 9)), np.cumsum(step, axis=0)])
        felt = problem.known[:, b, 0]  # minus the force's integral
        middle = 0.5 * (R[1:] + R[:-1])
        in_camera = np.einsum("kji,kj->ki", middle, felt)
        velocity = np.zeros((n_steps, 3, N_CAMERA_ERRORS))
        velocity[..., GYRO] = skew(felt) @ (0.5 * (turned[1:] + turned[:-1]))
        velocity[..., ACC] = -np.einsum("kri,km->krim", middle, in_camera).reshape(-1, 3, 9)
        return cls(R, turned, velocity)

    def of_frames(self, problem: Problem, R_still_brick: FloatArray, at: IntArray, b: int) -> FloatArray:
        """Return what taking them out changes of the frames' innovations by itself, shape (n, 6, 21)."""
        own = np.zeros((len(at), 6, N_CAMERA_ERRORS))
        own[:, :3, GYRO] = -np.swapaxes(R_still_brick, 1, 2) @ self.turned[at]
        own[:, 3:, GYRO] = skew(problem.p_seen_m[at, b]) @ self.turned[at]
        own[:, 3:, ARM] = self.R_still_camera[at]
        return own

    def of_output(self, R_still_brick: FloatArray, p_still_m: FloatArray, of: IntArray) -> FloatArray:
        """Return what they change between the states ``of`` and the motion as the camera sees it, (K, c, 21).

        The camera is turned and shifted in the still axes; the states are told in these.
        """
        out = np.zeros((len(R_still_brick), len(of), N_CAMERA_ERRORS))
        turn, place = (np.searchsorted(of, np.arange(part.start, part.stop)) for part in (ATT, POS))
        out[:, turn, GYRO] = np.swapaxes(R_still_brick, 1, 2) @ self.turned
        out[:, place, GYRO] = -skew(p_still_m) @ self.turned
        out[:, place, ARM] = -self.R_still_camera
        return out
