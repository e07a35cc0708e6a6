"""Simulated brick motion with exact truth, for the tests of alignment and fusion.

Written with splines of its own and scipy's rotations: nothing here comes from the code under test.
"""

from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_simpson
from scipy.interpolate import CubicSpline
from scipy.signal import butter, lfilter
from scipy.spatial.transform import Rotation

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.tracks import ImuTrack, OpticalTrack

EPOCH_NS = 7_000_000_000_000
LEVER_ARM_MM = np.array([26.045, 53.0, 14.199])
GRAVITY_MPS2 = 9.80665
_FINE_HZ = 4000.0


@dataclass(frozen=True, slots=True, eq=False)
class Shake:
    """One simulated run and its truth at 4 kHz."""

    optical: OpticalTrack
    imu: ImuTrack
    t_s: FloatArray
    R: FloatArray
    t_mm: FloatArray
    v_mmps: FloatArray
    omega_radps: FloatArray
    gravity_mps2: FloatArray

    def truth(self, t_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return true rotation and position at camera times (nearest 4 kHz sample plus its velocity)."""
        t = (t_ns - EPOCH_NS) * 1e-9
        i = np.clip(np.round((t - self.t_s[0]) * _FINE_HZ).astype(int), 0, len(self.t_s) - 1)
        d = (t - self.t_s[i])[:, None]
        turn = Rotation.from_rotvec(self.omega_radps[i] * d).as_matrix()
        return self.R[i] @ turn, self.t_mm[i] + self.v_mmps[i] * d


def simulate_shake(
    seed: int,
    *,
    duration_s: float = 8.0,
    offset_s: float = 0.0,
    skew: float = 0.0,
    acc_lag_s: float = 0.0,
    rotation_deg: float = 3.0,
    amplitude_mm: float = 4.0,
    impacts: int = 0,
    impact_mps: float = 0.2,
    dropouts: tuple[tuple[float, float], ...] = (),
    imu_gaps: tuple[tuple[float, float], ...] = (),
    position_sd_mm: float = 0.1,
    rotation_sd_deg: float = 0.1,
    acc_range_g: float = 16.0,
    gyro_bias_radps: tuple[float, float, float] = (0.008, -0.005, 0.011),
    acc_bias_mps2: tuple[float, float, float] = (0.15, -0.2, 0.1),
    frame_rate_hz: float = 30.0058,
    periodic_hz: float | None = None,
    lowpass_hz: float = 60.0,
) -> Shake:
    """Return a brick that rests, shakes and rests; the lag convention is DESIGN 8.2's.

    Acceleration of the IMU point is the second derivative of a band-limited random motion (1.5-8 Hz) plus
    half-sine impacts of 3 ms that change the velocity and are undone by the motion after them.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(-0.6, duration_s + 0.6, 1 / _FINE_HZ)
    window = np.clip((t - 0.8) / 0.5, 0, 1) * np.clip((duration_s - 0.8 - t) / 0.5, 0, 1)
    window = window**3 * (10 - 15 * window + 6 * window**2)

    def wander(rms: float) -> FloatArray:
        if periodic_hz is not None:
            wave = np.sin(2 * np.pi * periodic_hz * t)[:, None] * rng.normal(0, 1, 3)
            return window[:, None] * wave * rms * np.sqrt(2)
        f = rng.uniform(1.5, 8.0, (12, 3))
        a = rng.normal(0, 1, (12, 3)) * (3.0 / f)
        phase = rng.uniform(0, 2 * np.pi, (12, 3))
        s = (a * np.sin(2 * np.pi * f * t[:, None, None] + phase)).sum(axis=1)
        return window[:, None] * s * rms / np.sqrt((s**2).mean(axis=0))

    rest = Rotation.random(rng=rng)
    rvec = np.radians(wander(rotation_deg))
    motion = rest * Rotation.from_rotvec(rvec)
    R = motion.as_matrix()
    # Body rates by the exact rotation between neighbouring fine samples, taken at their middle.
    between = (motion[:-1].inv() * motion[1:]).as_rotvec() * _FINE_HZ
    omega = np.concatenate([between[:1], 0.5 * (between[1:] + between[:-1]), between[-1:]])

    smooth = CubicSpline(t, wander(amplitude_mm) * 1e-3)
    velocity = smooth(t, 1)
    for centre in rng.uniform(1.5, duration_s - 1.8, impacts) if impacts else ():
        jump = rng.normal(0, 1, 3)
        jump *= impact_mps / np.linalg.norm(jump)
        # Up in 3 ms, back over the next 150 ms.
        rise = np.clip((t - centre) / 0.003, 0, 1)
        up = 0.5 - 0.5 * np.cos(np.pi * rise)
        fall = np.clip((t - centre - 0.003) / 0.15, 0, 1)
        down = 1 - fall**3 * (10 - 15 * fall + 6 * fall**2)
        velocity = velocity + (up * down)[:, None] * jump
    p = cumulative_simpson(velocity, x=t, axis=0, initial=0.0) + rng.normal(0, 0.05, 3)
    acceleration = np.gradient(velocity, t, axis=0)
    gravity = rng.normal(0, 1, 3)
    gravity *= GRAVITY_MPS2 / np.linalg.norm(gravity)
    force = np.einsum("nji,nj->ni", R, acceleration - gravity)
    arm = LEVER_ARM_MM * 1e-3
    origin_mm = 1e3 * (p - R @ arm)
    v_mmps = 1e3 * (velocity - np.einsum("nij,nj->ni", R, np.cross(omega, arm)))

    # Optics.
    t_frame = np.arange(rng.uniform(0, 1 / frame_rate_hz), duration_s, 1 / frame_rate_hz)
    i = np.round((t_frame - t[0]) * _FINE_HZ).astype(int)
    t_frame = t[i]
    noise = Rotation.from_rotvec(rng.normal(0, np.radians(rotation_sd_deg), (len(i), 3))).as_matrix()
    R_seen, p_seen = R[i] @ noise, origin_mm[i] + rng.normal(0, position_sd_mm, (len(i), 3))
    for a, b in dropouts:
        R_seen[(t_frame > a) & (t_frame < b)] = np.nan
        p_seen[(t_frame > a) & (t_frame < b)] = np.nan
    sd = np.repeat([np.radians(rotation_sd_deg), position_sd_mm], 3)
    n = len(i)
    optical = OpticalTrack(
        t_ns=EPOCH_NS + np.round(t_frame * 1e9).astype(np.int64),
        R_camera_brick=R_seen,
        t_camera_brick_mm=p_seen,
        covariance=np.broadcast_to(np.diag(sd**2), (n, 6, 6)).copy(),
        flags=np.zeros(n, dtype=np.int64),
        residual_px=np.full((n, 0, 2), np.nan),
        led_t_ns=np.zeros((n, 0), dtype=np.int64),
    )

    # A sensor with a low-pass whose delay is taken out, 100 Hz, data-sheet noise, rounding and range.
    b_lp, a_lp = butter(2, lowpass_hz, fs=_FINE_HZ)
    impulse = lfilter(b_lp, a_lp, np.r_[1.0, np.zeros(2000)])
    delay_s = float((np.arange(2001) * impulse).sum() / impulse.sum() / _FINE_HZ)
    gyro = CubicSpline(t - delay_s, lfilter(b_lp, a_lp, omega, axis=0))
    acc = CubicSpline(t - delay_s, lfilter(b_lp, a_lp, force - force[0], axis=0) + force[0])
    t_true = np.arange(-0.4 + rng.uniform(0, 0.01), duration_s + 0.4, 0.01)
    gyro_s = gyro(t_true) + np.array(gyro_bias_radps) + rng.normal(0, np.radians(0.1), (len(t_true), 3))
    # A sample stamped T holds the force of T - lag: f(t) = a~(t + lag).
    acc_s = acc(t_true - acc_lag_s) + np.array(acc_bias_mps2) + rng.normal(0, 0.012, (len(t_true), 3))
    limit = acc_range_g * 9.80665
    acc_s = np.clip(np.round(acc_s / 0.01) * 0.01, -limit, limit)
    gyro_s = np.round(gyro_s / np.radians(1 / 16)) * np.radians(1 / 16)
    for a, b in imu_gaps:
        acc_s[(t_true > a) & (t_true < b)] = np.nan
        gyro_s[(t_true > a) & (t_true < b)] = np.nan
    t_mid = 0.5 * (t_frame[0] + t_frame[-1])
    stamp = t_true + offset_s + skew * (t_true - t_mid)
    imu = ImuTrack(
        t_ns=EPOCH_NS + np.round(stamp * 1e9).astype(np.int64),
        acc_mps2=acc_s,
        gyro_radps=gyro_s,
        flags=np.zeros(len(t_true), dtype=np.int64),
        acc_range_mps2=limit,
    )
    return Shake(optical, imu, t, R, origin_mm, v_mmps, omega, gravity)
