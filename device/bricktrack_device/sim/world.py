"""The world that every simulated sensor asks: where the brick is, what hides it, when the wave rises.

It is a deterministic function of its settings and of CLOCK_MONOTONIC; only the instant of the first edge is
shared between processes, because arming decides it.
"""

import math
import multiprocessing
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel, brick_model_from_file, load_brick_model
from bricktrack_common.errors import ConfigError
from bricktrack_common.rotations import matrix_from_rvec
from bricktrack_device.sim.motions import make_camera_motion, make_motion
from bricktrack_device.sim.paper_layout import PAPER_LAYOUT
from bricktrack_device.sim.settings import SimSettings

_REST_DEPTH_MM = 134.0  # of the middle of the LEDs' box
_REST_RVEC_RAD = np.array([-0.0227, 0.0140, -0.0122])
_GRAVITY_CAMERA_MPS2 = matrix_from_rvec(np.array([0.0364, 0.0, 0.0279])) @ np.array([0.0, 9.80665, 0.0])
CARD_SLIDE_S = 0.06

Epoch = Synchronized  # of an int64: the first edge, ns; 0 until the unit is armed


def make_epoch() -> "Epoch[int]":
    """Return the shared instant of the first edge, not yet set; a spawned process takes it as an argument."""
    epoch: Epoch[int] = multiprocessing.get_context("spawn").Value("q", 0)
    return epoch


@dataclass(frozen=True, slots=True, eq=False)
class Inertial:
    """What ideal inertial sensors feel, in their own axes.

    Attributes
    ----------
    specific_force_mps2, omega_radps : ndarray, shape (n, 3)
    R_still_imu : ndarray, shape (n, 3, 3)
        To the axes of the camera at rest.
    """

    specific_force_mps2: FloatArray
    omega_radps: FloatArray
    R_still_imu: FloatArray


