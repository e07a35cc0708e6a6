"""Frames' stamps against the camera's rate and the inertial samples, on simulated shakes."""

from dataclasses import replace

import numpy as np
import pytest
from brick_shakes import simulate_shake

from bricktrack_common.arrays import rows_of
from bricktrack_host.fusion.clocks.frame_stamps import check_stamps, offset_change
from bricktrack_host.fusion.clocks.stamp_regularity import stamp_regularity
from bricktrack_host.fusion.clocks.time_alignment import align_times
from bricktrack_host.fusion.pose_by_pose.fused_output import unsure_times
from bricktrack_host.quality import PoseFlag
from bricktrack_host.stages.motion import with_restamped_told, with_unsure_times
from bricktrack_host.tracks import FusedTrack

PERIOD_NS = 31_250_000  # 32 Hz: a whole number of the simulation's 4 kHz steps
STEP_NS = 5_000_000
AT = 96


@pytest.fixture(scope="module")
def shake():
    return simulate_shake(3, frame_rate_hz=32.0, duration_s=6.0, offset_s=0.01)


def checked(shake, stamps_ns, frames=None, *, is_taken_then=False):
    """Return what the stamps are found to be; the pictures taken when stamped, or evenly all the same."""
    optical = rows_of(shake.optical, slice(len(stamps_ns)) if frames is None else frames)
    optical = replace(optical, t_ns=stamps_ns)
    if is_taken_then:
        R, t_mm = shake.truth(stamps_ns)
        optical = replace(optical, R_camera_brick=R, t_camera_brick_mm=t_mm)
    return check_stamps(stamps_ns, optical, shake.imu, align_times(optical, shake.imu)), optical


def stepped(shake, size_ns=STEP_NS, at=AT):
    stamps = shake.optical.t_ns.copy()
    stamps[at:] += size_ns
    return stamps


def test_nothing_is_said_against_regular_stamps(shake):
    check, _ = checked(shake, shake.optical.t_ns)
    assert check.problems == ()
    assert not check.sd_ns.any()
    assert check.regularity.is_steady
    assert check.regularity.period_ns == pytest.approx(PERIOD_NS, abs=1)


def test_dropped_frames_are_whole_periods_and_no_step(shake):
    kept = np.setdiff1d(np.arange(len(shake.optical.t_ns)), [20, 21, 60, 61, 62, 63, 64, 65, 130])
    check, _ = checked(shake, shake.optical.t_ns[kept], kept)
    assert check.problems == ()
    assert not check.sd_ns.any()


