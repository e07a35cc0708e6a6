"""A brick and a camera that both move (simulated): one relative motion, with the camera at rest or shaken."""

from dataclasses import dataclass

import numpy as np
from brick_shakes import EPOCH_NS, GRAVITY_MPS2, LEVER_ARM_MM, Shake, simulate_shake
from scipy.interpolate import CubicSpline
from scipy.signal import butter, lfilter
from scipy.spatial.transform import Rotation

from bricktrack_common.arrays import FloatArray
from bricktrack_host.tracks import ImuTrack

IMU_TO_CAMERA_MM = np.array([-18.0, 25.0, 7.0])
_FINE_HZ = 4000.0


@dataclass(frozen=True, slots=True, eq=False)
class TwoImus:
    """One run: ``shake`` holds the relative motion and the optical poses, which the camera's motion leaves.

    The places of the sensors, mm, are those that a user has measured.
    """

    shake: Shake
    brick: ImuTrack
    camera: ImuTrack
    lever_arm_mm: FloatArray
    imu_to_camera_mm: FloatArray


def simulate_two_imus(
    seed: int,
    *,
    acc_g: float = 0.3,
    rocking_deg: float = 2.0,
    brick_offset_s: float = 0.004,
    camera_offset_s: float = 0.0065,
    acc_lag_s: float = -0.0034,
    duration_s: float = 8.0,
    dropouts: tuple[tuple[float, float], ...] = (),
    gain_sd: float = 0.0,
    place_sd_mm: float = 0.0,
    lowpass_hz: float = 60.0,
    rotation_sd_deg: float = 0.1,
) -> TwoImus:
    """Return a run whose camera is shaken by ``acc_g`` (rms, each axis) at 3-10 Hz and rocked by so much.

    The same seed gives the same relative motion, the same optical noise and the same sensor noise. Each
    sensor stamps later than the camera by its own offset. Scale and crossed axes of both are wrong by so much,
    and their places by so much along each axis. Both have a low-pass of second order
    (Butterworth); ``rotation_sd_deg`` is that of the optical noise.
    """
    shake = simulate_shake(seed, duration_s=duration_s, dropouts=dropouts, rotation_sd_deg=rotation_sd_deg)
    rng = np.random.default_rng([seed, 5])
    t = shake.t_s
    window = np.clip((t - 0.6) / 0.4, 0, 1) * np.clip((duration_s - 0.6 - t) / 0.4, 0, 1)
    window = window**3 * (10 - 15 * window + 6 * window**2)

    def wave(exponent: float) -> FloatArray:
        f = rng.uniform(3.0, 10.0, (6, 3))
        phase = rng.uniform(0, 2 * np.pi, (6, 3))
        s = (np.sin(2 * np.pi * f * t[:, None, None] + phase) / (2 * np.pi * f) ** exponent).sum(axis=1)
        return s / np.sqrt((s**2).mean(axis=0)) if exponent == 0 else s

    shape = wave(2.0)
    rms = np.sqrt((np.gradient(np.gradient(shape, t, axis=0), t, axis=0) ** 2).mean(axis=0))
    p_camera = window[:, None] * shape / rms * acc_g * GRAVITY_MPS2
    attitude = Rotation.random(rng=rng) * Rotation.from_rotvec(
        np.radians(rocking_deg) * window[:, None] * wave(0)
    )
    relative = Rotation.from_matrix(shake.R)
    brick = attitude * relative
    gravity = rng.normal(0, 1, 3)
    gravity *= GRAVITY_MPS2 / np.linalg.norm(gravity)
    p_brick = p_camera + attitude.apply(1e-3 * (shake.t_mm + relative.apply(LEVER_ARM_MM)))
    p_sensor = p_camera - attitude.apply(1e-3 * IMU_TO_CAMERA_MM)

    wrong = np.random.default_rng([seed, 13])

    def sensor(body: Rotation, p: FloatArray, offset_s: float, key: int) -> ImuTrack:
        noise = np.random.default_rng([seed, key])
        acceleration = np.gradient(np.gradient(p, t, axis=0), t, axis=0)
        force = body.inv().apply(acceleration - gravity)
        between = (body[:-1].inv() * body[1:]).as_rotvec() * _FINE_HZ
        omega = np.concatenate([between[:1], 0.5 * (between[1:] + between[:-1]), between[-1:]])
        b, a = butter(2, lowpass_hz, fs=_FINE_HZ)
        impulse = lfilter(b, a, np.r_[1.0, np.zeros(2000)])
        delay_s = float((np.arange(2001) * impulse).sum() / impulse.sum() / _FINE_HZ)
        gyro = CubicSpline(t - delay_s, lfilter(b, a, omega, axis=0))
        acc = CubicSpline(t - delay_s, lfilter(b, a, force - force[0], axis=0) + force[0])
        t_true = np.arange(-0.4 + noise.uniform(0, 0.01), duration_s + 0.4, 0.01)
        gyro_s = gyro(t_true) + noise.normal(0, 0.008, 3) + noise.normal(0, np.radians(0.1), (len(t_true), 3))
        acc_s = acc(t_true - acc_lag_s) + noise.normal(0, 0.15, 3) + noise.normal(0, 0.012, (len(t_true), 3))
        gyro_s = gyro_s @ (np.eye(3) + gain_sd * wrong.normal(size=(3, 3)))
        acc_s = acc_s @ (np.eye(3) + gain_sd * wrong.normal(size=(3, 3)))
        lsb = np.radians(1 / 16)
        return ImuTrack(
            t_ns=EPOCH_NS + np.round((t_true + offset_s) * 1e9).astype(np.int64),
            acc_mps2=np.round(acc_s / 0.01) * 0.01,
            gyro_radps=np.round(gyro_s / lsb) * lsb,
            flags=np.zeros(len(t_true), dtype=np.int64),
            acc_range_mps2=16 * GRAVITY_MPS2,
        )

    return TwoImus(
        shake=shake,
        brick=sensor(brick, p_brick, brick_offset_s, 11),
        camera=sensor(attitude, p_sensor, camera_offset_s, 12),
        lever_arm_mm=LEVER_ARM_MM + place_sd_mm * wrong.normal(size=3),
        imu_to_camera_mm=IMU_TO_CAMERA_MM + place_sd_mm * wrong.normal(size=3),
    )