class SimWorld:
    """The brick's motion and the table's square wave.

    Parameters
    ----------
    settings : SimSettings
    epoch : Epoch
        Shared between the camera's, the sampler's and the trigger's views of the world.
    """

    def __init__(self, settings: SimSettings, epoch: "Epoch[int]") -> None:
        self.settings = settings
        self.brick = load_layout(settings)
        self._epoch = epoch
        self._motion = make_motion(settings)
        self._camera_motion = make_camera_motion(settings)
        self._camera_moves = settings.camera_acc_g > 0 or settings.camera_rocking_deg > 0
        self._R_rest = matrix_from_rvec(_REST_RVEC_RAD)
        imu = self.brick.imu_lever_arm_mm, self.brick.R_brick_imu
        self._lever_arm_mm = np.zeros(3) if imu[0] is None else imu[0]
        self._R_brick_imu = np.eye(3) if imu[1] is None else imu[1]
        middle_mm = 0.5 * (self.brick.led_positions_mm.max(axis=0) + self.brick.led_positions_mm.min(axis=0))
        self._t_rest_mm = np.array([0.0, 0.0, _REST_DEPTH_MM]) - self._R_rest @ middle_mm
        unknown = {h.name for h in settings.hidden_leds} - set(self.brick.led_names)
        if unknown:
            raise ConfigError(
                f"sim.hidden_leds: name: no LED {min(unknown)!r} in this layout; "
                f"expected one of: {', '.join(self.brick.led_names)}"
            )

    @property
    def rest_pose(self) -> tuple[FloatArray, FloatArray]:
        """``R_camera_brick`` (3, 3) and ``t_camera_brick_mm`` (3,) before the shake."""
        return self._R_rest.copy(), self._t_rest_mm.copy()

    @property
    def first_edge_ns(self) -> int | None:
        """The instant of the first rising edge, CLOCK_MONOTONIC; `None` until the unit was armed."""
        return int(self._epoch.value) or None

    def schedule(self, t_armed_ns: int) -> int:
        """Set the first edge after arming, and return it."""
        first = t_armed_ns + round(self.settings.shake_delay_s * 1e9)
        self._epoch.value = first
        return first

    def since_first_edge_s(self, t_ns: IntArray) -> FloatArray:
        """Return seconds after the first edge; minus infinity while there is none."""
        first = self.first_edge_ns
        if first is None:
            return np.full(np.shape(t_ns), -np.inf)
        return np.asarray((np.asarray(t_ns, dtype=np.int64) - first) * 1e-9)

    def _coordinates(self, since_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        t = np.where(np.isfinite(since_s), since_s, -1.0) - self.settings.quiet_s
        return self._motion(np.asarray(t, dtype=np.float64))

    def pose(self, t_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return ``R_camera_brick`` (n, 3, 3) and ``t_camera_brick_mm`` (n, 3) at instants (n,)."""
        q, _, _ = self._coordinates(self.since_first_edge_s(t_ns))
        return self._R_rest @ matrix_from_rvec(q[:, 3:]), self._t_rest_mm + q[:, :3]

    def twist(self, t_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the angular rate in brick axes, rad/s, and the origin's velocity in camera axes, mm/s."""
        q, dq, _ = self._coordinates(self.since_first_edge_s(t_ns))
        return angular_rate_and_acceleration(q[:, 3:], dq[:, 3:], np.zeros_like(dq[:, 3:]))[0], dq[:, :3]

    def inertial(self, since_s: FloatArray) -> Inertial:
        """Return what ideal sensors at the lever arm feel at times (n,) after the first edge, s."""
        q, dq, ddq = self._coordinates(since_s)
        omega, alpha = angular_rate_and_acceleration(q[:, 3:], dq[:, 3:], ddq[:, 3:])
        R = self._R_rest @ matrix_from_rvec(q[:, 3:])
        arm_m = self._lever_arm_mm * 1e-3
        arm = np.broadcast_to(arm_m, omega.shape)
        turned = [
            np.einsum("nij,nj->ni", R, v)
            for v in (arm, _cross(omega, arm_m), _cross(alpha, arm_m) + _cross(omega, _cross(omega, arm_m)))
        ]
        at_rest_m = 1e-3 * np.stack([self._t_rest_mm + q[:, :3], dq[:, :3], ddq[:, :3]])
        camera = self._on_camera(since_s, *(at_rest_m + np.stack(turned)))
        force = np.einsum("nji,nj->ni", R, camera.specific_force_mps2)
        omega = omega + np.einsum("nji,nj->ni", R, camera.omega_radps)
        return Inertial(
            force @ self._R_brick_imu, omega @ self._R_brick_imu, camera.R_still_imu @ R @ self._R_brick_imu
        )

    def camera_inertial(self, since_s: FloatArray, *, at_mm: FloatArray) -> Inertial:
        """Return what ideal sensors fixed to the camera feel at a point of its axes, mm; see `inertial`."""
        still = np.zeros((len(since_s), 3))
        return self._on_camera(since_s, still + 1e-3 * at_mm, still, still)

    def _on_camera(
        self, since_s: FloatArray, p_m: FloatArray, v_mps: FloatArray, a_mps2: FloatArray
    ) -> Inertial:
        """Return what a body in the camera's axes feels that moves at p, v, a in them; axes the camera's."""
        n = len(since_s)
        if not self._camera_moves:
            return Inertial(a_mps2 - _GRAVITY_CAMERA_MPS2, np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)))
        t = np.where(np.isfinite(since_s), since_s, -1.0) - self.settings.quiet_s
        q, dq, ddq = self._camera_motion(np.asarray(t, dtype=np.float64))
        omega, alpha = angular_rate_and_acceleration(q[:, 3:], dq[:, 3:], ddq[:, 3:])
        R = matrix_from_rvec(q[:, 3:])
        own = np.einsum("nji,nj->ni", R, 1e-3 * ddq[:, :3] - _GRAVITY_CAMERA_MPS2)
        swing = _cross(alpha, p_m) + _cross(omega, _cross(omega, p_m)) + 2 * _cross(omega, v_mps)
        return Inertial(own + swing + a_mps2, omega, R)

    def card_cover(self, t_ns: IntArray) -> FloatArray:
        """Return how far the opaque card has slid before the lens: 0 away, 1 hides everything.

        It hides everything from a dropout's start to its end, and slides in and out in `CARD_SLIDE_S`
        around it.
        """
        s = self.since_first_edge_s(t_ns)
        cover = np.zeros(np.shape(s))
        for start, duration in self.settings.dropouts:
            beyond = np.maximum(start - s, s - (start + duration))
            cover = np.maximum(cover, np.clip(1 - beyond / CARD_SLIDE_S, 0, 1))
        return np.asarray(cover)

    def leds_hidden(self, t_ns: IntArray) -> BoolArray:
        """Tell for instants (n,) and each LED, shape (n, n_leds), whether something stands before it."""
        s = self.since_first_edge_s(t_ns)
        hidden = np.zeros((len(s), self.brick.n_leds), dtype=np.bool_)
        for h in self.settings.hidden_leds:
            hidden[:, self.brick.led_names.index(h.name)] |= (s >= h.start_s) & (s < h.start_s + h.duration_s)
        return hidden

    def edge_times_ns(self, first: int, last: int) -> IntArray:
        """Return the true instants of the rising edges ``first`` to ``last`` - 1 on the unit's clock."""
        start = self.first_edge_ns
        if start is None:
            return np.empty(0, dtype=np.int64)
        period_ns = 1e9 / self.settings.square_wave_hz * (1 + self.settings.clock_ppm * 1e-6)
        return np.asarray(start + np.rint(np.arange(first, last) * period_ns).astype(np.int64))

    @property
    def gravity_camera_mps2(self) -> FloatArray:
        """Gravity in camera axes; about along +y, down in the picture."""
        return np.asarray(_GRAVITY_CAMERA_MPS2.copy())


