"""Whole-period slips of frame stamps: found where they are, mended, and never seen where there are none."""

from dataclasses import replace

import numpy as np
import pytest
from brick_shakes import simulate_shake
from slipped_stamps import double, slip

from bricktrack_common.arrays import rows_of
from bricktrack_host.fusion.clocks.slip_search import find_slips
from bricktrack_host.fusion.clocks.stamp_slips import StampSlip, mend
from bricktrack_host.fusion.clocks.time_alignment import align_times
from bricktrack_host.quality import LedFlag, PoseFlag
from bricktrack_host.stages.clocks import with_stamps_mended
from bricktrack_host.tracks import LedObservations

DROPOUT = (4.0, 4.4)
PRIOR_NS = 5e6


@pytest.fixture(scope="module")
def shake():
    return simulate_shake(1, offset_s=0.002, impacts=4, dropouts=(DROPOUT,))


def search(shake, optical, *, prior_sd_ns=PRIOR_NS):
    def aligned(poses):
        return align_times(poses, shake.imu, prior_sd_ns=prior_sd_ns)

    return find_slips(optical, shake.imu, aligned(optical), aligned, prior_sd_ns=prior_sd_ns)


def test_stamps_that_are_right_are_left_alone(shake):
    assert search(shake, shake.optical) is None
    n = len(shake.optical.t_ns)
    kept = np.setdiff1d(np.arange(n), [50, 90, 91, 92, 150])
    assert search(shake, rows_of(shake.optical, kept)) is None


@pytest.mark.parametrize(("frame", "late"), [(100, 1), (100, -1), (160, 2), (46, 1), (46, -1)])
def test_a_slip_is_located_and_the_stamps_mended(shake, frame, late):
    optical = slip(shake.optical, frame, late)
    found = search(shake, optical)
    (one,) = found.slips
    assert one.late_periods == late
    assert one.first <= frame <= one.last <= one.first + 2
    # The truth is what the pictures were taken at, before anything slipped.
    taken_ns = (
        np.delete(shake.optical.t_ns, np.arange(frame, frame - late)) if late < 0 else shake.optical.t_ns
    )
    sure = ~found.left_out & (found.sd_ns == 0)
    # The period is fitted to 240 stamps, which the simulation puts on a grid of 0.25 ms.
    assert np.abs(found.t_ns - taken_ns)[sure].max() < 0.3e6
    assert found.is_side_told
    assert found.alignment.offset_ns == pytest.approx(2e6, abs=0.5e6)
    mended = found.mended(optical)
    assert ((mended.flags[frame + 2 :] & int(PoseFlag.RESTAMPED)) != 0).all()
    assert not (mended.flags[: frame - 2] & int(PoseFlag.RESTAMPED)).any()
    assert "1 period " in found.words()[0] if abs(late) == 1 else "2 periods " in found.words()[0]
    assert f"too {'late' if late > 0 else 'early'}" in found.words()[0]


def test_two_slips_are_both_found(shake):
    found = search(shake, slip(slip(shake.optical, 70, 1), 160, -1))
    assert [s.late_periods for s in found.slips] == [1, -1]
    assert [abs(s.frame - at) <= 1 for s, at in zip(found.slips, (70, 160), strict=True)] == [True, True]
    assert not found.late_periods[161:].any()
    assert len(found.words()) == 3


def test_a_picture_that_is_there_twice_gives_one_pose(shake):
    found = search(shake, double(shake.optical, 100))
    (one,) = found.slips
    assert one.late_periods == 1 and one.first <= 100 <= one.last
    assert found.left_out.sum() >= 1
    assert (np.diff(found.t_ns) > 0).all()


def test_a_slip_among_frames_without_a_pose_leaves_them_out(shake):
    frame = round(4.2 * 30.0058)
    found = search(shake, slip(shake.optical, frame, 1))
    (one,) = found.slips
    assert one.first <= frame <= one.last
    unseen = np.isnan(shake.optical.t_camera_brick_mm[:, 0])
    assert found.left_out[np.flatnonzero(unseen)[:-1]].all()
    assert "in between left out" in found.words()[-1]


def test_a_slip_within_a_gap_of_the_inertial_samples_is_at_the_interval_that_is_longer():
    shake = simulate_shake(6, duration_s=4.0, offset_s=0.002, imu_gaps=((1.9, 2.3),))
    frame = round(2.1 * 30.0058)
    (one,) = search(shake, slip(shake.optical, frame, 1)).slips
    assert (one.first, one.last, one.late_periods) == (frame, frame, 1)
    # Pictures lost leave no such interval: all frames within the gap may be the first behind.
    early = search(shake, slip(shake.optical, frame, -1))
    (one,) = early.slips
    assert one.first < frame - 3 and one.last > frame + 3 and one.late_periods == -1
    assert early.left_out[one.first + 1 : one.last - 1].all()


