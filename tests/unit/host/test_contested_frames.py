"""Frames between outlier and noise: the fused pose meets them half-way, and says so."""

from dataclasses import replace

import numpy as np
from brick_shakes import LEVER_ARM_MM, simulate_shake
from scipy.spatial.transform import Rotation

from bricktrack_host.fusion.contested_frames import with_contested_frames
from bricktrack_host.fusion.estimate import fuse
from bricktrack_host.quality import PoseFlag
from bricktrack_host.tracks import FusedTrack

PERIOD_NS = 33_000_000


def still(t_ns):
    """Return a brick at rest, known to 0.1 mm and 1 mrad."""
    n = len(t_ns)
    return FusedTrack(
        t_ns=t_ns,
        R_camera_brick=np.broadcast_to(np.eye(3), (n, 3, 3)),
        t_camera_brick_mm=np.zeros((n, 3)),
        omega_brick_radps=np.zeros((n, 3)),
        v_camera_mmps=np.zeros((n, 3)),
        covariance=np.broadcast_to(np.diag(np.repeat([1e-6, 1e-2], 3)), (n, 6, 6)),
        flags=np.zeros(n, dtype=np.int64),
    )


def test_the_pose_lies_between_frame_and_samples_and_fades_within_a_period():
    t_ns = np.array([-PERIOD_NS, -PERIOD_NS // 2, 0, PERIOD_NS])
    R_seen = Rotation.from_rotvec([[0, 0.02, 0]]).as_matrix()
    met = with_contested_frames(
        still(t_ns), still(t_ns[2:3]), R_seen, np.array([[1.0, 0, 0]]), period_ns=PERIOD_NS
    )
    np.testing.assert_allclose(met.t_camera_brick_mm[:, 0], [0, 0.25, 0.5, 0], atol=1e-12)
    turned = Rotation.from_matrix(met.R_camera_brick).as_rotvec()
    np.testing.assert_allclose(turned[:, 1], [0, 0.005, 0.01, 0], atol=1e-12)
    # Two answers a distance d apart, as likely each: variance d^2 / 4, and both go together.
    np.testing.assert_allclose(met.covariance[:, 3, 3], 1e-2 + np.array([0, 0.0625, 0.25, 0]), atol=1e-12)
    np.testing.assert_allclose(met.covariance[2, 1, 3], 0.25 * 0.02 * 1.0, atol=1e-12)
    assert met.flags.tolist() == [0, PoseFlag.CONTESTED, PoseFlag.CONTESTED, 0]


def test_neighbours_that_agree_are_met_as_one():
    t_ns = np.arange(0, PERIOD_NS + 1, PERIOD_NS // 3)
    frames = still(np.array([0, PERIOD_NS]))
    seen_mm = np.array([[0, 2.0, 0], [0, 2.0, 0]])
    met = with_contested_frames(still(t_ns), frames, frames.R_camera_brick, seen_mm, period_ns=PERIOD_NS)
    np.testing.assert_allclose(met.t_camera_brick_mm[:, 1], 1.0, atol=1e-12)


def test_a_frame_two_millimetres_off_is_met_and_one_eight_off_is_not():
    s = simulate_shake(44, duration_s=4.0)
    p = s.optical.t_camera_brick_mm.copy()
    p[40, 0] += 1.5
    p[80, 0] += 8.0
    r = fuse(
        replace(s.optical, t_camera_brick_mm=p),
        s.imu,
        lever_arm_mm=LEVER_ARM_MM,
        output_t_ns=s.optical.t_ns[:-1],
    )
    assert np.flatnonzero(r.frame_rejected).tolist() == [40, 80]
    contested = (r.track.flags & int(PoseFlag.CONTESTED)) != 0
    assert np.flatnonzero(contested).tolist() == [40]
    _, truth_mm = s.truth(r.track.t_ns)
    error_mm = r.track.t_camera_brick_mm - truth_mm
    assert 0.6 < error_mm[40, 0] < 0.9  # half of 1.5 mm; frames are good to 0.1 mm
    assert abs(error_mm[80, 0]) < 0.3
    sd_mm = np.sqrt(r.track.covariance[[40, 80], 3, 3])
    assert sd_mm[0] > 0.6
    assert sd_mm[1] < 0.2
