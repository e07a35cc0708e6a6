"""The offset within a run: a step and a wander are seen, a gyro whose scale is off is not taken for one."""

from dataclasses import replace

import numpy as np
import pytest
from brick_shakes import simulate_shake
from scipy.spatial.transform import Rotation

from bricktrack_host.fusion.clocks import offset_change
from bricktrack_host.fusion.clocks.offset_change import change_of_halves, errors_of, offset_wander
from bricktrack_host.fusion.clocks.time_alignment import align_times

SCALE = np.array([1.01, 0.99, 1.0])


def turning(t_s):
    """Attitudes of a brick that turns slowly, and up to 22 degrees, between two rests; 1.2 s in all."""
    s = np.clip((t_s - 0.2) / 0.15, 0, 1) * np.clip((1.05 - t_s) / 0.15, 0, 1)
    window = s**3 * (10 - 15 * s + 6 * s**2)
    angles = [10, 22, 14] * window[:, None] * np.sin(2 * np.pi * t_s[:, None] * [1.6, 1.2, 1.4] + [0.3, 0, 1])
    return Rotation.from_euler("xyz", angles, degrees=True)


def late_s(t_s, rms_s):
    """How late frames are: to and fro in 0.7 s, as an exposure that is controlled by the light."""
    return np.sqrt(2) * rms_s * np.sin(2 * np.pi * t_s / 0.7)


def recording(*, scale=1.0, step_ns=0, wander_s=0.0):
    """Return poses at 50 a second and samples of the gyro at 100; a simulated shake lends all else."""
    shake = simulate_shake(1, duration_s=1.2, frame_rate_hz=50.0)
    optical, imu = shake.optical, shake.imu
    t0_ns = int(optical.t_ns[0])
    noise = Rotation.from_rotvec(np.random.default_rng(5).normal(0, 5e-4, (len(optical.t_ns), 3)))
    seen_s = (optical.t_ns - t0_ns) * 1e-9
    R = (turning(seen_s + late_s(seen_s, wander_s)) * noise).as_matrix()
    at_s, half_s = (imu.t_ns - t0_ns) * 1e-9, 5e-4
    rate = (turning(at_s - half_s).inv() * turning(at_s + half_s)).as_rotvec() / (2 * half_s)
    covariance = np.broadcast_to(np.diag([2.5e-7] * 3 + [1e-4] * 3), optical.covariance.shape)
    t_ns = optical.t_ns.copy()
    t_ns[len(t_ns) // 2 :] += step_ns
    return (
        replace(optical, t_ns=t_ns, R_camera_brick=R, covariance=covariance),
        replace(imu, gyro_radps=rate * scale),
    )


def found(**how):
    optical, imu = recording(**how)
    return change_of_halves(errors_of(optical, imu, align_times(optical, imu)))


def wandering(optical, imu, alignment):
    return offset_wander(optical, alignment, errors_of(optical, imu, alignment))


def test_a_gyro_whose_scale_is_off_is_no_change():
    change = found(scale=SCALE)
    assert not change.is_sure
    assert change.change_s == pytest.approx(0.0, abs=0.5e-3)  # the floor of 0.3 ms, and noise


@pytest.mark.parametrize("scale", [1.0, SCALE])
def test_a_step_of_the_stamps_is_found_whatever_the_scale(scale):
    change = found(scale=scale, step_ns=3_000_000)
    assert change.is_sure
    assert change.change_s == pytest.approx(-3e-3, abs=0.6e-3)


def test_without_an_offset_by_the_motion_nothing_is_told():
    optical, imu = recording()
    assert errors_of(optical, imu, replace(align_times(optical, imu), source="stamps")) is None


@pytest.mark.parametrize("scale", [1.0, SCALE])
def test_an_offset_that_stays_does_not_wander(scale):
    optical, imu = recording(scale=scale)
    assert wandering(optical, imu, align_times(optical, imu)) is None


def test_frames_that_are_late_by_turns_are_told_with_how_much():
    optical, imu = recording(wander_s=2e-3)
    wander = wandering(optical, imu, align_times(optical, imu))
    # Beside a steady rate: over two waves the clocks seem to run apart, which is put back.
    assert wander.rms_s == pytest.approx(2e-3, rel=0.45)
    assert wander.sd_s.shape == optical.t_ns.shape
    late = late_s((optical.t_ns - optical.t_ns[0]) * 1e-9, 2e-3)
    moving = slice(15, 48)  # from 0.3 to 0.95 s
    assert np.sqrt(np.mean((late[moving] / wander.sd_s[moving]) ** 2)) < 2


def test_a_long_run_is_looked_at_in_stretches(monkeypatch):
    optical, imu = recording(wander_s=2e-3)
    alignment = align_times(optical, imu)
    whole = wandering(optical, imu, alignment)
    monkeypatch.setattr(offset_change, "_WANDER_STRETCH_S", 0.6)
    halves = wandering(optical, imu, alignment)
    # Each half has a steady rate of its own, which holds more of a wave of 0.7 s.
    assert 0.4 * whole.rms_s < halves.rms_s < 1.1 * whole.rms_s
    assert np.isfinite(halves.sd_s).all() and halves.sd_s.shape == whole.sd_s.shape
    monkeypatch.setattr(offset_change, "_WANDER_STRETCH_S", 0.1)  # five frames, fewer than are fitted
    assert wandering(optical, imu, alignment) is None
    steady, imu = recording()
    monkeypatch.setattr(offset_change, "_WANDER_STRETCH_S", 0.6)
    assert wandering(steady, imu, align_times(steady, imu)) is None
