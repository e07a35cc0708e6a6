"""Motions of the simulated brick: six coordinates as functions of time, with exact derivatives.

A motion maps seconds since the shake's start to ``[x, y, z]`` in mm and a rotation vector in rad, and their
first and second derivatives, each of shape (n, 6). Everything is at rest before 0 and after the end, and
twice continuously differentiable, so that the inertial sensor and the camera see one and the same motion.
"""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.errors import ConfigError
from bricktrack_common.imu_records import STANDARD_GRAVITY_MPS2
from bricktrack_device.sim.settings import SimSettings

_RAMP_S = 0.5
_IMPACT_DECAY_S = 0.03
_IMPACT_GONE_S = 0.7  # then exp(-23) is left of a kick: below a nanometre
_IMPACT_ARM_MM = 120.0  # between the point of impact and the brick's middle, roughly

Derivatives = tuple[FloatArray, FloatArray, FloatArray]


class Motion(Protocol):
    """Six coordinates and their two derivatives at times since the shake's start."""

    def __call__(self, t_s: FloatArray) -> Derivatives:
        """Return value, rate and second derivative, each of shape (n, 6), mm and rad."""
        ...


def make_motion(settings: SimSettings) -> Motion:
    """Return the motion that the settings name.

    Raises
    ------
    ConfigError
        If a recorded motion cannot be read.
    """
    if settings.motion == "csv":
        return _read_csv(Path(settings.motion_csv))
    rng = np.random.default_rng([settings.seed, 1])
    scale = np.array([settings.amplitude_mm] * 3 + [np.deg2rad(settings.amplitude_deg)] * 3)
    window = _Window(settings.shake_s, min(_RAMP_S, settings.shake_s / 4))
    if settings.motion == "sweep":
        return _Sweep(window, scale, rng.uniform(0, 2 * np.pi, 6), 2.0, 20.0, settings.shake_s)
    frequencies = rng.uniform(2.0, 20.0, (6, 6))
    # Displacement falls as 1/f^2, as under a flat acceleration spectrum, down to what 2 Hz may take.
    weights = (2.0 / frequencies) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    sines = _Sines(window, scale[:, None] * weights, frequencies, rng.uniform(0, 2 * np.pi, (6, 6)))
    if settings.motion == "sines":
        return sines
    times = np.arange(0.8, settings.shake_s - 1.0, 0.9)
    times = times + rng.uniform(-0.2, 0.2, len(times))
    return _WithImpacts(
        sines, times, rng.uniform(0.001, 0.003, len(times)), _kicks(settings, sines, times, rng)
    )


def make_camera_motion(settings: SimSettings) -> Motion:
    """Return how the camera's component moves, from where it rests, in its axes at rest."""
    rng = np.random.default_rng([settings.seed, 11])
    frequencies = rng.uniform(3.0, 10.0, (6, 6))
    omega = 2 * np.pi * frequencies
    rms = np.full((6, 6), np.sqrt(2 / frequencies.shape[1]))  # of each sine, so that all have an rms of 1
    acceleration_mmps2 = 1e3 * settings.camera_acc_g * STANDARD_GRAVITY_MPS2
    rms[:3] *= acceleration_mmps2 / omega[:3] ** 2
    rms[3:] *= np.deg2rad(settings.camera_rocking_deg)
    window = _Window(settings.shake_s, min(_RAMP_S, settings.shake_s / 4))
    return _Sines(window, rms, frequencies, rng.uniform(0, 2 * np.pi, (6, 6)))


