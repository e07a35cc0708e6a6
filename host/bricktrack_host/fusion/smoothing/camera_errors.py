"""Errors of the sensor at a moving camera that stand still, and how the relative motion depends on them.

They are those of any inertial sensor (`sensor_errors`), scale, crossed axes and place; and its clock's, delay
and rate against the brick's. Its gyro makes the axes that stand still (`pose_by_pose.moving_camera`), so an
error of its gain turns these by what that error makes of the camera's rocking, and with them all that is seen
and the force felt. Its accelerometer's errors act on the velocity. Its place acts on what is seen alone. Its
delay turns the axes by the camera's rate, and takes the force from another instant.
"""

from dataclasses import dataclass, field

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.rotations import skew
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.smoothing.smoother import ATT, POS, Problem

N_CAMERA_ERRORS = 23
GYRO, ACC, ARM, DELAY, RATE = slice(0, 9), slice(9, 18), slice(18, 21), 21, 22


@dataclass(frozen=True, slots=True, eq=False)
class CameraErrors:
    """What of the camera's sensor is error in proportion, and how far off its place and its clock are.

    Attributes
    ----------
    gyro, acc : ndarray, shape (3, 3)
        Sample = (1 + this) @ truth, to first order.
    arm_m : ndarray, shape (3,), camera axes
        True way from the sensor to the projection centre less the one given.
    delay_s, delay_rate : float
        By how much it stamps later than the brick's sensor in the run's middle, and how fast that grows, less
        what was believed.
    """

    gyro: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    acc: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    arm_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    delay_s: float = 0.0
    delay_rate: float = 0.0

    @classmethod
    def of(cls, values: FloatArray) -> "CameraErrors":
        """Return them from one vector, shape (23,): gyro and acc, row by row, arm, delay and its rate."""
        gyro, acc = values[GYRO].reshape(3, 3), values[ACC].reshape(3, 3)
        return cls(gyro, acc, values[ARM].copy(), float(values[DELAY]), float(values[RATE]))

    def values(self) -> FloatArray:
        """Return them as one vector, shape (23,)."""
        clock = [self.delay_s, self.delay_rate]
        return np.concatenate([self.gyro.ravel(), self.acc.ravel(), self.arm_m, clock])


def camera_prior_sd(settings: FusionSettings) -> FloatArray:
    """Return what is believed of their sizes before a run speaks, shape (23,)."""
    clock = [settings.camera_delay_sd_ns * 1e-9, settings.camera_delay_rate_sd]
    return np.append(np.repeat([settings.sensor_gain_sd, settings.lever_arm_sd_mm * 1e-3], [18, 3]), clock)


@dataclass(frozen=True, slots=True, eq=False)
class CameraWay:
    """How taking such errors out changes one run: K nodes, the last axis by `CameraErrors.values`.

    Attributes
    ----------
    t_s : ndarray, shape (K,)
        After the first node.
    R_still_camera : ndarray, shape (K, 3, 3)
    turned : ndarray, shape (K, 3, 23)
        By how much the errors have turned the still axes, in still axes, rad.
    velocity : ndarray, shape (K - 1, 3, 23), m/s
        Change in each step.
    """

    t_s: FloatArray
    R_still_camera: FloatArray
    turned: FloatArray
    velocity: FloatArray

    @classmethod
    def of(cls, problem: Problem, R_still_camera: FloatArray, b: int) -> "CameraWay":
        """Return it for run ``b`` of a batch, from the camera's attitudes at the run's own nodes."""
        dt = problem.dt_s[:, b]
        R = np.broadcast_to(np.eye(3), (len(dt) + 1, 3, 3)).copy()
        R[: len(R_still_camera)] = R_still_camera
        still = problem.camera_omega_radps[:, b]
        omega = np.einsum("kji,kj->ki", R, still)
        rate = np.einsum("kri,km->krim", R, omega).reshape(-1, 3, 9)
        turned = np.zeros((len(R), 3, N_CAMERA_ERRORS))
        turned[1:, :, GYRO] = np.cumsum(0.5 * dt[:, None, None] * (rate[1:] + rate[:-1]), axis=0)
        since_mid = problem.since_mid_s[:, b, None]
        turned[..., DELAY], turned[..., RATE] = -still, -still * since_mid
        felt = problem.known[:, b, 0]  # minus the force's integral
        middle = 0.5 * (R[1:] + R[:-1])
        in_camera = np.einsum("kji,kj->ki", middle, felt)
        velocity = skew(felt) @ (0.5 * (turned[1:] + turned[:-1]))
        velocity[..., ACC] = -np.einsum("kri,km->krim", middle, in_camera).reshape(-1, 3, 9)
        n_steps = len(R_still_camera) - 1  # those of other runs of a batch are more
        force = felt / np.where(dt > 0, dt, 1.0)[:, None]
        force[n_steps:] = force[n_steps - 1]
        velocity[..., DELAY] = _over_step(force)
        velocity[..., RATE] = velocity[..., DELAY] * 0.5 * (since_mid[1:] + since_mid[:-1])
        return cls(np.concatenate([[0.0], np.cumsum(dt)]), R, turned, velocity)

    def at(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the camera's attitudes and ``turned`` at instants after the first node."""
        k = np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, len(self.t_s) - 2)
        step = self.t_s[k + 1] - self.t_s[k]
        share = np.divide(t_s - self.t_s[k], step, out=np.zeros(len(k)), where=step > 0)[:, None, None]
        R, turned = (
            (1 - share) * values[k] + share * values[k + 1] for values in (self.R_still_camera, self.turned)
        )
        return R, turned

    def of_seen(self, R_still_brick: FloatArray, p_still_m: FloatArray, t_s: FloatArray) -> FloatArray:
        """Return by how much taking them out moves poses seen at instants, shape (n, 6, 23)."""
        R_still_camera, turned = self.at(t_s)
        own = np.empty((len(t_s), 6, N_CAMERA_ERRORS))
        own[:, :3] = -np.swapaxes(R_still_brick, 1, 2) @ turned
        own[:, 3:] = skew(p_still_m) @ turned
        own[:, 3:, ARM] = R_still_camera
        return own

    def of_output(
        self, R_still_brick: FloatArray, p_still_m: FloatArray, of: IntArray, t_s: FloatArray
    ) -> FloatArray:
        """Return what they change between the states ``of`` and the motion as the camera sees it, (n, c, 23).

        At instants after the first node, shape (n,). The camera is turned and shifted in the still axes; the
        states are told in these.
        """
        out = np.zeros((len(R_still_brick), len(of), N_CAMERA_ERRORS))
        seen = self.of_seen(R_still_brick, p_still_m, t_s)
        turn, place = (np.searchsorted(of, np.arange(part.start, part.stop)) for part in (ATT, POS))
        out[:, turn], out[:, place] = -seen[:, :3], -seen[:, 3:]
        return out


def _over_step(force: FloatArray) -> FloatArray:
    """Return by how much a force changes over each step, from its means over the steps, shape (K - 1, 3)."""
    at_nodes = np.concatenate([force[:1], 0.5 * (force[1:] + force[:-1]), force[-1:]])
    return np.diff(at_nodes, axis=0)
