"""A camera that is knocked: its attitudes step against the gyro's; simulated shakes."""

from dataclasses import replace

import numpy as np
import pytest
from brick_shakes import simulate_shake

from bricktrack_common.rotations import matrix_from_rvec
from bricktrack_host.fusion.camera_step import words_on_camera_step
from bricktrack_host.fusion.clocks import rotation_errors
from bricktrack_host.fusion.clocks.offset_change import errors_of
from bricktrack_host.fusion.clocks.sample_clock import SampleClock
from bricktrack_host.fusion.clocks.time_alignment import align_times

AT = 60


@pytest.fixture(scope="module")
def shake():
    return simulate_shake(3, duration_s=4.0)


def told(optical, imu):
    return words_on_camera_step(optical, imu, align_times(optical, imu))


def knocked(optical, turn_deg):
    R = optical.R_camera_brick.copy()
    R[AT:] = matrix_from_rvec(np.deg2rad(turn_deg)) @ R[AT:]
    return replace(optical, R_camera_brick=R)


def test_a_camera_that_stands_still_is_not_spoken_of(shake):
    assert told(shake.optical, shake.imu) == []


def test_a_knock_is_told_with_its_frame_and_size(shake):
    (words,) = told(knocked(shake.optical, [1.2, -1.5, 0.6]), shake.imu)
    assert f"at frame {AT} " in words
    size_deg = float(words.split("attitudes are ")[1].split(" ")[0])
    assert size_deg == pytest.approx(np.linalg.norm([1.2, -1.5, 0.6]), rel=0.25)  # of attitudes that scatter


def test_frames_without_a_pose_are_counted_too(shake):
    optical = knocked(shake.optical, [1.2, -1.5, 0.6])
    R, t_mm = optical.R_camera_brick.copy(), optical.t_camera_brick_mm.copy()
    R[10:14], t_mm[10:14] = np.nan, np.nan
    (words,) = told(replace(optical, R_camera_brick=R, t_camera_brick_mm=t_mm), shake.imu)
    assert f"at frame {AT} " in words


@pytest.mark.parametrize(("off_px", "n_told"), [(0.3, 0), (0.02, 1)])
def test_a_step_where_an_led_goes_that_stood_beside_its_place_is_no_knock(shake, off_px, n_told):
    optical = knocked(shake.optical, [1.2, -1.5, 0.6])
    residual_px = np.zeros((len(optical.t_ns), 7, 2))
    residual_px[:, 2, 0] = off_px
    residual_px[AT - 3 : AT + 20, 2] = np.nan
    assert len(told(replace(optical, residual_px=residual_px), shake.imu)) == n_told


def test_a_gyro_whose_scale_is_off_is_no_knock(shake):
    assert told(shake.optical, replace(shake.imu, gyro_radps=1.01 * shake.imu.gyro_radps)) == []


def test_clocks_that_the_motion_does_not_tell_tell_no_knock(shake):
    optical = knocked(shake.optical, [1.2, -1.5, 0.6])
    alignment = replace(align_times(optical, shake.imu), source="stamps")
    assert words_on_camera_step(optical, shake.imu, alignment) == []


def test_a_step_is_sought_in_stretches_as_in_the_whole_run(monkeypatch):
    shake = simulate_shake(5, duration_s=30.0)
    R = shake.optical.R_camera_brick.copy()
    R[500:] = matrix_from_rvec(np.deg2rad([1.2, -1.5, 0.6])) @ R[500:]
    optical = replace(shake.optical, R_camera_brick=R)
    alignment = align_times(optical, shake.imu)
    errors = errors_of(optical, shake.imu, alignment)
    step = errors.attitude_step()
    monkeypatch.setattr(rotation_errors, "_STEPS_AT_ONCE", 10_000)
    monkeypatch.setattr(rotation_errors, "_STEP_KNOTS", 10_000)
    whole = errors.attitude_step()
    assert step.frame == whole.frame == 500
    assert step.rvec_rad == pytest.approx(whole.rvec_rad, rel=1e-6)
    assert step.covariance == pytest.approx(whole.covariance, rel=1e-6, abs=1e-12)
    assert step.gain == pytest.approx(whole.gain, rel=1e-6)


def test_a_sample_that_was_not_read_is_no_knock():
    shake = simulate_shake(
        3, duration_s=4.0, rotation_deg=0.3, rotation_sd_deg=0.01, periodic_hz=22.0, lowpass_hz=200.0
    )
    imu, alignment = shake.imu, align_times(shake.optical, shake.imu)
    kept = np.arange(len(imu.t_ns)) != 199  # the cubic across is 0.3 degrees off
    imu = replace(
        imu,
        t_ns=imu.t_ns[kept],
        gyro_radps=imu.gyro_radps[kept],
        acc_mps2=imu.acc_mps2[kept],
        flags=imu.flags[kept],
    )
    assert words_on_camera_step(shake.optical, imu, alignment) == []


@pytest.mark.parametrize(("age_ms", "n_told"), [(9.9, 0), (0.1, 0), (5.0, 1)])
def test_what_samples_a_period_off_may_have_turned_is_no_knock(age_ms, n_told):
    shake = simulate_shake(3, duration_s=4.0, rotation_sd_deg=0.02)
    optical = knocked(shake.optical, [0.3, -0.4, 0.2])
    alignment = align_times(optical, shake.imu)
    n, at = len(shake.imu.t_ns), np.searchsorted(shake.imu.t_ns, optical.t_ns[AT])
    age_ns = np.full(n, 5_000_000)
    age_ns[at - 5 : at + 5] = round(age_ms * 1e6)  # as the rate changes by hundreds of degrees per second
    clock = SampleClock(int(shake.imu.t_ns[0]), 1e7, np.arange(n), 0)
    as_read = replace(shake.imu, t_ns=shake.imu.t_ns + age_ns)
    words = words_on_camera_step(optical, as_read, replace(alignment, sample_clock=clock))
    assert len(words) == n_told