def test_microseconds_of_jitter_and_of_rounding_are_no_problem(shake):
    rng = np.random.default_rng(1)
    late = rng.exponential(20e3, len(shake.optical.t_ns)).astype(np.int64)  # an interrupt's
    check, _ = checked(shake, (shake.optical.t_ns + late) // 1000 * 1000)
    assert check.problems == ()


@pytest.mark.parametrize("size_ns", [STEP_NS, -STEP_NS])
def test_a_step_is_told_with_place_and_size_and_all_poses_are_unsure(shake, size_ns):
    check, _ = checked(shake, stepped(shake, size_ns))
    (said,) = check.problems
    assert f"step by {size_ns / 1e6:+.2f} ms between frames {AT - 1} and {AT}" in said
    assert f"{(PERIOD_NS + size_ns) / 1e6:.2f} ms is" in said
    assert "the stamps are wrong" in said
    assert check.sd_ns == pytest.approx(abs(size_ns), abs=20)  # the fitted period is a float of ns


def test_a_step_after_dropped_frames_is_told_too(shake):
    kept = np.setdiff1d(np.arange(len(shake.optical.t_ns)), [AT - 2, AT - 1])
    check, _ = checked(shake, stepped(shake)[kept], kept)
    (said,) = check.problems
    assert f"step by +5.00 ms between frames {AT - 3} and {AT - 2}: 98.75 ms" in said


def test_the_motion_measures_the_step_whatever_else_took_it_for_drift():
    # Ten fits of 0.18 ms on both sides; the floor of 0.3 ms is in the sd besides.
    for seed in range(5):
        s = simulate_shake(seed, frame_rate_hz=32.0, duration_s=6.0, offset_s=0.01)
        t_ns = stepped(s)
        optical = replace(s.optical, t_ns=t_ns)
        alignment = align_times(optical, s.imu)
        change = offset_change(
            optical, s.imu, alignment, split_ns=int(t_ns[AT]), from_ns=int(t_ns[0]), to_ns=int(t_ns[-1])
        )
        assert change is not None
        assert abs(change.change_s + 5e-3) < 3 * change.sd_s < 1.5e-3


def test_a_camera_that_paused_is_believed_where_the_motion_says_so(shake):
    check, _ = checked(shake, stepped(shake), is_taken_then=True)
    (said,) = check.problems
    assert "the camera paused, and the stamps are believed" in said
    assert not check.sd_ns.any()


def test_without_inertial_samples_a_step_is_told_and_left_open(shake):
    stamps = stepped(shake)
    check = check_stamps(stamps, replace(shake.optical, t_ns=stamps), None, None)
    assert "does not tell whether the camera paused or the stamps are wrong" in check.problems[0]
    assert check.sd_ns.min() == pytest.approx(STEP_NS, abs=20)


def test_jitter_is_told_with_its_size(shake):
    rng = np.random.default_rng(2)
    n = len(shake.optical.t_ns)
    check, _ = checked(shake, shake.optical.t_ns + np.rint(rng.normal(0, 500e3, n)).astype(np.int64))
    (said,) = check.problems
    assert "scatter by 0." in said and "about a steady period" in said
    # sd of an sd from 190 stamps: 5 %; four of these
    assert check.sd_ns == pytest.approx(500e3, rel=0.2)


def test_stamps_rounded_to_milliseconds_scatter_by_what_rounding_does(shake):
    check, _ = checked(shake, shake.optical.t_ns // 1_000_000 * 1_000_000)
    assert len(check.problems) == 1 and "made late or rounded" in check.problems[0]
    # Evenly spread over 1 ms; 31.25 ms leaves only four different remainders: 1 ms x sqrt(15 / 192)
    assert check.sd_ns == pytest.approx(0.28e6, rel=0.1)


@pytest.mark.parametrize("frame", [0, 50, 191])
def test_one_late_stamp_makes_that_frame_unsure_and_no_other(shake, frame):
    stamps = shake.optical.t_ns.copy()
    assert len(stamps) == 192
    stamps[frame] += 3_000_000
    check, _ = checked(shake, stamps)
    (said,) = check.problems
    assert f"1 frame stamp off a steady period of 31.250 ms, most that of frame {frame} by +3.00 ms" in said
    assert np.flatnonzero(check.sd_ns).tolist() == [frame]
    assert check.sd_ns[frame] == pytest.approx(3e6, abs=100)


def _ramp(n):
    return np.linspace(30e6, 38e6, n)


def _other_rate_from_the_middle(n):
    return np.where(np.arange(n) < n // 2, 33e6, 40e6)


def _as_the_light_allows(n):
    return np.random.default_rng(4).uniform(25e6, 50e6, n)


@pytest.mark.parametrize("intervals", [_ramp, _other_rate_from_the_middle, _as_the_light_allows])
def test_a_variable_rate_is_said_and_stops_nothing(shake, intervals):
    stamps = shake.optical.t_ns[0] + np.cumsum(intervals(150)).astype(np.int64)
    check, _ = checked(shake, stamps, is_taken_then=True)
    (said,) = check.problems
    lowest, highest = intervals(150)[1:].min() / 1e6, intervals(150)[1:].max() / 1e6
    assert f"the intervals vary from {lowest:.2f} to {highest:.2f} ms" in said
    assert not check.sd_ns.any()  # nothing speaks against such stamps


def test_a_slip_by_a_whole_period_shows_in_the_motion(shake):
    # No interval tells it from a dropped frame.
    check, _ = checked(shake, stepped(shake, PERIOD_NS))
    assert check.regularity.steps == ()
    assert "from the first half of the run to the second" in check.problems[0]
    assert check.sd_ns.min() > 0.5 * PERIOD_NS


def test_a_rate_that_no_crystal_has_is_told():
    shake = simulate_shake(0, frame_rate_hz=32.0, duration_s=15.0)
    t_ns = shake.optical.t_ns
    scaled = t_ns[0] + np.rint((t_ns - t_ns[0]) * 1.001).astype(np.int64)
    check, _ = checked(shake, scaled)
    (said,) = check.problems
    assert "run apart by -9" in said or "run apart by -10" in said  # ppm; the fit's sd is 11
    assert check.sd_ns == pytest.approx(7.5e6, rel=0.05)


def test_stamps_that_slipped_before_the_brick_turned_make_the_whole_run_unsure():
    shake = simulate_shake(3, frame_rate_hz=32.0, duration_s=6.0, offset_s=0.005)
    check, _ = checked(shake, stepped(shake, -PERIOD_NS, at=0))
    (said,) = check.problems
    assert "36.3 ms between camera and IMU" in said or "36.2 ms between camera and IMU" in said
    assert "whole periods of 31.25 ms" in said
    assert check.is_contradicted
    assert check.sd_ns == pytest.approx(36.25e6, abs=0.4e6)


def test_samples_that_grow_old_by_less_than_one_interval_are_no_contradiction():
    # A sensor's own clock, 600 ppm slow and read by ours: 5 ms in 8 s, before it beats for the first time.
    shake = simulate_shake(0, frame_rate_hz=32.0, skew=-6e-4)
    check, _ = checked(shake, shake.optical.t_ns)
    assert check.problems == ()
    assert not check.sd_ns.any()


@pytest.mark.parametrize("n", [0, 1, 2, 11])
def test_a_few_frames_tell_nothing(n):
    found = stamp_regularity(np.arange(n, dtype=np.int64) ** 2 * 1_000_000)
    assert not found.is_steady and found.steps == () and len(found.stray_ns) == n


def still_moving(t_ns, v_mmps):
    n = len(t_ns)
    return FusedTrack(
        t_ns=t_ns,
        R_camera_brick=np.broadcast_to(np.eye(3), (n, 3, 3)),
        t_camera_brick_mm=np.zeros((n, 3)),
        omega_brick_radps=np.tile([0.0, 0.2, 0.0], (n, 1)),
        v_camera_mmps=v_mmps,
        covariance=np.zeros((n, 6, 6)),
        flags=np.zeros(n, dtype=np.int64),
    )


def test_unsure_time_becomes_the_motion_in_that_time():
    t_ns = np.arange(100, dtype=np.int64) * 10_000_000
    track = still_moving(t_ns, np.tile([300.0, 0.0, 0.0], (100, 1)))
    frames_ns, sd_ns = t_ns[::10], np.full(10, 5e6)
    covariance, flags = unsure_times(t_ns[:91], frames_ns, sd_ns, track)
    moved = np.array([0.0, 0.2 * 5e-3, 0.0, 300 * 5e-3, 0.0, 0.0])
    aside = 0.3**2 * np.diag(np.repeat([moved[1] ** 2, moved[3] ** 2], 3))  # the velocity is unsure itself
    assert np.allclose(covariance, np.outer(moved, moved) + aside)
    assert (flags == int(PoseFlag.UNSURE_TIME)).all()


def test_where_the_motion_turns_round_it_is_not_sure_either():
    # x = a t^2 / 2 about t = 0: 5 ms off is 0.5 x 10 m/s^2 x (5 ms)^2 = 0.125 mm
    t_ns = np.arange(-50, 51, dtype=np.int64) * 1_000_000
    v = np.stack([10_000 * t_ns * 1e-9, 0 * t_ns, 0 * t_ns], axis=1)
    covariance, _ = unsure_times(np.array([0]), t_ns, np.full(101, 5e6), still_moving(t_ns, v))
    assert np.sqrt(covariance[0, 3, 3]) == pytest.approx(0.125 * np.hypot(1, 0.3))


def test_unknown_velocity_leaves_the_covariance_unknown():
    t_ns = np.arange(10, dtype=np.int64) * 1_000_000
    covariance, _ = unsure_times(t_ns, t_ns, np.full(10, 1e6), still_moving(t_ns, np.full((10, 3), np.nan)))
    assert np.isnan(covariance).all()


def test_only_what_is_unsure_is_widened(shake):
    optical = shake.optical
    n = len(optical.t_ns)
    fused = {"frame": still_moving(optical.t_ns, np.tile([300.0, 0.0, 0.0], (n, 1)))}
    assert with_unsure_times(optical, fused, np.zeros(n)) == (optical, fused)
    sd_ns = np.zeros(n)
    sd_ns[50] = 3e6
    poses, tracks = with_unsure_times(optical, fused, sd_ns)
    for before, after in ((optical, poses), (fused["frame"], tracks["frame"])):
        grown = np.sqrt((after.covariance - before.covariance)[:, 3, 3])
        assert grown[50] == pytest.approx(0.9 * np.hypot(1, 0.3))
        assert np.flatnonzero(grown > 1e-9).tolist() == [50]
        assert np.flatnonzero(after.flags & PoseFlag.UNSURE_TIME).tolist() == [50]


def test_fused_motion_between_mended_frames_is_told_as_they_are(shake):
    mended = np.zeros(len(shake.optical.t_ns), dtype=bool)
    mended[[20, 21, 40]] = True
    optical = replace(shake.optical, flags=shake.optical.flags | np.where(mended, int(PoseFlag.RESTAMPED), 0))
    t_ns = np.unique(np.concatenate([optical.t_ns, optical.t_ns[:-1] + PERIOD_NS // 3]))
    fused = {"imu": still_moving(t_ns, np.zeros((len(t_ns), 3)))}
    told = with_restamped_told(optical, fused)["imu"]
    expected = [optical.t_ns[20], optical.t_ns[20] + PERIOD_NS // 3, optical.t_ns[21], optical.t_ns[40]]
    assert t_ns[told.flags & int(PoseFlag.RESTAMPED) != 0].tolist() == expected
    assert with_restamped_told(shake.optical, fused) is fused
