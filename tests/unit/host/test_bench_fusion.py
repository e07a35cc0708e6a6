"""How the fusion benchmark judges: the band of a run, and the reference's own error."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from brick_shakes import LEVER_ARM_MM, simulate_shake
from fusion_samples import REPOSITORY, bench_module
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from bricktrack_host.fusion.clocks.time_alignment import align_times

RATE_HZ = 100.0


def case_of(n):
    """Return a case of which only the instants matter."""
    bench, none = bench_module(), np.zeros(0)
    return bench.Case(
        name="", optical=None, imu=None, offset_s=0.0, lag_s=0.0,
        t_out_ns=np.arange(n) * 10_000_000, R_true=none, t_true_mm=none, in_dropout=none, truth_sd=none,
    )  # fmt: skip


def correlated_chi2(rng, n, gain):
    """Return the squares of six errors that remember a tenth of a second, ``gain`` times what is stated."""
    memory = np.exp(-1 / (0.1 * RATE_HZ))
    e = lfilter([np.sqrt(1 - memory**2)], [1, -memory], rng.normal(0, 1, (n + 100, 6)), axis=0)[100:]
    return ((gain * e) ** 2).sum(axis=1)


def test_the_band_of_a_run_holds_honest_runs_and_no_others():
    rng, bench = np.random.default_rng(1), bench_module()
    held = {
        gain: np.mean(
            [bench.is_within_band(case_of(1450), correlated_chi2(rng, 1450, gain)) for _ in range(60)]
        )
        for gain in (0.75, 1.0, 1.3)
    }
    assert held[1.0] > 0.85  # 95 % but for the scatter of 60 runs
    assert held[0.75] < 0.1 and held[1.3] < 0.1


def test_the_references_own_error_is_measured_beside_the_gyro():
    rng, bench = np.random.default_rng(2), bench_module()
    t = np.arange(4300) / 285.7
    # About one axis the attitude is the integral of the rate, in closed form.
    rate = 1.5 * np.sin(2 * np.pi * 0.8 * t)[:, None] * [0.6, 0.0, 0.8]
    angle = 1.5 * (1 - np.cos(2 * np.pi * 0.8 * t)) / (2 * np.pi * 0.8)
    noise = Rotation.from_rotvec(rng.normal(0, 1e-3, (t.size, 3)))
    seen = Rotation.from_rotvec(angle[:, None] * [0.6, 0.0, 0.8]) * noise
    origin_mm = 50 * np.sin(2 * np.pi * t)[:, None] * [1.0, 0.5, 0.2] + rng.normal(0, 0.05, (t.size, 3))
    sd = bench.reference_sd(t, seen, origin_mm, t, rate)
    # White noise less what lies below 5 Hz and 15 Hz of 143 Hz.
    assert sd[:3] == pytest.approx(1e-3 * np.sqrt(1 - 5 / 143), rel=0.06)
    assert sd[3:] == pytest.approx(0.05 * np.sqrt(1 - 15 / 143), rel=0.06)


def test_a_range_is_set_by_the_share_of_samples_beyond_it(tmp_path):
    rng, bench = np.random.default_rng(3), bench_module()
    t = np.arange(-0.5, 15.5, 0.0035)
    acc = np.array([0.0, 0.0, 9.8]) + rng.normal(0, 3, (t.size, 3))
    np.savez(
        tmp_path / "dev_made.npz", t_mocap=t, p=np.zeros((t.size, 3)), t_gyro=t, gyro=np.zeros((t.size, 3)),
        q_xyzw=np.broadcast_to([0, 0, 0, 1.0], (t.size, 4)), t_acc=t, acc=acc, imu_in_opt_m=np.zeros(3),
    )  # fmt: skip
    case = bench.make_case(tmp_path / "dev_made.npz", seed=0, recipe=bench.Recipe(clip_share=0.05))
    at_limit = (np.abs(case.imu.acc_mps2) >= case.imu.acc_range_mps2 - 1e-9).any(axis=1)
    # The limit itself is the sample at that quantile; steps of 0.01 m/s^2 put few others on it.
    assert at_limit.mean() == pytest.approx(0.05, abs=0.005)
    assert np.abs(case.imu.acc_mps2).max() <= case.imu.acc_range_mps2 < 20


def test_gtsam_finds_the_motion_of_a_simulated_shake(monkeypatch):
    pytest.importorskip("gtsam")
    monkeypatch.setattr(sys, "path", [*sys.path, str(REPOSITORY / "scripts")])
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
