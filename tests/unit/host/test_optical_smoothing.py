"""Smoothing of optical poses alone, on simulated shakes whose truth is exact."""

from dataclasses import replace

import numpy as np
import pytest
from brick_shakes import EPOCH_NS, simulate_shake
from scipy.spatial.transform import Rotation

from bricktrack_common.errors import ShapeError, TrackingError
from bricktrack_host.fusion.optical.optical_smoothing import OpticalSmoothingSettings, smooth_optical
from bricktrack_host.quality import PoseFlag

WHITE = OpticalSmoothingSettings(optical_common_share=0.0)  # the simulated noise has nothing in common


def errors(shake, track):
    R, t_mm = shake.truth(track.t_ns)
    turn = Rotation.from_matrix(np.swapaxes(track.R_camera_brick, 1, 2) @ R).as_rotvec()
    return np.concatenate([turn, t_mm - track.t_camera_brick_mm], axis=1)


def test_a_slow_motion_is_smoothed_below_the_frames_noise_with_honest_covariance():
    chi2 = []
    for seed in (1, 2, 3):
        s = simulate_shake(seed, duration_s=6.0, amplitude_mm=0.5, rotation_deg=0.3)
        track = smooth_optical(s.optical, s.optical.t_ns, settings=WHITE)
        e = errors(s, track)
        assert np.sqrt((e[:, 3:] ** 2).mean()) < 0.09  # one frame: 0.1 mm
        chi2.append((e * np.linalg.solve(track.covariance, e[..., None])[..., 0]).sum(axis=1).mean())
        assert (track.flags == int(PoseFlag.OPTICAL_ONLY)).all()
    assert 4.0 < np.mean(chi2) < 9.0  # 6 expected; neighbouring samples are not independent


def test_a_brick_at_rest_is_averaged():
    s = simulate_shake(4, duration_s=6.0, amplitude_mm=0.0, rotation_deg=0.0)
    track = smooth_optical(s.optical, np.arange(EPOCH_NS + 10**9, EPOCH_NS + 5 * 10**9, 5_000_000))
    assert np.sqrt((errors(s, track)[:, 3:] ** 2).mean()) < 0.03
    assert np.abs(track.v_camera_mmps).max() < 2.0


def test_velocity_is_that_of_the_truth():
    s = simulate_shake(5, duration_s=6.0, periodic_hz=2.0)
    t_ns = np.arange(EPOCH_NS + 10**9, EPOCH_NS + 5 * 10**9, 7_000_000)
    track = smooth_optical(s.optical, t_ns)
    i = np.round(((t_ns - EPOCH_NS) * 1e-9 - s.t_s[0]) * 4000).astype(int)
    speed, turn = np.sqrt((s.v_mmps[i] ** 2).mean()), np.sqrt((s.omega_radps[i] ** 2).mean())
    assert np.sqrt(((track.v_camera_mmps - s.v_mmps[i]) ** 2).mean()) < 0.1 * speed
    assert np.sqrt(((track.omega_brick_radps - s.omega_radps[i]) ** 2).mean()) < 0.15 * turn


def test_gaps_grow_unsure_and_long_ones_hold_no_pose():
    s = simulate_shake(6, duration_s=8.0, dropouts=((2.0, 2.2), (3.5, 6.5)))
    t_ns = np.arange(EPOCH_NS, EPOCH_NS + 10 * 10**9, 10_000_000)
    track = smooth_optical(s.optical, t_ns)
    t = (t_ns - EPOCH_NS) * 1e-9
    lost = (track.flags & int(PoseFlag.NO_POSE)) != 0
    assert lost[(t > 4.5) & (t < 5.5)].all() and lost[t > 9.5].all()
    assert not lost[(t > 0.1) & (t < 3.4)].any()
    assert (np.isnan(track.t_camera_brick_mm).any(axis=1) == lost).all()
    sd = np.sqrt(track.covariance[:, 3, 3])
    assert sd[np.abs(t - 2.1).argmin()] > 3 * sd[np.abs(t - 1.8).argmin()]
    assert ((track.flags & int(PoseFlag.DROPOUT)) != 0)[(t > 2.06) & (t < 2.14)].all()
    assert ((track.flags & int(PoseFlag.EXTRAPOLATED)) != 0)[t > 8.0].all()


