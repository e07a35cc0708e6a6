import numpy as np
import pytest

from bricktrack_common.errors import CalibrationError
from bricktrack_host.quality import LedFlag
from bricktrack_host.tracking.sweep_frames import rms_px, sweep_frames
from bricktrack_host.tracks import LedObservations


def observations(uv_px, led_flags):
    n, n_leds = uv_px.shape[:2]
    cov = np.arange(1.0, n + 1)[:, None, None, None] * np.ones((1, n_leds, 1, 1)) * np.eye(2)
    zero = np.zeros(n, dtype=np.int64)
    return LedObservations(zero, zero, uv_px, cov, np.ones((n, n_leds)), led_flags, zero)


def scene():
    """Four frames of three LEDs: all whole, one cut by the border, one not found, all whole."""
    uv, flags = np.ones((4, 3, 2)), np.zeros((4, 3), dtype=np.int64)
    flags[1, 0] = LedFlag.BORDER
    uv[2, 1] = np.nan
    flags[2, 1] = LedFlag.MISSING
    return observations(uv, flags)


def test_frames_with_enough_whole_leds_are_taken_with_their_covariances():
    sweep = sweep_frames(scene(), wanted="this needs", min_leds=3, min_frames=2)
    assert np.isfinite(sweep.uv_px).all()
    assert sweep.cov_px2[:, 0, 0, 0].tolist() == [1.0, 4.0]  # the first frame and the last


def test_leds_that_are_not_whole_are_left_out_of_the_frames_that_are_taken():
    sweep = sweep_frames(scene(), wanted="this needs", min_leds=2, min_frames=2)
    assert np.isnan(sweep.uv_px[..., 0]).tolist() == [
        [False] * 3,
        [True, False, False],
        [False, True, False],
        [False] * 3,
    ]


def test_too_few_frames_are_refused_with_their_number():
    with pytest.raises(CalibrationError, match="2 frames with 3 or more whole LEDs; this needs 5"):
        sweep_frames(scene(), wanted="this needs", min_leds=3, min_frames=5)


def test_rms_is_of_what_is_known():
    assert rms_px(np.array([[3.0, np.nan], [np.nan, -4.0]])) == pytest.approx(np.sqrt(12.5))
