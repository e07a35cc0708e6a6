"""Which frames and centroids of a sweep tell of the LEDs themselves: those with enough whole LEDs in them."""

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.errors import CalibrationError
from bricktrack_host.tracking.finite import all_finite
from bricktrack_host.tracking.led_tracker import NOT_USED
from bricktrack_host.tracks import LedObservations


def sweep_frames(
    observations: LedObservations, *, wanted: str, min_leds: int, min_frames: int
) -> tuple[FloatArray, FloatArray]:
    """Return the centroids of a sweep's useful frames, and their covariances.

    Parameters
    ----------
    observations : LedObservations
    wanted : str
        What is fitted to them and its verb, for the message: "the LED profile needs".
    min_leds, min_frames : int
        Whole LEDs that make a frame useful, and useful frames that make a sweep.

    Returns
    -------
    uv_px : ndarray, shape (n, n_leds, 2), px
        NaN where an LED was not seen, or not whole.
    cov_px2 : ndarray, shape (n, n_leds, 2, 2), px^2

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
    return np.where(used[..., None], observations.uv_px, np.nan)[frames], observations.cov_px2[frames]


def rms_px(residual_px: FloatArray) -> float:
    """Return the root mean square of what residuals are known, each of u and v."""
    return float(np.sqrt(np.nanmean(residual_px**2)))
