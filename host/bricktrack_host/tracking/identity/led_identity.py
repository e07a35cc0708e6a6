"""Identities through a whole run: which light of which picture is which LED.

The lights of all pictures are at hand, so the slow parts run on many frames at once: from one identified
frame the pattern of LEDs is followed, forwards and backwards, in the image alone; then the poses of all those
frames verify it together. Frames that the poses refute, and the first, are searched from nothing. At last the
run's own motion judges every frame (`identity_settling`).
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.ndimage import median_filter

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_host.tracking.identity.assigned_lights import MIN_INLIERS, LedLights
from bricktrack_host.tracking.identity.correspondence import search_correspondence
from bricktrack_host.tracking.identity.identity_motion import unknown_motion
from bricktrack_host.tracking.identity.identity_settling import settle
from bricktrack_host.tracking.identity.paper_rules import identify_by_paper
from bricktrack_host.tracking.identity.pattern import NOT_FOLLOWED, assign_predicted, follow_pattern
from bricktrack_host.tracking.identity.run_identities import (
    NEAR_FRAMES,
    SUSPECT,
    Identities,
    RunIdentities,
    is_whole,
    rms_px,
)
from bricktrack_host.tracking.identity.verification import Correspondence, Verified
from bricktrack_host.tracking.pictures.segment import Blobs
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.prsoi import ROUGH_MM, prsoi_starts

SegmentMethod = Literal["default", "paper"]

_MAX_COAST_NS = 500_000_000  # after so long without LEDs the last pattern says nothing of a shaken brick
_BELIEVED_CHI2 = 9.0
"""At `verification`'s trust in lights. Of simulated frames with five false lights, 99 % of right assignments
have less at up to 0.1 m/s, 96 % at 0.3 m/s; two thirds of wrong ones more, as no motion gives that shape."""
_MOVED_PX = 0.5  # residuals beyond this may be a motion's


def identify_run(
    blobs: Sequence[Blobs | None],
    stamps_ns: IntArray,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    radius_px: float,
    collar_mm: float | None,
    method: SegmentMethod = "default",
) -> Identities:
    """Identify the LEDs in all frames of a run.

    Parameters
    ----------
    blobs : sequence of Blobs or None
        The lights of each frame; `None` where the frame was lost.
    stamps_ns : ndarray of int64, shape (n,)
    radius_px : float
        About the radius of an LED.
    collar_mm : float or None
        See `led_profile`.
    method : "default" or "paper"
        How frames are identified from nothing: "paper" tries its rules first.
    """
    run = RunIdentities(blobs, stamps_ns, ray_model, brick_model, radius_px=radius_px, collar_mm=collar_mm)
    _Proposals(run, method).find_all()
    settle(run)
    if _grow(run):
        settle(run)
    # LEDs without a light get a free one within the gate, as strayed.
    at, assigned = run.with_free_lights(run.known_frames())
    run.found.is_strayed[at] = (assigned >= 0) & (run.found.blob_of_led[at] < 0)
    run.found.blob_of_led[at] = assigned
    return run.found


class _Proposals:
    """The first identities of a run's frames: from nothing, and followed from there."""

    def __init__(self, run: RunIdentities, method: SegmentMethod) -> None:
        self._run, self._method = run, method
        n = len(run.blobs)
        of = np.repeat(np.arange(n), run.lights.count)
        self._n_whole = np.bincount(of[run.lights.flags == 0], minlength=n)
        self._searched = np.zeros(n, dtype=bool)
        self._doubted = np.zeros(n, dtype=bool)

    def find_all(self) -> None:
        """Search each frame that is open, and follow what is found."""
        i = 0
        while (rest := np.flatnonzero(self._is_open()[i:])).size:
            i += int(rest[0])
            if self._search(i).n_found:
                self._follow(i)
            i += 1

    def _is_open(self) -> BoolArray:
        """Tell which frames have lights enough, no believable identity, and were not searched yet."""
        # Two more good lights than identified LEDs: the pattern may hold on to the wrong ones.
        wanted = np.minimum(self._n_whole, self._run.brick_model.n_leds) - 2
        few = self._run.n_found < np.maximum(wanted, MIN_INLIERS)
        lit = self._run.lights.count >= MIN_INLIERS
        return np.asarray(lit & ~self._searched & (self._doubted | few))

    def _search(self, i: int) -> Correspondence:
        """Identify a frame from nothing; what the pattern gave stays if it is more."""
        run = self._run
        blobs = run.blobs[i]
        assert blobs is not None  # noqa: S101 - it has lights
        self._searched[i] = True
        found: Correspondence | None = None
        if self._method == "paper":
            found = identify_by_paper(
                blobs, run.ray_model, run.brick_model, collar_mm=run.collar_mm, gate_px=run.gate_px
            )
        if found is None or found.n_found == 0:
            found = search_correspondence(blobs, run.ray_model, run.brick_model, collar_mm=run.collar_mm)
        if found.n_found > run.n_found[i]:
            run.found.blob_of_led[i] = found.blob_of_led
            run.found.R_camera_brick[i] = found.R_camera_brick
            run.found.t_camera_brick_mm[i] = found.t_camera_brick_mm
        run.found.is_ambiguous[i] = found.is_ambiguous
        return found

    def _follow(self, anchor: int) -> None:
        """Carry the identities of a frame to its neighbours on both sides, and verify them together."""
        run = self._run
        R, t_mm = run.found.R_camera_brick[anchor], run.found.t_camera_brick_mm[anchor]
        prediction = run.predict(np.array([anchor]))
        followed = follow_pattern(
            run.lights.uv_px,
            run.lights.first,
            run.stamps_ns,
            (run.n_found > 0) & ~self._is_open(),
            anchor,
            np.where(prediction.facing[0, :, None] > 0, prediction.uv_px[0], np.nan),
            radius_px=run.radius_px,
            max_coast_ns=_MAX_COAST_NS,
        )
        frames = np.flatnonzero(followed[:, 0] != NOT_FOLLOWED)
        if frames.size == 0:
            return
        assigned = followed[frames]
        lights = run.lights.of_leds(frames, assigned)
        # The pattern needs cut lights though others would do: it may hold on to the wrong ones.
        cut = (assigned >= 0) & ~lights.is_whole
        self._doubted[frames] = cut.any(axis=1) & (lights.is_whole.sum(axis=1) < MIN_INLIERS)
        self._doubted[frames] &= self._n_whole[frames] > MIN_INLIERS
        verified = _verified(run, lights, R, t_mm, frames)
        better = verified.kept.sum(axis=1) > run.n_found[frames]
        better &= verified.poses.chi2 <= _BELIEVED_CHI2
        run.take(frames, assigned, verified, better)
        run.found.is_ambiguous[frames[better]] = False
        _complete(run, frames[better])


