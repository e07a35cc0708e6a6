"""From the pictures of a run to identified centroids.

The lights of all pictures (`run_lights`) are identified (`led_identity`), and their areas compared with what
each LED shows in the rest of the run: LEDs partly covered, or run together with another light, are flagged,
and those that something only begins to touch doubted (`led_shapes`).
"""

import logging
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import TrackingError
from bricktrack_host.quality import LedFlag, PoseFlag
from bricktrack_host.tracking.identity.assigned_lights import MIN_INLIERS
from bricktrack_host.tracking.identity.led_identity import SegmentMethod, identify_run
from bricktrack_host.tracking.identity.run_identities import Identities
from bricktrack_host.tracking.led_model.led_profile import LedPrediction, collar_of, predict_brick
from bricktrack_host.tracking.led_shapes import doubt_by_shape
from bricktrack_host.tracking.pictures.run_lights import find_run_lights, usual_radius_px
from bricktrack_host.tracking.pictures.segment import Blobs, Picture
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracks import LedObservations

logger = logging.getLogger(__name__)

_AREA_SIGMAS = 6.0
_AREA_FLOOR = 0.015  # a dome behind an edge that hides this share of it moves its centroid by some 0.7 px
_AREA_PER_MISFIT = 6.0
"""Rolling shutter is not yet taken off: a pose whose LEDs lie off by a share of their distance has the scale
wrong by as much, areas by twice that; and three times that is believed."""
_BLUR_COV_SHARE = 0.03
"""Error of mid-exposure, as a share of the length of the smear: the motion is not uniform during exposure."""
_BLUR_ACROSS_SHARE = 0.005
"""Error across the smear, of rim and codec. Without it a fast frame's pose follows a hundredth of a pixel
across and leaves a pixel along: twice the error at 0.3 m/s and 10 ms (simulated)."""
NOT_USED = LedFlag.MISSING | LedFlag.BORDER | LedFlag.PARTLY_COVERED | LedFlag.MERGED


def observe_leds(
    pictures: Iterable[tuple[int, Picture]],
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    sensor_timestamp_ns: ArrayLike,
    exposure_ns: ArrayLike,
    method: SegmentMethod = "default",
    progress: Callable[[int], None] | None = None,
) -> LedObservations:
    """Find, identify and measure the LEDs in all pictures of a run.

    Parameters
    ----------
    pictures : iterable of (int, Picture)
        Index of the frame and its picture, in time order; taken in a thread of their own, two ahead, and not
        kept. Frames that do not come are flagged `PoseFlag.FRAME_LOST`.
    ray_model : RayModel
    brick_model : BrickModel
    sensor_timestamp_ns, exposure_ns : array_like of int64, shape (n_frames,)
    method : "default" or "paper"
        The paper's filter and, for its layout, its rules of identity; or ours.
    progress : callable, optional
        Called with the number of frames done.

    Returns
    -------
    LedObservations
        Frames without an identity have NaN and `PoseFlag.NO_POSE`, ambiguous ones `PoseFlag.AMBIGUOUS`.

    Raises
    ------
    TrackingError
        If the times do not fit each other, a picture's index is outside them or out of order, or its size is
        not that of the calibration.
    """
    lights = find_run_lights(
        pictures,
        ray_model,
        brick_model,
        n_frames=np.size(sensor_timestamp_ns),
        method=method,
        progress=progress,
    )
    return observe_lights(
        lights,
        ray_model,
        brick_model,
        sensor_timestamp_ns=sensor_timestamp_ns,
        exposure_ns=exposure_ns,
        method=method,
    )


