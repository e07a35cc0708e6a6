"""Which frames and centroids of a sweep tell of the LEDs themselves: those with enough whole LEDs in them."""

from dataclasses import replace

import numpy as np

from bricktrack_common.arrays import FloatArray, rows_of
from bricktrack_common.errors import CalibrationError
from bricktrack_host.tracking.led_tracker import NOT_USED
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracks import LedObservations


def sweep_frames(
    observations: LedObservations, *, wanted: str, min_leds: int, min_frames: int
) -> LedObservations:
    """Return a sweep's useful frames, with NaN centroids where an LED was not seen or is not whole.

    Parameters
    ----------
    observations : LedObservations
    wanted : str
        What is fitted to them and its verb, for the message: "the LED profile needs".
    min_leds, min_frames : int
        Whole LEDs that make a frame useful, and useful frames that make a sweep.

    Raises
    ------
    CalibrationError
        If too few frames are useful.
    """
    used = ((observations.led_flags & NOT_USED) == 0) & all_finite(observations.uv_px)
    frames = np.flatnonzero(used.sum(axis=1) >= min_leds)
    if frames.size < min_frames:
        raise CalibrationError(
            f"{frames.size} frames with {min_leds} or more whole LEDs; {wanted} {min_frames}. "
            "Record a sweep with all LEDs in view."
        )
    whole = replace(observations, uv_px=np.where(used[..., None], observations.uv_px, np.nan))
    return rows_of(whole, frames)


def rms_px(residual_px: FloatArray) -> float:
    """Return the root mean square of what residuals are known, each of u and v."""
    return float(np.sqrt(np.nanmean(residual_px**2)))
