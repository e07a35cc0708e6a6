"""Outliers among the first frames, which nothing before them contradicts."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from brick_shakes import LEVER_ARM_MM, simulate_shake
from broad_windows import Recipe, make_case

from bricktrack_host.fusion.estimate import fuse


def false_positions(shake, frames, *, off_mm=8.0):
    """Return the optical track with frames thrown off, each in its own direction."""
    p = shake.optical.t_camera_brick_mm.copy()
    away = np.random.default_rng(3).normal(0, 1, (len(frames), 3))
    p[frames] += off_mm * away / np.linalg.norm(away, axis=1)[:, None]
    return replace(shake.optical, t_camera_brick_mm=p)


@pytest.mark.parametrize("frames", [[0], [1], [2], [0, 1, 3], [1, 4, 5, 9]])
def test_false_positions_among_the_first_frames_are_left_out(frames):
    s = simulate_shake(61, duration_s=3.5)
    wanted = s.optical.t_ns[:30]
    r = fuse(false_positions(s, frames), s.imu, lever_arm_mm=LEVER_ARM_MM, output_t_ns=wanted)
    assert np.flatnonzero(r.frame_rejected[:30]).tolist() == frames
    off_mm = np.linalg.norm(r.track.t_camera_brick_mm - s.truth(wanted)[1], axis=1)
    assert off_mm.max() < 0.4  # frames are good to 0.17 mm, a length


@pytest.mark.skipif("BRICKTRACK_SAMPLES" not in os.environ, reason="BRICKTRACK_SAMPLES is not set")
def test_a_false_second_frame_of_a_real_recording_does_not_carry_its_neighbours_along():
    window = Path(os.environ["BRICKTRACK_SAMPLES"]) / "fusion" / "dev_27_a.npz"
    case = make_case(window, seed=0, recipe=Recipe(outlier_share=0.03))
    t_ns = case.t_out_ns[:50]
    r = fuse(case.optical, case.imu, lever_arm_mm=LEVER_ARM_MM, output_t_ns=t_ns)
    assert r.frame_rejected[1]
    off_mm = np.linalg.norm(r.track.t_camera_brick_mm - case.t_true_mm[:50], axis=1)
    assert off_mm.max() < 0.5  # frames and reference together scatter by 0.2 mm, a length