def observe_lights(
    lights: list[Blobs | None],
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    sensor_timestamp_ns: ArrayLike,
    exposure_ns: ArrayLike,
    method: SegmentMethod = "default",
) -> LedObservations:
    """Identify and judge the lights found in a run by `run_lights.find_run_lights`; see `observe_leds`."""
    stamps = np.asarray(sensor_timestamp_ns, dtype=np.int64)
    exposure = np.asarray(exposure_ns, dtype=np.int64)
    if stamps.ndim != 1 or stamps.shape != exposure.shape:
        raise TrackingError(
            f"sensor time stamps have shape {stamps.shape}, exposures {exposure.shape}; expected one of each "
            "a frame"
        )
    n, n_leds = len(stamps), brick_model.n_leds
    out = LedObservations(
        sensor_timestamp_ns=stamps,
        exposure_ns=exposure,
        uv_px=np.full((n, n_leds, 2), np.nan),
        cov_px2=np.full((n, n_leds, 2, 2), np.nan),
        area_px2=np.full((n, n_leds), np.nan),
        led_flags=np.full((n, n_leds), int(LedFlag.MISSING), dtype=np.int64),
        frame_flags=np.full(n, int(PoseFlag.FRAME_LOST | PoseFlag.NO_POSE), dtype=np.int64),
    )
    found = identify_run(
        lights,
        stamps,
        ray_model,
        brick_model,
        radius_px=usual_radius_px(ray_model, brick_model),
        collar_mm=collar_of(brick_model),
        method=method,
    )
    for i, blobs in enumerate(lights):
        if blobs is None:
            continue
        out.frame_flags[i] = _frame_flags(found, i)
        leds = np.flatnonzero(found.blob_of_led[i] >= 0)
        index = found.blob_of_led[i, leds]
        out.uv_px[i, leds] = blobs.uv_px[index]
        out.cov_px2[i, leds] = blobs.cov_px2[index]
        out.area_px2[i, leds] = blobs.area_px2[index]
        out.led_flags[i, leds] = blobs.flags[index]
    _flag_areas(out, found, ray_model, brick_model)
    _widen_blurred(out)
    seen = all_finite(out.uv_px)
    covered = np.zeros(seen.shape, dtype=bool)
    covered[seen] = ray_model.is_covered(out.uv_px[seen])
    out.led_flags[seen & ~covered] |= LedFlag.UNCOVERED
    n_lost = int(((out.frame_flags & PoseFlag.NO_POSE) != 0).sum())
    if n_lost:
        logger.warning("%d of %d frames without identified LEDs", n_lost, n)
    return out


def _frame_flags(found: Identities, i: int) -> int:
    n_found = int((found.blob_of_led[i] >= 0).sum())
    if n_found == 0:
        ambiguous = PoseFlag.AMBIGUOUS if found.is_ambiguous[i] else PoseFlag.NONE
        return int(PoseFlag.NO_POSE | ambiguous)
    flags = PoseFlag.NONE if n_found == found.blob_of_led.shape[1] else PoseFlag.LED_MISSING
    return int(flags | PoseFlag.UNVERIFIED if n_found == MIN_INLIERS else flags)