def test_a_single_outlier_is_left_out():
    s = simulate_shake(7, duration_s=5.0, periodic_hz=2.0)
    p = s.optical.t_camera_brick_mm.copy()
    p[70] += [6.0, -4.0, 5.0]
    track = smooth_optical(replace(s.optical, t_camera_brick_mm=p), s.optical.t_ns[68:73])
    assert np.abs(errors(s, track)[:, 3:]).max() < 0.5


def test_too_little_or_too_wild_is_refused():
    s = simulate_shake(8, duration_s=3.0, dropouts=((-1.0, 2.94),))
    with pytest.raises(TrackingError, match="three are needed"):
        smooth_optical(s.optical, s.optical.t_ns)
    s = simulate_shake(9, duration_s=3.0)
    spin = Rotation.from_rotvec(
        np.linspace(0, 2 * np.pi, len(s.optical.t_ns))[:, None] * [0, 0, 1]
    ).as_matrix()
    with pytest.raises(TrackingError, match="degrees from its middle attitude"):
        smooth_optical(replace(s.optical, R_camera_brick=spin), s.optical.t_ns)
    with pytest.raises(ShapeError, match="output_t_ns"):
        smooth_optical(s.optical, s.optical.t_ns[:, None])


def test_a_frame_lost_where_the_brick_is_put_elsewhere_is_as_unsure_as_the_jump_is_wide():
    # As in a sweep of poses, one a frame: steady steps, then elsewhere, and the first picture there is lost.
    rng = np.random.default_rng(2)
    s = simulate_shake(4, duration_s=0.7, amplitude_mm=0.0, rotation_deg=0.0)
    n, jump_mm = len(s.optical.t_ns), np.array([47.0, 0.0, -31.0])
    true_mm = 5.7 * np.arange(n)[:, None] * [0.0, 0.0, 1.0] + (np.arange(n) >= 10)[:, None] * jump_mm
    seen_mm = true_mm + rng.normal(0, 0.02, (n, 3))
    R = np.broadcast_to(s.R[0], (n, 3, 3)) @ Rotation.from_rotvec(rng.normal(0, 5e-4, (n, 3))).as_matrix()
    seen_mm[10], R[10] = np.nan, np.nan
    sd = np.repeat([5e-4, 0.02], 3)
    optical = replace(
        s.optical,
        R_camera_brick=R,
        t_camera_brick_mm=seen_mm,
        covariance=np.broadcast_to(np.diag(sd**2), (n, 6, 6)),
    )
    track = smooth_optical(optical, optical.t_ns)
    off_mm = track.t_camera_brick_mm - true_mm
    chi2 = (off_mm * np.linalg.solve(track.covariance[:, 3:, 3:], off_mm[..., None])[..., 0]).sum(axis=1)
    assert np.delete(np.abs(off_mm), 10, axis=0).max() < 0.1  # five sd of a frame
    assert np.linalg.norm(off_mm[10]) > 10  # nothing tells which side of the jump it is on
    assert chi2[10] < 16.3 and np.delete(chi2, 10).mean() < 6.0  # 3 degrees of freedom: one in 1000
    marked = (track.flags & int(PoseFlag.IMPACT)) != 0
    assert np.flatnonzero(marked).tolist() == [10]


def test_sharp_frames_of_a_fast_shake_choose_a_roughness_that_follows_them():
    s = simulate_shake(1, duration_s=5.0, position_sd_mm=0.02, rotation_sd_deg=0.02)
    track = smooth_optical(s.optical, s.optical.t_ns, settings=WHITE)
    # Frames are good to 0.02 mm; were they taken for outliers, the motion's millimetres would be smoothed away.
    assert np.sqrt((errors(s, track)[:, 3:] ** 2).mean()) < 0.022
    assert not (track.flags & int(PoseFlag.IMPACT)).any()
