"""Motion between the smoother's nodes: what of it is given out, and what is not."""

from dataclasses import replace

import numpy as np
import pytest
from daemon_runs import simulate_run

from bricktrack_host.fusion.clocks.time_alignment import MIN_ROTATION_SD_RAD
from bricktrack_host.fusion.estimate import FusionInput, prepare_run
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.pose_by_pose.fused_output import common_part, sample_motion
from bricktrack_host.fusion.pose_by_pose.pose_level import smooth_poses
from bricktrack_host.quality import PoseFlag
from bricktrack_host.tracking.optical_track import solve_poses

SETTINGS = FusionSettings()


@pytest.fixture(scope="module")
def smoothed():
    run = simulate_run(41, duration_s=3.0)
    optical = solve_poses(run.observations, run.camera, run.brick)
    item = FusionInput(optical, run.imu, run.lever_arm_mm, optical.t_ns[5:-5])
    return smooth_poses([prepare_run(item, SETTINGS)], SETTINGS)[0], optical.t_ns[5:-5], optical


def sampled(smoothed, t_ns, estimate):
    s = smoothed
    return sample_motion(
        s.run, s.nodes, s.problem, estimate, s.b, output_t_ns=t_ns, seen_cam_s=s.run.t_cam_s,
        common=np.zeros((6, 6)), settings=SETTINGS, is_smoothed=True,
    )  # fmt: skip


def test_instants_give_the_same_alone_and_together_in_any_order(smoothed):
    s, t_ns, _ = smoothed
    together = sampled(s, np.tile(t_ns[::-1], 2), s.estimate)
    assert np.isfinite(together.t_camera_brick_mm).all()
    for i in (0, 20, len(t_ns) + 3):
        alone = sampled(s, together.t_ns[i : i + 1], s.estimate)
        assert alone.t_camera_brick_mm[0] == pytest.approx(together.t_camera_brick_mm[i], abs=1e-10)
        assert alone.v_camera_mmps[0] == pytest.approx(together.v_camera_mmps[i], abs=1e-8)


@pytest.mark.parametrize("wrong", ["negative", "nan", "more than wholly correlated"])
def test_a_pose_whose_covariance_is_none_is_no_pose(smoothed, wrong):
    s, t_ns, _ = smoothed
    covariance = s.estimate.covariance.copy()
    at = slice(len(s.nodes.t_s) // 3, len(s.nodes.t_s) // 3 + 30)
    of = covariance[at, s.b]
    if wrong == "more than wholly correlated":
        of[:, 3, 4] = of[:, 4, 3] = 1.5 * np.sqrt(of[:, 3, 3] * of[:, 4, 4])
    else:
        of[:, 3, 3] = np.nan if wrong == "nan" else -of[:, 3, 3]
    track = sampled(s, t_ns, replace(s.estimate, covariance=covariance))
    lost = (track.flags & int(PoseFlag.NO_POSE)) != 0
    assert 5 < lost.sum() < 20  # 30 nodes of about 10 ms, frames every 33 ms
    for values in (track.t_camera_brick_mm, track.R_camera_brick, track.covariance, track.v_camera_mmps):
        assert np.array_equal(lost, np.isnan(values.reshape(len(lost), -1)).all(axis=1))
    diagonal = np.diagonal(track.covariance[~lost], axis1=1, axis2=2)
    assert (diagonal > 0).all()


def test_what_frames_share_is_a_covariance_however_they_differ(smoothed):
    # Frames of three kinds: the medians of their elements are no covariance.
    together = np.repeat([[1.0, 1.0, 1.0], [1.0, 1.0, -1.0], [1.0, -1.0, -1.0]], 20, axis=0)
    sd = np.repeat([1e-3, 1e-2], 3)
    covariances = np.tile(np.eye(6), (60, 1, 1))
    covariances[:, :3, :3] = 0.1 * np.eye(3) + 0.9 * together[:, :, None] * together[:, None, :]
    covariances *= np.outer(sd, sd)
    assert np.linalg.eigvalsh(np.median(covariances, axis=0) / np.outer(sd, sd))[0] < -0.5
    run = replace(smoothed[0].run, cov_seen=covariances, shared_seen=None)
    common = common_part(run, np.array([0.5, 0.5]), share=0.3)
    assert np.linalg.eigvalsh(common / np.outer(sd, sd))[0] > 0


def test_what_poses_say_that_they_share_is_taken_out_of_each_and_put_back_once(smoothed):
    run = smoothed[0].run
    optical = smoothed[2]
    to_mm = np.repeat([1.0, 1e3], 3)
    whole = (run.cov_seen + run.shared_seen) * to_mm[:, None] * to_mm
    floor = np.diag(np.repeat([MIN_ROTATION_SD_RAD**2, 4e-6], 3))  # 2 um
    assert whole == pytest.approx(optical.covariance[run.frame] + floor, rel=1e-9, abs=1e-15)
    assert (np.linalg.eigvalsh(run.cov_seen)[:, 0] > 0).all()
    common = common_part(run, np.ones(2), share=0.3)
    assert (np.abs(run.shared_seen - common).max(axis=(1, 2)) == 0).any()
