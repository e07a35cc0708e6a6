from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, ncx2

from bricktrack_common.rotations import matrix_from_rvec
from bricktrack_host.fusion.cross_check import cross_check
from bricktrack_host.tracks import FusedTrack

N = 20_000
SD = np.array([1e-4, 2e-4, 1e-4, 0.01, 0.02, 0.03])  # rad, mm


def track(errors, sd):
    return FusedTrack(
        t_ns=np.arange(N, dtype=np.int64), R_camera_brick=matrix_from_rvec(errors[:, :3]),
        t_camera_brick_mm=errors[:, 3:], omega_brick_radps=np.zeros((N, 3)), v_camera_mmps=np.zeros((N, 3)),
        covariance=np.broadcast_to(np.diag(sd**2), (N, 6, 6)), flags=np.zeros(N, dtype=np.int64),
    )  # fmt: skip


def drawn(sd, seed):
    return track(np.random.default_rng(seed).normal(size=(N, 6)) * sd, sd)


@pytest.mark.parametrize(("sd_leds", "sd_poses"), [(SD, SD), (0.1 * SD, SD), (SD, 0.1 * SD)])
def test_two_motions_as_unsure_as_they_say_agree(sd_leds, sd_poses):
    check = cross_check(drawn(sd_leds, 1), drawn(sd_poses, 2))
    assert check.agrees
    # One in 1000 of 20,000 is known to a fifth.
    assert check.share_apart == pytest.approx(1e-3, rel=0.6)


@pytest.mark.parametrize("axis", range(6))
def test_a_motion_that_is_off_by_more_than_both_allow_does_not_agree(axis):
    off = np.zeros(6)
    off[axis] = 4.0 * np.hypot(SD[axis], 0.3 * SD[axis])
    here, there = drawn(0.3 * SD, 3), drawn(SD, 4)
    turn = here.R_camera_brick @ matrix_from_rvec(off[:3])
    moved = replace(here, R_camera_brick=turn, t_camera_brick_mm=here.t_camera_brick_mm + off[3:])
    check = cross_check(moved, there)
    assert not check.agrees
    # The squares are those of six normal numbers, one of which is 4 off.
    assert check.share_apart == pytest.approx(ncx2.sf(22.5, 6, 16.0), abs=0.02)


def test_where_one_of_both_is_not_known_nothing_agrees():
    unknown = replace(drawn(SD, 5), t_camera_brick_mm=np.full((N, 3), np.nan))
    check = cross_check(unknown, drawn(SD, 6))
    assert not check.agrees
    assert np.isnan(check.max_mm)
    assert chi2.sf(22.5, 6) == pytest.approx(1e-3, rel=0.02)  # what "one in 1000" is
