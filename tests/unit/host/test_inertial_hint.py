"""Optical poses smoothed with the hints of an IMU that cannot be fused: turns and impacts (simulated)."""

import numpy as np
from brick_shakes import EPOCH_NS, simulate_shake
from scipy.spatial.transform import Rotation
from two_imus import simulate_two_imus

from bricktrack_host.fusion.clocks.time_alignment import align_times
from bricktrack_host.fusion.optical.inertial_hint import InertialHint
from bricktrack_host.fusion.optical.optical_smoothing import smooth_optical
from bricktrack_host.quality import PoseFlag


def turns_deg(rocking_deg, *, hinted, dropout_s=0.3):
    dropouts = ((2.0, 2.0 + dropout_s), (3.6, 3.6 + dropout_s))
    run = simulate_two_imus(2, rocking_deg=rocking_deg, duration_s=5.0, dropouts=dropouts)
    optical = run.shake.optical
    hint = InertialHint(run.brick, align_times(optical, run.brick)) if hinted else None
    t_ns = np.arange(optical.t_ns[3], optical.t_ns[-3], 10_000_000)
    track = smooth_optical(optical, t_ns, hint=hint)
    R, _ = run.shake.truth(t_ns)
    off = np.degrees(Rotation.from_matrix(np.swapaxes(track.R_camera_brick, 1, 2) @ R).magnitude())
    inside = track.flags & int(PoseFlag.DROPOUT) != 0
    turn = np.linalg.inv(track.covariance[:, :3, :3])
    rvec = Rotation.from_matrix(np.swapaxes(track.R_camera_brick, 1, 2) @ R).as_rotvec()
    chi2 = np.einsum("ni,nij,nj->n", rvec, turn, rvec)
    return np.sqrt(np.mean(off[inside] ** 2)), np.sqrt(np.mean(off[~inside] ** 2)), chi2


def test_where_the_camera_only_shifts_the_gyro_holds_the_attitude_through_dropouts():
    alone, hinted = turns_deg(0.0, hinted=False), turns_deg(0.0, hinted=True)
    assert hinted[0] < 0.1 < 0.2 * alone[0]
    assert hinted[1] < alone[1]
    assert (hinted[2] < 7.81).mean() > 0.9  # 95 % point of chi-square with 3


def test_where_it_rocks_the_gyro_costs_nothing():
    alone, hinted = (turns_deg(2.0, hinted=h, dropout_s=0.1) for h in (False, True))
    assert hinted[0] < 1.05 * alone[0]
    assert hinted[1] < 1.05 * alone[1]


def test_impacts_are_marked_and_the_covariance_knows_of_them():
    within = {False: [], True: []}
    for seed in (1, 2, 3):
        s = simulate_shake(
            seed, duration_s=6.0, impacts=4, impact_mps=0.2, amplitude_mm=1.0, rotation_deg=0.3
        )
        t_ns = np.arange(EPOCH_NS + 10**9, EPOCH_NS + 5 * 10**9, 5_000_000)
        hint = InertialHint(s.imu, align_times(s.optical, s.imu))
        _, t_mm = s.truth(t_ns)
        marked = smooth_optical(s.optical, t_ns, hint=hint).flags & int(PoseFlag.IMPACT) != 0
        assert 0.01 < marked.mean() < 0.1
        near = np.convolve(marked, np.ones(9), "same") > 0  # 20 ms on either side
        for hinted in (False, True):
            track = smooth_optical(s.optical, t_ns, hint=hint if hinted else None)
            e = (t_mm - track.t_camera_brick_mm)[near]
            P = track.covariance[near, 3:, 3:]
            within[hinted].append((e * np.linalg.solve(P, e[..., None])[..., 0]).sum(axis=1) < 7.81)
    share = {hinted: np.concatenate(parts).mean() for hinted, parts in within.items()}
    assert share[True] > share[False]
    assert share[True] > 0.9


def test_twist_is_that_of_the_brick_seen_from_the_camera():
    run = simulate_two_imus(4, rocking_deg=0.0, duration_s=4.0)
    optical = run.shake.optical
    t_ns = optical.t_ns[20:-20]
    track = smooth_optical(optical, t_ns, hint=InertialHint(run.brick, align_times(optical, run.brick)))
    i = np.round((t_ns - EPOCH_NS) * 1e-9 * 4000).astype(int) - round(run.shake.t_s[0] * 4000)
    off = track.omega_brick_radps - run.shake.omega_radps[i]
    assert np.sqrt((off**2).mean()) < 0.05 * np.sqrt((run.shake.omega_radps[i] ** 2).mean())
