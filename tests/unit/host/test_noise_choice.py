"""What frames say of their own noise, and of that of the inertial samples."""

from dataclasses import replace

import numpy as np
from brick_shakes import LEVER_ARM_MM, simulate_shake

from bricktrack_host.fusion.clocks.time_alignment import align_times
from bricktrack_host.fusion.estimate import FusionInput, fuse, prepare_run
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.pose_by_pose.noise_choice import frame_chi2
from bricktrack_host.fusion.pose_by_pose.pose_level import smooth_poses


def test_few_sharp_frames_of_a_shift_without_turning_are_fused():
    # Without rotation the offset stays unsure to milliseconds, far more than frames of 4 um allow: the first
    # pass is linearised so far off that its covariance at frames contradicts theirs.
    s = simulate_shake(
        1, duration_s=5.0, offset_s=0.003, rotation_deg=0.01, position_sd_mm=0.004, rotation_sd_deg=0.2
    )
    o = s.optical
    kept = np.sort(np.random.default_rng(1).choice(len(o.t_ns), 28, replace=False))
    few = replace(
        o,
        **{
            name: value[kept]
            for name in o.__dataclass_fields__
            if isinstance(value := getattr(o, name), np.ndarray) and len(value) == len(o.t_ns)
        },
    )
    wanted = np.arange(few.t_ns[0], few.t_ns[-1], 5_000_000)
    track = fuse(few, s.imu, lever_arm_mm=LEVER_ARM_MM, output_t_ns=wanted).track
    _, t_mm = s.truth(track.t_ns)
    # The motion is of millimetres, the frames lie 0.2 s apart.
    assert np.sqrt(((track.t_camera_brick_mm - t_mm) ** 2).mean()) < 0.05


def test_a_frame_whose_covariance_rounding_has_lost_is_still_judged():
    s = simulate_shake(7, duration_s=1.5)
    item = FusionInput(s.optical, s.imu, LEVER_ARM_MM, s.optical.t_ns)
    done = smooth_poses([prepare_run(item, FusionSettings())], FusionSettings())[0]

    def chi2(covariance):
        estimate = replace(done.estimate, covariance=covariance)
        return frame_chi2(done.problem, done.passed, estimate, 0, done.nodes, done.used)

    lost = done.estimate.covariance.copy()
    lost[done.nodes.node_of_frame[9], 0, 4, 4] = np.nan
    found, whole = chi2(lost), chi2(done.estimate.covariance)
    np.testing.assert_array_equal(np.delete(found, 9), np.delete(whole, 9))
    assert 0 < found[9] < 12.59 and found[9] != whole[9]


def test_a_gyro_that_vibrates_is_not_taken_for_noise():
    s = simulate_shake(5, duration_s=5.0)
    t_s = (s.imu.t_ns - s.imu.t_ns[0]) * 1e-9
    tone = 0.05 * np.sin(2 * np.pi * 43.0 * t_s + np.array([[0.0], [1.0], [2.0]])).T
    noise = np.random.default_rng(2).normal(0, 0.05, tone.shape)
    wanted = np.arange(s.optical.t_ns[0], s.optical.t_ns[-1], 5_000_000)
    share = [
        fuse(
            s.optical,
            replace(s.imu, gyro_radps=s.imu.gyro_radps + added),
            lever_arm_mm=LEVER_ARM_MM,
            output_t_ns=wanted,
        ).gyro_noise.roughness
        for added in (tone, noise)
    ]
    # At one pitch it integrates to 0.05 / (2 pi 43) = 0.2 mrad and no farther; noise walks off.
    assert share[0] < 0.1
    assert share[1] >= 0.4  # at most one step below what is stated


def test_the_scale_of_an_accelerometer_that_vibrates_is_found():
    # At one pitch, which is gone once integrated: samples 3 m/s^2 rough still tell of a scale.
    s = simulate_shake(6, duration_s=6.0)
    t_s = (s.imu.t_ns - s.imu.t_ns[0]) * 1e-9
    buzz = 3.0 * np.sin(2 * np.pi * 37.0 * t_s)[:, None] * [0.5, 1.0, -0.7]
    buzzing = replace(s.imu, acc_mps2=1.01 * (s.imu.acc_mps2 + buzz))
    item = FusionInput(s.optical, buzzing, LEVER_ARM_MM, s.optical.t_ns, align_times(s.optical, buzzing))
    (smoothed,) = smooth_poses([prepare_run(item, FusionSettings())], FusionSettings())
    sd = np.sqrt(np.diag(smoothed.run.sensor_covariance)[[9, 13, 17]])
    # 0.01 is stated before. Were the vibration noise, 0.0098 would be left of it.
    assert (sd < 0.0075).all()
    assert (np.abs(np.diag(smoothed.run.acc_gain) - 1.01) < 3 * sd).all()
