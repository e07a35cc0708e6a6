"""Follow the LEDs through a video: pictures in, identified centroids out.

Each picture is searched decimated (cheap, and blind to no motion), the finds are identified by the track, or
from nothing at the start and after loss, and only the LEDs are measured at full resolution. When all pictures
are through, the areas are compared with what each LED shows in the run: those partly covered or run together
with another light are flagged.
"""

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import TrackingError
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix
from bricktrack_host.correspondence import (
    MIN_INLIERS,
    Correspondence,
    assign_predicted,
    correspondence_from,
    identity_gate_px,
    is_paper_layout,
    no_correspondence,
    paper_hypotheses,
    search_correspondence,
    verify,
)
from bricktrack_host.led_profile import collar_of, predict_brick
from bricktrack_host.quality import LedFlag, PoseFlag
from bricktrack_host.segment import (
    Blobs,
    Candidates,
    PaperLimits,
    Picture,
    find_candidates,
    measure_candidates,
    paper_filter,
)
from bricktrack_host.tracks import LedObservations

logger = logging.getLogger(__name__)

SegmentMethod = Literal["default", "paper"]

_MAX_COAST_S = 0.5  # after so long without a pose the prediction says nothing of a shaken brick
_AREA_SIGMAS = 6.0
_AREA_FLOOR = 0.015  # a dome behind an edge that hides this share of it moves its centroid by some 0.7 px
_BLUR_COV_SHARE = 0.03
"""Error of mid-exposure, as a share of the length of the smear: the motion is not uniform during exposure."""
NOT_USED = LedFlag.MISSING | LedFlag.BORDER | LedFlag.PARTLY_COVERED | LedFlag.MERGED


@dataclass(slots=True)
class _Track:
    """The last verified pose and how it was moving."""

    t_ns: int
    R: FloatArray
    t: FloatArray
    omega_radps: FloatArray
    v_mmps: FloatArray

    def predicted(self, t_ns: int) -> tuple[FloatArray, FloatArray]:
        dt = (t_ns - self.t_ns) * 1e-9
        dt = float(np.clip(dt, -0.05, 0.05))  # velocity turns back within a shake's half period
        return self.R @ matrix_from_rvec(self.omega_radps * dt), self.t + self.v_mmps * dt

    def moved(self, t_ns: int, R: FloatArray, t: FloatArray) -> "_Track":
        dt = (t_ns - self.t_ns) * 1e-9
        if not 0 < dt < 0.1:
            return _Track(t_ns, R, t, np.zeros(3), np.zeros(3))
        return _Track(t_ns, R, t, rvec_from_matrix(self.R.T @ R) / dt, (t - self.t) / dt)


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
        Index of the frame and its picture, in time order; a picture is not kept. Frames that do not come are
        flagged `PoseFlag.FRAME_LOST`.
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
    stamps = np.asarray(sensor_timestamp_ns, dtype=np.int64)
    exposure = np.asarray(exposure_ns, dtype=np.int64)
    if stamps.ndim != 1 or stamps.shape != exposure.shape:
        raise TrackingError(
            f"sensor time stamps have shape {stamps.shape}, exposures {exposure.shape}; expected one each a frame"
        )
    if method not in ("default", "paper"):
        raise TrackingError(f"segmentation method is {method!r}; expected 'default' or 'paper'")
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
    finder = _Finder(ray_model, brick_model, method)
    R = np.full((n, 3, 3), np.nan)
    t = np.full((n, 3), np.nan)
    mode = ray_model.sensor_mode
    last = -1
    for done, (i, picture) in enumerate(pictures, start=1):
        if not last < i < n:
            raise TrackingError(
                f"picture of frame {i} after frame {last}, with {n} time stamps; expected rising indices below that"
            )
        if picture.luma.shape != (mode.height, mode.width):
            raise TrackingError(
                f"frame {i} has {picture.luma.shape[1]} x {picture.luma.shape[0]} pixels; the calibration is of "
                f"mode {mode.name}, {mode.width} x {mode.height}. Use the calibration of the run's mode."
            )
        last = i
        found, blobs = finder.find(int(stamps[i]), picture)
        out.frame_flags[i] = _frame_flags(found, n_leds)
        leds = np.flatnonzero(found.blob_of_led >= 0)
        index = found.blob_of_led[leds]
        out.uv_px[i, leds] = blobs.uv_px[index]
        out.cov_px2[i, leds] = blobs.cov_px2[index]
        out.area_px2[i, leds] = blobs.area_px2[index]
        out.led_flags[i, leds] = blobs.flags[index]
        R[i], t[i] = found.R_camera_brick, found.t_camera_brick_mm
        if progress is not None:
            progress(done)
    _flag_areas(out, R, t, ray_model, brick_model)
    _widen_blurred(out)
    seen = np.isfinite(out.uv_px).all(axis=-1)
    covered = np.zeros(seen.shape, dtype=bool)
    covered[seen] = ray_model.is_covered(out.uv_px[seen])
    out.led_flags[seen & ~covered] |= LedFlag.UNCOVERED
    n_lost = int(((out.frame_flags & PoseFlag.NO_POSE) != 0).sum())
    if n_lost:
        logger.warning("%d of %d frames without identified LEDs", n_lost, n)
    return out


