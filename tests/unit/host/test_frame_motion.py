"""How far a spline through frames may be trusted, against motions that are known."""

import numpy as np
import pytest

from bricktrack_host.tracking.pose.frame_motion import motion_to_leds

AMPLITUDE_MM = 3.0


def velocity_errors(hz, t_s):
    """Return a spline's errors of the velocity of a sine along x at frames, and their stated sd, mm/s."""
    t_ns = np.rint(t_s * 1e9).astype(np.int64)
    led_t_ns = t_ns[:, None] + 1_000_000
    t_mm = np.zeros((len(t_s), 3))
    t_mm[:, 0] = AMPLITUDE_MM * np.sin(2 * np.pi * hz * t_s)
    motion = motion_to_leds(t_ns, led_t_ns, np.tile(np.eye(3), (len(t_s), 1, 1)), t_mm)
    later = AMPLITUDE_MM * np.sin(2 * np.pi * hz * (t_s + 1e-3))
    error_mmps = (motion.shift_camera_mm[:, 0, 0] - (later - t_mm[:, 0])) / 1e-3
    return error_mmps[4:-4], motion.twist_sd[4:-4, 3]  # ends are doubted for themselves


@pytest.mark.parametrize("hz", [3.0, 5.0, 8.0])
@pytest.mark.parametrize("kept", [1.0, 0.5, 0.25])
def test_a_spline_through_frames_that_are_left_is_doubted_by_as_much_as_it_errs(hz, kept):
    rng = np.random.default_rng(round(hz))
    t_s = np.arange(0, 20, 1 / 30)
    t_s = t_s[rng.random(len(t_s)) <= kept]
    error, sd = velocity_errors(hz, t_s)
    if kept == 1.0:
        assert np.abs(error).max() < 0.1 * 2 * np.pi * hz * AMPLITUDE_MM  # 8.5 % at w T = 1.8, see there
    # 30 and more frames: what is honest has a mean near 1, and what is on the safe side less.
    assert np.mean((error / sd) ** 2) < 1.5
    assert np.quantile(np.abs(error / sd), 0.95) < 2.5


def test_a_brick_at_rest_is_not_doubted_for_frames_that_are_missing():
    t_s = np.arange(0, 20, 1 / 30)[::4]
    error, sd = velocity_errors(0.0, t_s)
    assert np.abs(error).max() == 0.0
    assert sd.max() < 1.0  # mm/s: within 10 ms of a frame not a hundredth of a millimetre
