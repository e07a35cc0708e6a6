"""How the fusion benchmark makes its cases, and what stands beside it."""

from argparse import ArgumentParser
from dataclasses import replace

import numpy as np
import pytest
from brick_shakes import LEVER_ARM_MM, simulate_shake
from broad_windows import Recipe, cleaned_reference, make_case, windows_in
from scipy.spatial.transform import Rotation

from bricktrack_host.fusion.clocks.time_alignment import align_times


def test_the_references_own_errors_are_taken_out_by_the_inertial_unit():
    rng = np.random.default_rng(2)
    t = np.arange(4300) / 285.7
    # About one axis the attitude is the integral of the rate, in closed form; the sensor goes round an ellipse.
    axis, w = np.array([0.6, 0.0, 0.8]), 2 * np.pi * 1.3
    body = Rotation.from_rotvec(1.5 * (1 - np.cos(5.0 * t))[:, None] / 5.0 * axis)
    rate = 1.5 * np.sin(5.0 * t)[:, None] * axis
    sensor_m = np.stack([0.02 * np.sin(w * t), 0.01 * np.cos(w * t), 0.0 * t], axis=1)
    force = body.inv().apply(-(w**2) * sensor_m + [0, 0, 9.81])
    noise_rad, noise_m = rng.normal(0, 1e-3, (t.size, 3)), rng.normal(0, 5e-5, (t.size, 3))
    clean, clean_m = cleaned_reference(
        t, body * Rotation.from_rotvec(noise_rad), sensor_m + noise_m,
        t_gyro=t, gyro=1.01 * rate + 0.004, t_acc=t, acc=1.01 * force + 0.1,
    )  # fmt: skip
    inner = slice(150, -150)  # half a second from the ends, where filters start
    left_rad = (body.inv() * clean).as_rotvec()[inner]
    left_m = (clean_m - sensor_m)[inner]
    # White noise keeps what lies below 0.5 Hz and 5 Hz of 143 Hz; one part in 100 of the motion's 20 mm, had it
    # not been below 5 Hz, would be 200 um.
    assert left_rad.std() == pytest.approx(1e-3 * np.sqrt(0.5 / 143), rel=0.4)
    assert left_m.std() == pytest.approx(5e-5 * np.sqrt(5 / 143), rel=0.3)


def test_a_range_is_set_by_the_share_of_samples_beyond_it(tmp_path):
    rng = np.random.default_rng(3)
    t = np.arange(-0.5, 15.5, 0.0035)
    acc = np.array([0.0, 0.0, 9.8]) + rng.normal(0, 3, (t.size, 3))
    np.savez(
        tmp_path / "dev_made.npz", t_mocap=t, p=np.zeros((t.size, 3)), t_gyro=t, gyro=np.zeros((t.size, 3)),
        q_xyzw=np.broadcast_to([0, 0, 0, 1.0], (t.size, 4)), t_acc=t, acc=acc, imu_in_opt_m=np.zeros(3),
    )  # fmt: skip
    case = make_case(tmp_path / "dev_made.npz", seed=0, recipe=Recipe(clip_share=0.05))
    at_limit = (np.abs(case.imu.acc_mps2) >= case.imu.acc_range_mps2 - 1e-9).any(axis=1)
    # The limit itself is the sample at that quantile; steps of 0.01 m/s^2 put few others on it.
    assert at_limit.mean() == pytest.approx(0.05, abs=0.005)
    assert np.abs(case.imu.acc_mps2).max() <= case.imu.acc_range_mps2 < 20


def test_windows_come_from_the_samples_where_no_folder_is_given(tmp_path, monkeypatch, capsys):
    parser = ArgumentParser()
    monkeypatch.delenv("BRICKTRACK_SAMPLES", raising=False)
    assert windows_in(None, parser) == []
    assert "BRICKTRACK_SAMPLES is not set" in capsys.readouterr().out
    (tmp_path / "fusion").mkdir()
    monkeypatch.setenv("BRICKTRACK_SAMPLES", str(tmp_path))
    with pytest.raises(SystemExit):
        windows_in(None, parser)
    window = tmp_path / "fusion" / "dev_made.npz"
    window.touch()
    assert windows_in(None, parser) == windows_in(tmp_path / "fusion", parser) == [window]


def test_gtsam_finds_the_motion_of_a_simulated_shake():
    pytest.importorskip("gtsam")
    from oracle_gtsam import gtsam_poses

    s = simulate_shake(9, duration_s=1.5, dropouts=((0.7, 0.85),))
    t_ns = s.imu.t_ns[(s.imu.t_ns > s.optical.t_ns[0]) & (s.imu.t_ns < s.optical.t_ns[-1])]
    alignment = replace(align_times(s.optical, s.imu), offset_ns=0.0, skew=0.0)
    R, t_mm = gtsam_poses(
        s.optical, s.imu, lever_arm_mm=np.array(LEVER_ARM_MM), output_t_ns=t_ns, alignment=alignment
    )
    R_true, true_mm = s.truth(t_ns)
    # Frames carry 0.17 mm and 0.17 deg (lengths); the motion between them is centimetres.
    assert np.sqrt(np.mean(np.sum((t_mm - true_mm) ** 2, axis=1))) < 0.2
    turn = Rotation.from_matrix(np.swapaxes(R_true, 1, 2) @ R).magnitude()
    assert np.degrees(np.sqrt(np.mean(turn**2))) < 0.15
