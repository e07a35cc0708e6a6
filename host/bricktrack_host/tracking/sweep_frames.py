"""Which frames and centroids of a sweep tell of the LEDs themselves: those with enough whole LEDs in them."""

from dataclasses import replace

import numpy as np

from bricktrack_common.arrays import FloatArray, rows_of
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import CalibrationError
from bricktrack_host.tracking.frame_errors import FrameErrors, frame_errors
from bricktrack_host.tracking.led_tracker import NOT_USED
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.first_poses import FirstPoses
from bricktrack_host.tracking.pose.refine import RefinedPoses
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


def errors_of_sweep(
    sweep: LedObservations, poses: RefinedPoses, ray_model: RayModel, brick_model: BrickModel
) -> FrameErrors:
    """Return the errors of a sweep's frames, for the test that a run's LEDs stand too, see `odd_leds`.

    Parameters
    ----------
    sweep : LedObservations
    poses : RefinedPoses
        Of its frames.
    ray_model : RayModel
    brick_model : BrickModel
        With the profile, and the places, that the poses are of.
    """
    R, t_mm = poses.R_camera_brick, poses.t_camera_brick_mm
    first = FirstPoses(sweep.uv_px, R, t_mm, np.zeros(len(R), dtype=np.bool_))
    return frame_errors(sweep, first, ray_model, brick_model, rolling_shutter=False)


def without_led(sweep: LedObservations, k: int) -> LedObservations:
    """Return a sweep in which an LED was never seen."""
    uv = sweep.uv_px.copy()
    uv[:, k] = np.nan
    return replace(sweep, uv_px=uv)


def words_on_left_out(left_out_px: FloatArray, brick_model: BrickModel) -> str:
    """Return a sentence on LEDs that a fit left out, by how far off they are, (n_leds,) px; or nothing."""
    told = [
        f"{name} ({off_px:.2f} px)"
        for name, off_px in zip(brick_model.led_names, left_out_px.tolist(), strict=True)
        if off_px > 0
    ]
    if not told:
        return ""
    return (
        f"left out: LED {', '.join(told)}: elsewhere than all the others say, in every frame alike. Is it "
        "clean and uncovered, and are its place, axis and name right in the layout?"
    )


def rms_px(residual_px: FloatArray) -> float:
    """Return the root mean square of what residuals are known, each of u and v."""
    return float(np.sqrt(np.nanmean(residual_px**2)))