def _frame_flags(found: Correspondence, n_leds: int) -> int:
    if found.n_found == 0:
        return int(PoseFlag.NO_POSE | PoseFlag.AMBIGUOUS if found.is_ambiguous else PoseFlag.NO_POSE)
    flags = PoseFlag.NONE if found.n_found == n_leds else PoseFlag.LED_MISSING
    if found.n_found == MIN_INLIERS:
        flags |= PoseFlag.UNVERIFIED
    return int(flags)


class _Finder:
    """The LEDs of one picture after the other; holds the track between them."""

    def __init__(self, ray_model: RayModel, brick_model: BrickModel, method: SegmentMethod) -> None:
        self._rays = ray_model
        self._brick = brick_model
        self._method = method
        self._collar_mm = collar_of(brick_model)
        self._radius_px = _usual_radius_px(ray_model, brick_model)
        self._limits = PaperLimits.for_radius(self._radius_px)
        self._track: _Track | None = None

    def find(self, t_ns: int, picture: Picture) -> tuple[Correspondence, Blobs]:
        """Return the identities of a picture's lights, and the lights."""
        if self._track is not None and (t_ns - self._track.t_ns) * 1e-9 > _MAX_COAST_S:
            self._track = None
        if self._method == "paper":
            blobs = paper_filter(picture, limits=self._limits)
            found = self._by_paper(blobs)
            if found.n_found == 0:
                found = self._by_track(t_ns, blobs)
        else:
            candidates = find_candidates(picture, radius_px=self._radius_px)
            found, blobs = self._near_track(t_ns, picture, candidates)
            if found.n_found == 0:
                blobs = measure_candidates(picture, candidates)
        if found.n_found == 0:
            found = search_correspondence(blobs, self._rays, self._brick, collar_mm=self._collar_mm)
        if found.n_found:
            R, t = found.R_camera_brick, found.t_camera_brick_mm
            still = _Track(t_ns, R, t, np.zeros(3), np.zeros(3))
            self._track = still if self._track is None else self._track.moved(t_ns, R, t)
        return found, blobs

    def _near_track(
        self, t_ns: int, picture: Picture, candidates: Candidates
    ) -> tuple[Correspondence, Blobs]:
        """Measure the finds that the track takes for LEDs, and verify them."""
        rough = self._assign(t_ns, candidates.uv_px)
        chosen = rough[rough >= 0]
        blobs = measure_candidates(
            picture, Candidates(candidates.uv_px[chosen], candidates.half_size_px[chosen])
        )
        return self._by_track(t_ns, blobs), blobs

    def _by_track(self, t_ns: int, blobs: Blobs) -> Correspondence:
        none = no_correspondence(self._brick.n_leds, "no track")
        if self._track is None or len(blobs) < MIN_INLIERS:
            return none
        found = correspondence_from(
            blobs,
            self._assign(t_ns, blobs.uv_px),
            self._track.predicted(t_ns),
            self._rays,
            self._brick,
            collar_mm=self._collar_mm,
            gate_px=identity_gate_px(self._radius_px),
            max_steps=3,
        )
        # Half of the lights unexplained: the track holds on to the wrong ones.
        good = int((blobs.flags == 0).sum())
        return found if found.n_found >= min(good, self._brick.n_leds) - 2 else none

    def _assign(self, t_ns: int, uv_px: FloatArray) -> IntArray:
        if self._track is None:
            return np.full(self._brick.n_leds, -1, dtype=np.int64)
        R, t = self._track.predicted(t_ns)
        prediction, _ = predict_brick(R[None], t[None], self._rays, self._brick, collar_mm=None)
        predicted = np.where(prediction.facing[0, :, None] > 0, prediction.uv_px[0], np.nan)
        gaps = np.linalg.norm(predicted[:, None] - predicted[None], axis=-1)
        closest = float(np.nanmin(np.where(gaps > 0, gaps, np.nan))) if np.isfinite(gaps).any() else 0.0
        return assign_predicted(
            uv_px,
            predicted,
            gate_px=max(0.45 * closest, 2 * self._radius_px / 3),
            shift_limit_px=10 * self._radius_px,
        )

    def _by_paper(self, blobs: Blobs) -> Correspondence:
        n_leds = self._brick.n_leds
        if not is_paper_layout(self._brick):
            return no_correspondence(n_leds, "not the paper's layout")
        hypotheses = paper_hypotheses(blobs, self._rays)
        if len(hypotheses) == 0:
            return no_correspondence(n_leds, "no seven blobs obey the paper's rules")
        kept, poses = verify(
            blobs,
            hypotheses,
            None,
            self._rays,
            self._brick,
            collar_mm=self._collar_mm,
            gate_px=identity_gate_px(self._radius_px),
        )
        whole = np.flatnonzero((kept >= 0).all(axis=1))
        if len(whole) == 0:
            return no_correspondence(n_leds, "reprojection refutes the paper's rules")
        best = int(whole[np.argmin(poses.chi2[whole])])
        r = poses.residual_px[best]
        return Correspondence(
            blob_of_led=kept[best],
            R_camera_brick=poses.R_camera_brick[best],
            t_camera_brick_mm=poses.t_camera_brick_mm[best],
            rms_px=float(np.sqrt(np.mean(np.sum(r**2, axis=-1)))),
            is_ambiguous=False,
            reason="",
        )


