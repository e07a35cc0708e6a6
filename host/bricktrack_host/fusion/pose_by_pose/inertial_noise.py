"""How far inertial samples are to be trusted over a step: spectral densities of their errors, by cause."""

from dataclasses import dataclass, fields, replace

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.fusion.inertial.step_means_kernel import step_means
from bricktrack_host.fusion.pose_by_pose.moving_camera import CameraMotion
from bricktrack_host.fusion.smoothing.linearisation import Linearisation

_ONE_MISSING = 2.5  # periods between samples above which more than one is missing
_NOISE_POINTS = 4  # of a step, over which its noise is averaged


@dataclass(frozen=True, slots=True, eq=False)
class NoiseParts:
    """Spectral densities of inertial errors at instants, by cause; shape (n,), rad^2/s and m^2/s^3.

    Attributes
    ----------
    gyro_fixed, acc_fixed
        White noise of the samples, clipping, a sample bridged, and gaps: what their fill is off by, or
        without one the whole spread of the signal.
    gyro_rough, acc_rough
        Steady roughness beyond the sensor's own noise, at a share of 1.
    gyro_systematic, acc_systematic
        Scale and lever-arm errors in proportion to the motion, which keep their sign for a while; those of a
        vibration do not, and are left out.
    gyro_impact, acc_impact
        Pulses, at the share that is stated.
    """

    gyro_fixed: FloatArray
    gyro_rough: FloatArray
    gyro_systematic: FloatArray
    acc_fixed: FloatArray
    acc_rough: FloatArray
    acc_systematic: FloatArray
    gyro_impact: FloatArray
    acc_impact: FloatArray

    def __add__(self, other: "NoiseParts") -> "NoiseParts":
        """Return the densities of two sensors together."""
        return NoiseParts(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

    def gyro(self, level: "NoiseLevel") -> FloatArray:
        """Return the whole density for one level."""
        return np.asarray(
            self.gyro_fixed
            + level.roughness**2 * self.gyro_rough
            + level.systematic**2 * self.gyro_systematic
            + level.impact**2 * self.gyro_impact
        )

    def acc(self, level: "NoiseLevel") -> FloatArray:
        """Return the whole density for one level."""
        return np.asarray(
            self.acc_fixed
            + level.roughness**2 * self.acc_rough
            + level.systematic**2 * self.acc_systematic
            + level.impact**2 * self.acc_impact
        )


@dataclass(frozen=True, slots=True)
class NoiseLevel:
    """How much of the roughness, and how many times the stated error of the rest, is believed to be error."""

    roughness: float
    systematic: float
    impact: float = 1.0


def noise_parts(
    signal: ImuSignal, t_s: FloatArray, lin: Linearisation, settings: FusionSettings
) -> NoiseParts:
    """Return how far the inertial signal is to be trusted over the steps between instants of IMU time."""
    s, period, hold = settings, signal.period_s, settings.systematic_time_s
    size = np.linalg.norm(signal.slow_gyro_radps - lin.bg_radps, axis=1)
    turn, moving = signal.gyro_change_radps2, signal.force_change_mps2
    arm_m = s.lever_arm_sd_mm * 1e-3

    share = (np.arange(_NOISE_POINTS) + 0.5) / _NOISE_POINTS
    points = t_s[:-1].ravel()[:, None] + np.diff(t_s, axis=0).ravel()[:, None] * share

    fill = signal.samples.fill
    filled = np.zeros(points.shape, dtype=np.bool_) if fill is None else fill.covers(points)
    fill_gyro, fill_acc = (0.0, 0.0) if fill is None else (fill.gyro_density, fill.acc_density)

    gap = hold * (signal.in_gap(points, least_periods=_ONE_MISSING) & ~filled).mean(axis=1)
    bridged = period * (signal.in_gap(points) & ~filled).mean(axis=1)
    gyro_impact, acc_impact = signal.gyro_impact_radps, signal.acc_impact_mps2
    shove = np.maximum(acc_impact, s.impact_arm_mm * 1e-3 / period * gyro_impact)
    gyro_fixed = np.full(len(size), s.gyro_noise_radps**2)
    acc_fixed = s.acc_noise_mps2**2 + signal.clip_sd_mps2**2
    t_sd_s = signal.samples.t_sd_s
    if t_sd_s is not None:  # a sample that may belong to another slot
        gyro_fixed = gyro_fixed + (_steepness(signal.gyro_radps, signal.t_s) * t_sd_s) ** 2
        acc_fixed = acc_fixed + (_steepness(signal.acc_mps2, signal.t_s) * t_sd_s) ** 2
    gyro_rough = np.maximum(signal.gyro_roughness_radps**2 - s.gyro_noise_radps**2, 0.0)
    acc_rough = np.maximum(signal.acc_roughness_mps2**2 - s.acc_noise_mps2**2, 0.0)
    acc_systematic = (s.acc_scale_sd * moving) ** 2 + (arm_m * (turn + size**2)) ** 2
    gyro_parts = (
        gyro_fixed * period, gyro_rough * period, (s.gyro_scale_sd * size) ** 2 * hold,
        (s.gyro_impact_share * gyro_impact) ** 2 * period, signal.gyro_bridge_radps,
    )  # fmt: skip
    acc_parts = (
        acc_fixed * period, acc_rough * period, acc_systematic * hold,
        (s.acc_impact_share * shove) ** 2 * period, signal.acc_bridge_mps2,
    )  # fmt: skip
    # Over a step, but for what of it is filled: there no sample tells.
    gyro = step_means(signal.t_s, np.stack(gyro_parts, axis=1), points, ~filled)
    acc = step_means(signal.t_s, np.stack(acc_parts, axis=1), points + lin.lag_s, ~filled)
    return NoiseParts(
        gyro_fixed=gyro[:, 0]
        + bridged * gyro[:, 4] ** 2
        + gap * (float(np.sqrt(np.mean(size**2))) + 0.05) ** 2
        + filled.mean(axis=1) * fill_gyro,
        gyro_rough=gyro[:, 1],
        gyro_systematic=gyro[:, 2],
        acc_fixed=acc[:, 0]
        + bridged * acc[:, 4] ** 2
        + gap * (float(np.sqrt(np.mean(moving**2))) + 0.5) ** 2
        + filled.mean(axis=1) * fill_acc,
        acc_rough=acc[:, 1],
        acc_systematic=acc[:, 2],
        gyro_impact=gyro[:, 3],
        acc_impact=acc[:, 3],
    )


def _steepness(values: FloatArray, t_s: FloatArray) -> FloatArray:
    """Return how fast samples change, of the axis where it is most, shape (n,)."""
    return np.asarray(np.abs(np.gradient(values, t_s, axis=0)).max(axis=1))


def camera_noise(
    camera: CameraMotion, t_s: FloatArray, lin: Linearisation, settings: FusionSettings
) -> NoiseParts:
    """Return the noise that the camera's own sensor adds over the steps between instants of IMU time."""
    own = replace(lin, bg_radps=camera.bias_radps, lag_s=camera.acc_lag_s(lin.lag_s))
    return noise_parts(camera.signal, camera.own_s(t_s), own, settings)