def _verified(
    run: RunIdentities, lights: LedLights, R: FloatArray, t_mm: FloatArray, frames: IntArray
) -> Verified:
    """Verify assignments of frames; ``R`` and ``t_mm`` are the pose that they come from, or each one's."""
    starts = prsoi_starts(lights.uv_px, run.ray_model, run.brick_model, tolerance_mm=ROUGH_MM)
    none = ~all_finite(starts[0], 2)  # LEDs in one plane
    starts[0][none] = np.broadcast_to(R, starts[0].shape)[none]
    starts[1][none] = np.broadcast_to(t_mm, starts[1].shape)[none]
    verified = run.verify(lights, starts)
    kept = verified.kept.sum(axis=1)
    whole = is_whole(verified, lights)
    wrong, right = np.flatnonzero(~whole), np.flatnonzero(whole)
    if wrong.size and right.size:
        # PRSOI may have converged to a false pose: once more from the nearest frame that is believed.
        nearest = right[np.abs(frames[right][None] - frames[wrong][:, None]).argmin(axis=1)]
        start = (verified.poses.R_camera_brick[nearest], verified.poses.t_camera_brick_mm[nearest])
        again = run.verify(lights.take(wrong), start)
        more = again.kept.sum(axis=1) > kept[wrong]
        verified = verified.replaced(wrong[more], again.take(np.flatnonzero(more)))
    moved = np.flatnonzero(~is_whole(verified, lights) | (rms_px(verified) > _MOVED_PX))
    if moved.size:
        # Read out row by row, a brick in motion is out of shape.
        some = lights.take(moved)
        known = all_finite(verified.poses.R_camera_brick[moved], 2)
        start = (
            np.where(known[:, None, None], verified.poses.R_camera_brick[moved], starts[0][moved]),
            np.where(known[:, None], verified.poses.t_camera_brick_mm[moved], starts[1][moved]),
        )
        again = run.verify(some, start, motion=unknown_motion(some.uv_px, run.ray_model))
        more = again.kept.sum(axis=1) >= verified.kept[moved].sum(axis=1)
        verified = verified.replaced(moved[more], again.take(np.flatnonzero(more)))
    # A moving brick's residuals scatter, alike from frame to frame; where one frame's are far larger than
    # its neighbours', a false light may be among its own.
    rms = rms_px(verified)
    suspect = np.flatnonzero(rms > SUSPECT * median_filter(rms, NEAR_FRAMES, mode="nearest"))
    if suspect.size == 0:
        return verified
    at, some = frames[suspect], lights.take(suspect)
    start = (verified.poses.R_camera_brick[suspect], verified.poses.t_camera_brick_mm[suspect])
    again = run.verify(some, start, intruders=True, n_lights=run.lights.count[at])
    hit = np.flatnonzero(again.is_scattered | ~(again.poses.chi2 <= _BELIEVED_CHI2))
    if hit.size:
        moving = _without_intruders(run, some.take(hit), (start[0][hit], start[1][hit]), at[hit])
        again = again.replaced(hit, moving)
    return verified.replaced(suspect, again)