def _kicks(settings: SimSettings, sines: Motion, times: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the changes of velocity at impacts: against the motion of the moment, with some spin."""
    _, rate, _ = sines(times)
    speed = np.linalg.norm(rate[:, :3], axis=1, keepdims=True)
    size_mmps = 1e3 * settings.impact_mps * rng.uniform(0.6, 1.0, (len(times), 1))
    spin = rng.uniform(-1, 1, (len(times), 3)) * size_mmps / _IMPACT_ARM_MM
    return np.concatenate([-rate[:, :3] / np.maximum(speed, 1e-9) * size_mmps, spin], axis=1)


@dataclass(frozen=True, slots=True)
class _Window:
    """One inside (0, end), zero outside, with ramps that have three continuous derivatives."""

    end_s: float
    ramp_s: float

    def __call__(self, t_s: FloatArray) -> Derivatives:
        up = _smooth_step(t_s / self.ramp_s)
        down = _smooth_step((self.end_s - t_s) / self.ramp_s)
        r = 1 / self.ramp_s
        w = up[0] * down[0]
        dw = (up[1] * down[0] - up[0] * down[1]) * r
        ddw = (up[2] * down[0] - 2 * up[1] * down[1] + up[0] * down[2]) * r * r
        return w, dw, ddw


def _smooth_step(x: FloatArray) -> Derivatives:
    """Return the step 35x^4 - 84x^5 + 70x^6 - 20x^7 between 0 and 1, and its derivatives."""
    x = np.clip(x, 0.0, 1.0)
    value = x**4 * (35 - 84 * x + 70 * x**2 - 20 * x**3)
    rate = 140 * x**3 * (1 - x) ** 3
    second = 420 * x**2 * (1 - x) ** 2 * (1 - 2 * x)
    return value, rate, second


def _product(window: Derivatives, inner: Derivatives) -> Derivatives:
    w, dw, ddw = (a[:, None] for a in window)
    q, dq, ddq = inner
    return w * q, dw * q + w * dq, ddw * q + 2 * dw * dq + w * ddq


@dataclass(frozen=True, slots=True, eq=False)
class _Sines:
    window: _Window
    amplitude: FloatArray  # (6, k)
    frequency_hz: FloatArray
    phase_rad: FloatArray

    def __call__(self, t_s: FloatArray) -> Derivatives:
        omega = 2 * np.pi * self.frequency_hz
        angle = t_s[:, None, None] * omega + self.phase_rad
        sin, cos = self.amplitude * np.sin(angle), self.amplitude * np.cos(angle)
        inner = sin.sum(axis=2), (omega * cos).sum(axis=2), -(omega**2 * sin).sum(axis=2)
        return _product(self.window(t_s), inner)


@dataclass(frozen=True, slots=True, eq=False)
class _Sweep:
    """A linear sweep of frequency whose displacement falls with the square of the frequency."""

    window: _Window
    scale: FloatArray
    phase_rad: FloatArray
    first_hz: float
    last_hz: float
    length_s: float

    def __call__(self, t_s: FloatArray) -> Derivatives:
        k = (self.last_hz - self.first_hz) / self.length_s
        t = t_s[:, None]
        f = np.maximum(self.first_hz + k * t, 0.5 * self.first_hz)
        slope = np.where(self.first_hz + k * t > 0.5 * self.first_hz, k, 0.0)
        a = self.scale * (self.first_hz / f) ** 2
        da, dda = -2 * a * slope / f, 6 * a * (slope / f) ** 2
        angle = 2 * np.pi * (self.first_hz * t + 0.5 * k * t * t) + self.phase_rad
        omega = 2 * np.pi * (self.first_hz + k * t)
        sin, cos = np.sin(angle), np.cos(angle)
        rate = da * sin + a * omega * cos
        second = dda * sin + 2 * da * omega * cos + a * (2 * np.pi * k * cos - omega**2 * sin)
        return _product(self.window(t_s), (a * sin, rate, second))


@dataclass(frozen=True, slots=True, eq=False)
class _WithImpacts:
    """Another motion, and impacts: half-sine pulses of acceleration whose kick then dies away.

    An impact adds ``dv P(tau) exp(-tau / T)``, with P the way of a body that a pulse brings to unit speed.
    """

    base: Motion
    t_impact_s: FloatArray  # (k,)
    width_s: FloatArray  # (k,)
    kick: FloatArray  # (k, 6), changes of velocity, mm/s and rad/s

    def __call__(self, t_s: FloatArray) -> Derivatives:
        value, rate, second = self.base(t_s)
        felt = (self.t_impact_s < t_s.max()) & (self.t_impact_s > t_s.min() - _IMPACT_GONE_S)
        for t0, width, kick in zip(self.t_impact_s[felt], self.width_s[felt], self.kick[felt], strict=True):
            rows = np.flatnonzero((t_s > t0) & (t_s < t0 + _IMPACT_GONE_S))
            if rows.size == 0:
                continue
            tau = t_s[rows] - t0
            decay = np.exp(-tau / _IMPACT_DECAY_S)
            fading = decay, -decay / _IMPACT_DECAY_S, decay / _IMPACT_DECAY_S**2
            way = tuple(part[:, None] * kick for part in _half_sine_way(tau, width))
            v, dv, ddv = _product(fading, (way[0], way[1], way[2]))
            value[rows] += v
            rate[rows] += dv
            second[rows] += ddv
        return value, rate, second


def _half_sine_way(tau_s: FloatArray, width_s: float) -> Derivatives:
    """Return way, speed and acceleration of a body that a half-sine pulse brings to unit speed."""
    pulse = np.minimum(tau_s, width_s)
    angle = np.pi * pulse / width_s
    way = pulse / 2 - width_s / (2 * np.pi) * np.sin(angle) + (tau_s - pulse)
    return way, (1 - np.cos(angle)) / 2, np.pi / (2 * width_s) * np.sin(angle)


@dataclass(frozen=True, slots=True, eq=False)
class _Recorded:
    """A recorded motion: a natural cubic spline through its samples, from rest and back to rest."""

    t_s: FloatArray
    q: FloatArray  # (n, 6)
    m: FloatArray  # second derivatives at the samples
    window: _Window

    def __call__(self, t_s: FloatArray) -> Derivatives:
        t = np.clip(t_s, self.t_s[0], self.t_s[-1])
        i = np.clip(np.searchsorted(self.t_s, t, side="right") - 1, 0, len(self.t_s) - 2)
        h = (self.t_s[i + 1] - self.t_s[i])[:, None]
        b = ((t - self.t_s[i])[:, None]) / h
        a = 1 - b
        q0, q1, m0, m1 = self.q[i], self.q[i + 1], self.m[i], self.m[i + 1]
        value = a * q0 + b * q1 + ((a**3 - a) * m0 + (b**3 - b) * m1) * h**2 / 6
        rate = (q1 - q0) / h + ((3 * b**2 - 1) * m1 - (3 * a**2 - 1) * m0) * h / 6
        second = a * m0 + b * m1
        return _product(self.window(t_s), (value, rate, second))


def _read_csv(path: Path) -> Motion:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        t = np.array([float(r["t_s"]) for r in rows])
        columns = ("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg")
        q = np.array([[float(r[c]) if c in r or c.endswith("mm") else 0.0 for c in columns] for r in rows])
    except OSError as e:
        raise ConfigError(f"{path}: sim.motion_csv: {e.strerror or e}") from e
    except (KeyError, TypeError, ValueError) as e:
        raise ConfigError(
            f"{path}: sim.motion_csv: needs numbers in columns t_s, x_mm, y_mm, z_mm: {e}"
        ) from e
    if len(t) < 4 or np.diff(t).min() <= 0 or not np.isfinite(q).all():
        raise ConfigError(
            f"{path}: sim.motion_csv: needs at least 4 rows with increasing t_s and finite values"
        )
    t = t - t[0]
    q = q - q[0]
    q[:, 3:] = np.deg2rad(q[:, 3:])
    length = float(t[-1])
    return _Recorded(t, q, _spline_seconds(t, q), _Window(length, min(0.2, length / 8)))


def _spline_seconds(t: FloatArray, q: FloatArray) -> FloatArray:
    """Return the second derivatives of the natural cubic spline (Thomas' algorithm)."""
    n = len(t)
    h = np.diff(t)
    slope = np.diff(q, axis=0) / h[:, None]
    m = np.zeros_like(q)
    diagonal = 2 * (h[:-1] + h[1:])
    right = 6 * np.diff(slope, axis=0)
    for i in range(1, n - 2):
        f = h[i] / diagonal[i - 1]
        diagonal[i] -= f * h[i]
        right[i] -= f * right[i - 1]
    for i in range(n - 3, -1, -1):
        m[i + 1] = (right[i] - h[i + 1] * m[i + 2]) / diagonal[i]
    return m
