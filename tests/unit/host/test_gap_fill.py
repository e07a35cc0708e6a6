"""Long gaps of the inertial samples, filled by the camera; the same simulated run without the gap is the truth."""

import numpy as np
import pytest
from brick_shakes import EPOCH_NS, LEVER_ARM_MM, simulate_shake
from scipy.spatial.transform import Rotation

from bricktrack_host.fusion.clocks.time_alignment import align_times
from bricktrack_host.fusion.estimate import fuse
from bricktrack_host.fusion.inertial.imu_samples import clean_samples
from bricktrack_host.fusion.pose_by_pose.gap_fill import _as_felt, fill_of_gaps
from bricktrack_host.quality import PoseFlag

GAP_S = (2.5, 3.3)
KWARGS = {"duration_s": 6.0, "position_sd_mm": 0.02, "rotation_sd_deg": 0.02, "acc_lag_s": -0.0034}


def filled(shake):
    samples = clean_samples(shake.imu)
    alignment = align_times(shake.optical, shake.imu)
    return samples, fill_of_gaps(shake.optical, samples, alignment, LEVER_ARM_MM * 1e-3)


def test_the_fill_is_as_near_to_the_missing_samples_as_it_says():
    gappy, whole = simulate_shake(1, imu_gaps=(GAP_S,), **KWARGS), simulate_shake(1, **KWARGS)
    samples, fill = filled(gappy)
    assert fill is not None
    true = clean_samples(whole.imu)
    lost = (true.t_s > fill.spans_s[0, 0] + 1e-6) & (true.t_s < fill.spans_s[0, 1] - 1e-6)
    assert true.epoch_ns == samples.epoch_ns
    assert lost.sum() == len(fill.t_s) > 70
    for found, felt, density in (
        (fill.gyro_radps, true.gyro_radps[lost], fill.gyro_density),
        (fill.acc_mps2, true.acc_mps2[lost], fill.acc_density),
    ):
        off = felt - found
        assert np.sqrt((off**2).mean()) < 0.5 * felt.std()
        # 24 frame intervals: their mean square scatters by a quarter.
        n = 3
        means = off[: len(off) // n * n].reshape(-1, n, 3).mean(axis=1)
        assert 0.3 < density / ((means**2).mean() * n * 0.01) < 3.0


def errors(shake, track):
    R, t_mm = shake.truth(track.t_ns)
    turn = Rotation.from_matrix(np.swapaxes(track.R_camera_brick, 1, 2) @ R).as_rotvec()
    return np.concatenate([turn, t_mm - track.t_camera_brick_mm], axis=1)


def rms_mm(e):
    return float(np.sqrt((e[:, 3:] ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("seed", [1, 2])
def test_in_a_gap_the_fused_motion_is_no_worse_than_the_frames_and_honest(seed):
    s = simulate_shake(seed, imu_gaps=(GAP_S,), **KWARGS)
    t_s = (s.optical.t_ns - EPOCH_NS) * 1e-9
    inside = s.optical.t_ns[(t_s > GAP_S[0] + 0.02) & (t_s < GAP_S[1] - 0.02)]
    between = np.arange(inside[0], inside[-1], 5_000_000)
    track = fuse(
        s.optical, s.imu, lever_arm_mm=LEVER_ARM_MM, output_t_ns=np.concatenate([inside, between])
    ).track
    e, n = errors(s, track), len(inside)
    assert ((track.flags & int(PoseFlag.IMU_GAP)) != 0).all()
    _, true_mm = s.truth(inside)
    seen = np.isin(s.optical.t_ns, inside)
    off_mm = s.optical.t_camera_brick_mm[seen] - true_mm
    assert rms_mm(e[:n]) < 1.1 * np.sqrt((off_mm**2).sum(axis=1).mean())
    chi2 = (e * np.linalg.solve(track.covariance, e[..., None])[..., 0]).sum(axis=1)
    # 6 when honest; a gap holds five frames, whose mean scatters by 6 / sqrt(3 * 5) and more.
    assert 2.5 < chi2[:n].mean() < 9.5 and 2.5 < chi2[n:].mean() < 9.5
    # A gap is no impact: what stands on either side of it are no neighbours.
    assert not (track.flags & int(PoseFlag.IMPACT)).any()


def test_a_gap_through_which_the_camera_saw_nothing_is_not_filled():
    s = simulate_shake(1, imu_gaps=(GAP_S,), dropouts=((2.8, 3.0),), **KWARGS)
    assert filled(s)[1] is None
    assert filled(simulate_shake(1, **KWARGS))[1] is None


def test_beside_what_the_camera_did_not_see_the_samples_are_told_as_well():
    n, t_s = 60, 0.01 * np.arange(60)
    level = np.tile(np.eye(3), (n, 1, 1))
    acc = np.stack([np.sin(20 * t_s), np.cos(20 * t_s), np.zeros(n)], axis=1)
    seen = np.arange(n) < 40
    acc_seen = np.where(seen[:, None], acc, np.nan)
    gravity = np.array([0.0, 0.0, 9.8])
    felt = _as_felt(t_s, level, acc_seen, seen, acc[seen] + gravity)
    assert felt[seen] == pytest.approx(acc[seen] + gravity, abs=1e-9)