def _without_intruders(
    run: RunIdentities, lights: LedLights, starts: tuple[FloatArray, FloatArray], frames: IntArray
) -> Verified:
    """Verify assignments of frames among whose lights may be a false one, however the brick moves in them."""
    unknown = unknown_motion(lights.uv_px, run.ray_model)
    return run.verify(lights, starts, intruders=True, motion=unknown, n_lights=run.lights.count[frames])


def _grow(run: RunIdentities) -> int:
    """Identify lost frames from known ones beside them, one after the other; return how many.

    Each frame is verified before the next is tried: unlike a pattern in the image, which takes a wrong turn
    along, its pose tells where all LEDs are, and no false light.
    """
    n = len(run.blobs)
    beside = np.stack([np.arange(n) - 1, np.arange(n) + 1], axis=1)
    inside = np.clip(beside, 0, n - 1)
    apart_ns = np.abs(run.stamps_ns[inside] - run.stamps_ns[:, None])
    open_ = (inside == beside) & (apart_ns <= _MAX_COAST_NS) & (run.lights.count >= MIN_INLIERS)[:, None]
    n_grown = 0
    while True:
        known = run.n_found > 0
        frames, side = np.nonzero(open_ & known[inside] & ~known[:, None])
        if frames.size == 0:
            return n_grown
        open_[frames, side] = False
        sources = inside[frames, side]
        assigned = _shifted(run, frames, sources)
        start = (run.found.R_camera_brick[sources], run.found.t_camera_brick_mm[sources])
        lights = run.lights.of_leds(frames, assigned)
        verified = _verified(run, lights, *start, frames)
        bad = np.flatnonzero(~(verified.poses.chi2 <= _BELIEVED_CHI2))
        if bad.size:  # a false light may be among them
            again = _without_intruders(run, lights.take(bad), (start[0][bad], start[1][bad]), frames[bad])
            verified = verified.replaced(bad, again)
        n_kept = np.where(verified.poses.chi2 <= _BELIEVED_CHI2, verified.kept.sum(axis=1), 0)
        order = np.lexsort((-n_kept, frames))
        best = order[np.unique(frames[order], return_index=True)[1]]
        best = best[n_kept[best] > 0]
        run.take(frames[best], assigned[best], verified.take(best))
        n_grown += best.size


def _shifted(run: RunIdentities, frames: IntArray, sources: IntArray) -> IntArray:
    """Assign the lights of frames to the LEDs as other frames show them, after a common displacement."""
    seen = run.predict(sources)
    return np.stack(
        [
            assign_predicted(
                run.lights.uv_px[slice(*run.lights.first[i : i + 2])],
                np.where(facing[:, None] > 0, uv, np.nan),
                gate_px=run.radius_px,
                shift_limit_px=10 * run.radius_px,
            )
            for i, uv, facing in zip(frames, seen.uv_px, seen.facing, strict=True)
        ]
    )


def _complete(run: RunIdentities, frames: IntArray) -> None:
    """Give LEDs that the pattern missed the free light where the verified pose sees them."""
    at, assigned = run.with_free_lights(frames)
    if at.size == 0:
        return
    start = (run.found.R_camera_brick[at], run.found.t_camera_brick_mm[at])
    verified = run.verify(run.lights.of_leds(at, assigned), start)
    run.take(at, assigned, verified, verified.kept.sum(axis=1) > run.n_found[at])