def load_layout(settings: SimSettings) -> BrickModel:
    """Return the layout of the simulated brick."""
    if settings.layout:
        return load_brick_model(Path(settings.layout))
    return brick_model_from_file(PAPER_LAYOUT, where="the simulated brick")


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the cross product along the last axis; for a few hundred `numpy.cross` takes far longer."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)


def angular_rate_and_acceleration(
    rvec_rad: FloatArray, rate: FloatArray, second: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return body rate and acceleration, shape (n, 3), of a rotation vector with these two derivatives.

    With ``omega = r' - a r x r' + b r x (r x r')``, ``a = (1 - cos s) / s^2``, ``b = (s - sin s) / s^3``; the
    derivatives of a and b by s^2 are taken from their series, which converge for every angle.
    """
    s2 = np.sum(rvec_rad * rvec_rad, axis=-1, keepdims=True)
    ds2 = 2 * np.sum(rvec_rad * rate, axis=-1, keepdims=True)
    (a, da), (b, db) = (_series(s2, first) for first in (2, 3))
    cross = _cross(rvec_rad, rate)
    twice = _cross(rvec_rad, cross)
    cross_rate = _cross(rvec_rad, second)
    twice_rate = _cross(rate, cross) + _cross(rvec_rad, cross_rate)
    omega = rate - a * cross + b * twice
    alpha = second - a * cross_rate - da * ds2 * cross + b * twice_rate + db * ds2 * twice
    return np.asarray(omega), np.asarray(alpha)


def _series(s2: FloatArray, first: int) -> tuple[FloatArray, FloatArray]:
    """Return sum of (-s2)^k / (2 k + first)! and its derivative by s2."""
    coefficients = [(-1) ** k / math.factorial(2 * k + first) for k in range(14)]
    slopes = [k * c for k, c in enumerate(coefficients)][1:]
    return np.polynomial.polynomial.polyval(s2, coefficients), np.polynomial.polynomial.polyval(s2, slopes)