def _flag_areas(
    out: LedObservations, found: Identities, ray_model: RayModel, brick_model: BrickModel
) -> None:
    """Flag LEDs whose area is not what they show in the rest of the run, given the pose.

    Those that are whole, but look other than they do from there, are doubted by as much. Lights that strayed
    from where their pose has them are flagged too, unless they look as they always do: then it is the brick
    that was jolted while the rows were read, and the LEDs left out would be as good a choice as those kept.
    """
    posed = np.flatnonzero(all_finite(found.R_camera_brick, 2))
    if posed.size == 0:
        return
    R, t, strayed = found.R_camera_brick[posed], found.t_camera_brick_mm[posed], found.is_strayed[posed]
    # Bare profile where none was fitted: the ratio to the run's median takes the difference off.
    prediction, _ = predict_brick(R, t, ray_model, brick_model, collar_mm=collar_of(brick_model) or 0.0)
    ratio = np.log(out.area_px2[posed] / prediction.area_px2)
    measured = np.isfinite(ratio) & ((out.led_flags[posed] & NOT_USED) == 0)
    usable = measured & ~strayed
    usual = _median_or_nan(ratio, usable)
    usual_of_all = float(np.nanmedian(usual)) if np.isfinite(usual).any() else 0.0
    # An LED covered in most of the run would set its own standard: then the others' holds.
    strange = ~(np.abs(usual - usual_of_all) < 0.15)
    usual = np.where(strange, usual_of_all, usual)
    deviation = ratio - usual
    spread = 1.4826 * np.median(np.abs(deviation[usable])) if usable.any() else 0.0
    limit = np.maximum(
        max(_AREA_SIGMAS * spread, _AREA_FLOOR),
        _AREA_PER_MISFIT * _relative_misfit(out.uv_px[posed], prediction),
    )[:, None]
    flags = out.led_flags[posed]
    with np.errstate(invalid="ignore"):
        flags[deviation < -limit] |= LedFlag.PARTLY_COVERED
        flags[deviation > 2 * limit] |= LedFlag.MERGED
        flags[strayed & ~(np.abs(deviation) <= limit)] |= LedFlag.PARTLY_COVERED
    out.led_flags[posed] = flags
    whole = measured & ((flags & NOT_USED) == 0)
    doubt = doubt_by_shape(ratio, out.cov_px2[posed], whole, R, t)
    doubt_px2 = doubt**2 * out.area_px2[posed] / np.pi
    out.cov_px2[posed] += np.where(whole, doubt_px2, 0.0)[..., None, None] * np.eye(2)


def _relative_misfit(uv_px: FloatArray, prediction: LedPrediction) -> FloatArray:
    """Return how far lights lie from where their pose has them over how far they lie apart, (n,); rms."""
    off = np.sum((uv_px - prediction.uv_px) ** 2, axis=-1)
    n_seen = np.maximum(np.isfinite(off).sum(axis=1), 1)
    seen = np.where(np.isfinite(off)[..., None], uv_px, 0.0)
    from_middle = np.where(
        np.isfinite(off)[..., None], uv_px - (seen.sum(axis=1) / n_seen[:, None])[:, None], 0.0
    )
    apart = np.sum(from_middle**2, axis=(1, 2))
    return np.asarray(np.sqrt(np.nansum(off, axis=1) / np.maximum(apart, 1.0)))


def _median_or_nan(values: FloatArray, usable: BoolArray) -> FloatArray:
    return np.array([np.median(v[u]) if u.any() else np.nan for v, u in zip(values.T, usable.T, strict=True)])


def _widen_blurred(out: LedObservations) -> None:
    """Flag centroids smeared by more than their radius, and widen all by their smear."""
    seconds = (out.sensor_timestamp_ns - out.sensor_timestamp_ns[0]) * 1e-9 if len(out.uv_px) else np.zeros(0)
    if len(seconds) < 2:
        return
    step = np.diff(seconds)
    speed = np.diff(out.uv_px, axis=0) / np.where((step > 0) & (step < 0.1), step, np.nan)[:, None, None]
    before = np.concatenate([np.full_like(speed[:1], np.nan), speed])
    after = np.concatenate([speed, np.full_like(speed[:1], np.nan)])
    faster = np.nan_to_num(np.linalg.norm(after, axis=-1)) > np.nan_to_num(np.linalg.norm(before, axis=-1))
    velocity = np.nan_to_num(np.where(faster[..., None], after, before))
    smear = velocity * (out.exposure_ns * 1e-9)[:, None, None]
    out.cov_px2[:] += _BLUR_COV_SHARE**2 * smear[..., :, None] * smear[..., None, :]
    out.cov_px2[:] += _BLUR_ACROSS_SHARE**2 * np.sum(smear**2, axis=-1)[..., None, None] * np.eye(2)
    with np.errstate(invalid="ignore"):
        blurred = np.linalg.norm(smear, axis=-1) > np.sqrt(out.area_px2 / np.pi)
    out.led_flags[blurred] |= LedFlag.BLURRED