def _usual_radius_px(ray_model: RayModel, brick_model: BrickModel) -> float:
    """Return the radius of an LED midway between the calibrated planes, at the picture's middle, px."""
    mode = ray_model.sensor_mode
    z = 0.5 * (ray_model.plane_a_mm + ray_model.plane_b_mm)
    middle = np.array([0.5 * (mode.width - 1), 0.5 * (mode.height - 1)])
    xy = ray_model.points_on_plane(middle, z)
    J = ray_model.project(np.array([xy[0], xy[1], z])).J_px_per_mm[:, :2]
    return float(np.median(brick_model.led_radii_mm) * np.sqrt(abs(np.linalg.det(J))))


def _flag_areas(
    out: LedObservations, R: FloatArray, t: FloatArray, ray_model: RayModel, brick_model: BrickModel
) -> None:
    """Flag LEDs whose area is not what they show in the rest of the run, given the pose."""
    posed = np.flatnonzero(np.isfinite(R).all(axis=(1, 2)))
    if posed.size == 0:
        return
    # Bare profile where none was fitted: the ratio to the run's median takes the difference off.
    prediction, _ = predict_brick(
        R[posed], t[posed], ray_model, brick_model, collar_mm=collar_of(brick_model) or 0.0
    )
    ratio = np.log(out.area_px2[posed] / prediction.area_px2)
    usable = np.isfinite(ratio) & ((out.led_flags[posed] & NOT_USED) == 0)
    usual = _median_or_nan(ratio, usable)
    usual_of_all = float(np.nanmedian(usual)) if np.isfinite(usual).any() else 0.0
    # An LED covered in most of the run would set its own standard: then the others' holds.
    strange = ~(np.abs(usual - usual_of_all) < 0.15)
    usual = np.where(strange, usual_of_all, usual)
    deviation = ratio - usual
    spread = 1.4826 * np.median(np.abs(deviation[usable])) if usable.any() else 0.0
    limit = max(_AREA_SIGMAS * spread, _AREA_FLOOR)
    flags = out.led_flags[posed]
    with np.errstate(invalid="ignore"):
        flags[deviation < -limit] |= LedFlag.PARTLY_COVERED
        flags[deviation > 2 * limit] |= LedFlag.MERGED
    out.led_flags[posed] = flags


def _median_or_nan(values: FloatArray, usable: BoolArray) -> FloatArray:
    return np.array([np.median(v[u]) if u.any() else np.nan for v, u in zip(values.T, usable.T, strict=True)])


def _widen_blurred(out: LedObservations) -> None:
    """Flag centroids smeared by more than their radius, and widen all along their smear."""
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
    with np.errstate(invalid="ignore"):
        blurred = np.linalg.norm(smear, axis=-1) > np.sqrt(out.area_px2 / np.pi)
    out.led_flags[blurred] |= LedFlag.BLURRED