def test_a_gap_of_the_inertial_samples_is_no_slip():
    shake = simulate_shake(6, duration_s=4.0, offset_s=0.002, imu_gaps=((1.9, 2.3),))
    kept = np.setdiff1d(np.arange(len(shake.optical.t_ns)), [63])
    assert search(shake, shake.optical) is None
    assert search(shake, rows_of(shake.optical, kept)) is None


def test_clocks_that_promise_nothing_do_not_tell_which_side_is_right(shake):
    found = search(shake, slip(shake.optical, 100, 1), prior_sd_ns=0.25e9)
    assert not found.is_side_told
    assert not found.late_periods[:99].any() and (found.late_periods[101:] == 1).all()
    assert "those before the first slip were kept" in found.words()[-1]


def test_the_side_that_the_clocks_promise_is_right_though_it_comes_last(shake):
    # From the first frame on a period late, and at frame 100 the slip is gone.
    late = replace(shake.optical, t_ns=shake.optical.t_ns + round(1e9 / 30.0058))
    found = search(shake, slip(late, 100, -1))
    assert found.is_side_told
    assert (found.late_periods[:98] == 1).all() and not found.late_periods[102:].any()


def test_a_step_that_is_no_whole_period_is_no_slip(shake):
    t_ns = shake.optical.t_ns.copy()
    t_ns[100:] += 25_000_000
    assert search(shake, replace(shake.optical, t_ns=t_ns)) is None


def test_inertial_samples_that_step_are_not_taken_for_frames_that_slip(shake):
    # Three samples lost without a word are 30 ms, a tenth of a period less than a frame.
    imu_ns = shake.imu.t_ns.copy()
    imu_ns[450:] += 30_000_000
    stepped = replace(shake, imu=replace(shake.imu, t_ns=imu_ns))
    assert search(stepped, shake.optical) is None


def test_a_motion_that_repeats_says_nothing_for_certain():
    # At 10 Hz three frames are a period of the motion: two lost look like one that is there twice.
    steady = simulate_shake(2, offset_s=0.002, periodic_hz=30.0058 / 3)
    alike = rows_of(steady.optical, slice(50, 190))  # neither its beginning nor its end
    assert search(steady, slip(alike, 70, -2)) is None


def test_a_brick_that_does_not_turn_tells_nothing():
    still = simulate_shake(4, rotation_deg=0.0)
    assert search(still, slip(still.optical, 120, 1)) is None


def test_frames_at_rest_are_kept_where_the_place_is_in_doubt(shake):
    # The brick rests for 0.8 s: the poses there are as good at one stamp as at the other.
    n = len(shake.optical.t_ns)
    late = np.where(np.arange(n) < 10, 0, 1)
    found = mend(
        shake.optical, [StampSlip(10, 6, 14, 1)], late,
        period_ns=1e9 / 30.0058, is_side_told=True, alignment=align_times(shake.optical, shake.imu),
    )  # fmt: skip
    assert np.flatnonzero(found.sd_ns).size >= 6
    assert found.sd_ns[6:14].max() == pytest.approx(1e9 / 30.0058)
    assert found.left_out.sum() <= 2  # the copy that a slip without a hole means, and one pose in a thousand


def test_the_leds_of_frames_without_an_instant_are_taken_out_and_stamps_moved(shake):
    optical = rows_of(shake.optical, slice(40))
    late = np.where(np.arange(40) < 20, 0, 1)
    found = mend(
        optical, [StampSlip(20, 20, 20, 1)], late,
        period_ns=1e9 / 30.0058, is_side_told=True, alignment=align_times(shake.optical, shake.imu),
    )  # fmt: skip
    read_out_ns = optical.t_ns - 9_000_000
    seen = LedObservations(
        sensor_timestamp_ns=read_out_ns,
        exposure_ns=np.full(40, 2_000_000),
        uv_px=np.ones((40, 7, 2)),
        cov_px2=np.tile(np.eye(2), (40, 7, 1, 1)),
        area_px2=np.ones((40, 7)),
        led_flags=np.zeros((40, 7), dtype=np.int64),
        frame_flags=np.zeros(40, dtype=np.int64),
    )
    mended = with_stamps_mended(seen, found, optical.t_ns)
    # Frame 20 is a copy of frame 19: half-way to the next, and without LEDs.
    assert np.flatnonzero(np.isnan(mended.uv_px).any(axis=(1, 2))).tolist() == [20]
    assert (mended.led_flags[20] == int(LedFlag.MISSING)).all()
    moved_ns = mended.sensor_timestamp_ns - read_out_ns
    assert not moved_ns[:20].any()
    np.testing.assert_allclose(moved_ns[21:], -1e9 / 30.0058, atol=1)
    assert read_out_ns[19] < mended.sensor_timestamp_ns[20] < mended.sensor_timestamp_ns[21]
    assert np.flatnonzero(mended.frame_flags).tolist() == [*range(20, 40)]
