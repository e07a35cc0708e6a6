"""Identities through a whole run: which light of which picture is which LED.

The lights of all pictures are at hand, so the slow parts run on many frames at once: from one identified
frame the pattern of LEDs is followed, forwards and backwards, in the image alone; then the poses of all those
frames verify it together. Frames that the poses refute, and the first, are searched from nothing.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_host.tracking.correspondence import assign_predicted, search_correspondence
from bricktrack_host.tracking.finite import all_finite
from bricktrack_host.tracking.led_profile import predict_brick
from bricktrack_host.tracking.paper_rules import identify_by_paper
from bricktrack_host.tracking.prsoi import prsoi_starts
from bricktrack_host.tracking.refine import RefinedPoses
from bricktrack_host.tracking.segment import Blobs
from bricktrack_host.tracking.verification import MIN_INLIERS, Correspondence, identity_gate_px, verify

SegmentMethod = Literal["default", "paper"]

_MAX_COAST_NS = 500_000_000  # after so long without LEDs the last pattern says nothing of a shaken brick


@dataclass(frozen=True, slots=True, eq=False)
class Identities:
    """What `identify_run` found.

    Attributes
    ----------
    blob_of_led : ndarray of int64, shape (n, n_leds)
        -1 where an LED was not found.
    R_camera_brick, t_camera_brick_mm : ndarray, shapes (n, 3, 3) and (n, 3)
        The verifying poses, to a tenth of a millimetre or so; NaN where there is none.
    is_ambiguous : ndarray of bool, shape (n,)
    """

    blob_of_led: IntArray
    R_camera_brick: FloatArray
    t_camera_brick_mm: FloatArray
    is_ambiguous: BoolArray


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
    run = _Run(blobs, stamps_ns, ray_model, brick_model, radius_px, collar_mm, method)
    for i in range(len(blobs)):
        if run.is_open(i):
            found = run.search(i)
            if found.n_found:
                run.follow(i)
    return run.result


class _Run:
    """The state of `identify_run`: what is found, and which frames were given up."""

    def __init__(
        self,
        blobs: Sequence[Blobs | None],
        stamps_ns: IntArray,
        ray_model: RayModel,
        brick_model: BrickModel,
        radius_px: float,
        collar_mm: float | None,
        method: SegmentMethod,
    ) -> None:
        n, self._n_leds = len(blobs), brick_model.n_leds
        self._blobs, self._stamps_ns = blobs, stamps_ns
        self._rays, self._brick = ray_model, brick_model
        self._radius_px, self._gate_px = radius_px, identity_gate_px(radius_px)
        self._collar_mm, self._method = collar_mm, method
        self._searched = np.zeros(n, dtype=bool)
        self._doubted = np.zeros(n, dtype=bool)
        self.result = Identities(
            blob_of_led=np.full((n, self._n_leds), -1, dtype=np.int64),
            R_camera_brick=np.full((n, 3, 3), np.nan),
            t_camera_brick_mm=np.full((n, 3), np.nan),
            is_ambiguous=np.zeros(n, dtype=bool),
        )

    def is_open(self, i: int) -> bool:
        """Tell whether a frame has lights enough, no believable identity, and was not searched yet."""
        blobs = self._blobs[i]
        if blobs is None or len(blobs) < MIN_INLIERS or self._searched[i]:
            return False
        if self._doubted[i]:
            return True
        # Two more good lights than identified LEDs: the pattern may hold on to the wrong ones.
        wanted = min(int((blobs.flags == 0).sum()), self._n_leds) - 2
        return int((self.result.blob_of_led[i] >= 0).sum()) < max(wanted, MIN_INLIERS)

    def search(self, i: int) -> Correspondence:
        """Identify a frame from nothing; what the pattern gave stays if it is more."""
        blobs = self._blobs[i]
        assert blobs is not None  # noqa: S101 - is_open said so
        self._searched[i] = True
        found: Correspondence | None = None
        if self._method == "paper":
            found = identify_by_paper(
                blobs, self._rays, self._brick, collar_mm=self._collar_mm, gate_px=self._gate_px
            )
        if found is None or found.n_found == 0:
            found = search_correspondence(blobs, self._rays, self._brick, collar_mm=self._collar_mm)
        if found.n_found > int((self.result.blob_of_led[i] >= 0).sum()):
            self.result.blob_of_led[i] = found.blob_of_led
            self.result.R_camera_brick[i] = found.R_camera_brick
            self.result.t_camera_brick_mm[i] = found.t_camera_brick_mm
        self.result.is_ambiguous[i] = found.is_ambiguous
        return found

    def follow(self, anchor: int) -> None:
        """Carry the identities of a frame to its neighbours on both sides, and verify them together."""
        proposals = self._propose(anchor, range(anchor + 1, len(self._blobs)))
        proposals += self._propose(anchor, range(anchor - 1, -1, -1))
        if not proposals:
            return
        for i, assigned_blobs in proposals:
            # The pattern needs cut lights though others would do: it may hold on to the wrong ones.
            cut, blobs = self._cut_lights(i, assigned_blobs), self._blobs[i]
            n_whole = int(((assigned_blobs >= 0) & ~cut).sum())
            n_others = 0 if blobs is None else int((blobs.flags == 0).sum())
            self._doubted[i] = cut.any() and n_whole < MIN_INLIERS < n_others
        proposals = [(i, self._whole_lights(i, a)) for i, a in proposals]
        frames = np.array([i for i, _ in proposals])
        assigned = np.array([a for _, a in proposals])
        uv = np.stack([_pixels(self._blobs[i], a) for i, a in proposals])
        R, t = prsoi_starts(uv, self._rays, self._brick)
        # Where PRSOI has no answer (LEDs in one plane) the anchor's pose is a start.
        none = ~all_finite(R, 2)
        R[none], t[none] = self.result.R_camera_brick[anchor], self.result.t_camera_brick_mm[anchor]
        kept, poses = self._verify(uv, (R, t))
        wrong = np.flatnonzero(kept.sum(axis=1) < (assigned >= 0).sum(axis=1))
        if wrong.size:  # PRSOI may have converged to a false pose: once more from the nearest believed one
            right = np.flatnonzero(kept.sum(axis=1) == (assigned >= 0).sum(axis=1))
            if right.size:
                nearest = right[np.abs(frames[right][None] - frames[wrong][:, None]).argmin(axis=1)]
                start = (poses.R_camera_brick[nearest], poses.t_camera_brick_mm[nearest])
                kept_again, poses_again = self._verify(uv[wrong], start)
                more = kept_again.sum(axis=1) > kept[wrong].sum(axis=1)
                kept[wrong[more]] = kept_again[more]
                rows = np.flatnonzero(more)
                poses.R_camera_brick[wrong[more]] = poses_again.R_camera_brick[rows]
                poses.t_camera_brick_mm[wrong[more]] = poses_again.t_camera_brick_mm[rows]
        better = kept.sum(axis=1) > (self.result.blob_of_led[frames] >= 0).sum(axis=1)
        at = frames[better]
        self.result.blob_of_led[at] = np.where(kept[better], assigned[better], -1)
        self.result.R_camera_brick[at] = poses.R_camera_brick[better]
        self.result.t_camera_brick_mm[at] = poses.t_camera_brick_mm[better]
        self.result.is_ambiguous[at] = False
        self._complete(at)

    def _cut_lights(self, i: int, assigned: IntArray) -> BoolArray:
        """Tell which LEDs were given a light that the border or a card cuts, or that is two."""
        blobs = self._blobs[i]
        return (
            np.zeros(len(assigned), dtype=bool)
            if blobs is None
            else (assigned >= 0) & (blobs.flags[assigned] != 0)
        )

    def _whole_lights(self, i: int, assigned: IntArray) -> IntArray:
        """Leave cut lights out while five others remain: they pull the pose.

        What is left of an LED has its centroid elsewhere, up to a radius; a pose from it would lose LEDs that
        are whole. `_complete` gives it back where the pose of the others sees it.
        """
        cut = self._cut_lights(i, assigned)
        return np.where(cut, -1, assigned) if int(((assigned >= 0) & ~cut).sum()) > MIN_INLIERS else assigned

    def _complete(self, frames: IntArray) -> None:
        """Give LEDs that the pattern missed the free blob where the verified pose sees them."""
        frames = frames[(self.result.blob_of_led[frames] < 0).any(axis=1)]
        if frames.size == 0:
            return
        R, t = self.result.R_camera_brick[frames], self.result.t_camera_brick_mm[frames]
        prediction, _ = predict_brick(R, t, self._rays, self._brick, collar_mm=self._collar_mm)
        proposals: list[tuple[int, IntArray]] = []
        for row, i in enumerate(frames):
            blobs, assigned = self._blobs[i], self.result.blob_of_led[i].copy()
            if blobs is None:
                continue
            for k in np.flatnonzero((assigned < 0) & (prediction.facing[row] > 0)):
                distance = np.hypot(*(blobs.uv_px - prediction.uv_px[row, k]).T)
                distance[assigned[assigned >= 0]] = np.inf
                nearest = int(np.argmin(distance))
                if distance[nearest] < self._gate_px:
                    assigned[k] = nearest
            if (assigned != self.result.blob_of_led[i]).any():
                proposals.append((int(i), assigned))
        if not proposals:
            return
        at = np.array([i for i, _ in proposals])
        uv = np.stack([_pixels(self._blobs[i], a) for i, a in proposals])
        start = (self.result.R_camera_brick[at], self.result.t_camera_brick_mm[at])
        kept, poses = self._verify(uv, start)
        for row, (i, assigned) in enumerate(proposals):
            if kept[row].sum() > (self.result.blob_of_led[i] >= 0).sum():
                self.result.blob_of_led[i] = np.where(kept[row], assigned, -1)
                if (self._whole_lights(i, assigned) == assigned).all():  # else that of the whole ones stays
                    self.result.R_camera_brick[i] = poses.R_camera_brick[row]
                    self.result.t_camera_brick_mm[i] = poses.t_camera_brick_mm[row]

    def _verify(
        self, uv: FloatArray, starts: tuple[FloatArray, FloatArray]
    ) -> tuple[BoolArray, RefinedPoses]:
        return verify(uv, starts, self._rays, self._brick, collar_mm=self._collar_mm, gate_px=self._gate_px)

    def _propose(self, anchor: int, frames: Iterable[int]) -> list[tuple[int, IntArray]]:
        """Follow the pattern through frames, in the image alone, up to one that is believed already."""
        R, t = self.result.R_camera_brick[anchor], self.result.t_camera_brick_mm[anchor]
        prediction, _ = predict_brick(R[None], t[None], self._rays, self._brick, collar_mm=self._collar_mm)
        pattern = np.where(prediction.facing[0, :, None] > 0, prediction.uv_px[0], np.nan)
        drift = np.zeros(2)
        last_ns = int(self._stamps_ns[anchor])
        out: list[tuple[int, IntArray]] = []
        for i in frames:
            if abs(int(self._stamps_ns[i]) - last_ns) > _MAX_COAST_NS:
                break
            blobs = self._blobs[i]
            if blobs is None or len(blobs) == 0:
                continue
            if (self.result.blob_of_led[i] >= 0).any() and not self.is_open(i):
                break
            gaps = np.linalg.norm(pattern[:, None] - pattern[None], axis=-1)
            closest = float(np.min(gaps[gaps > 0], initial=10 * self._radius_px))
            assigned = assign_predicted(
                blobs.uv_px,
                pattern + drift,
                gate_px=max(0.45 * closest, 0.7 * self._radius_px),
                shift_limit_px=10 * self._radius_px,
            )
            leds = np.flatnonzero(assigned >= 0)
            if leds.size < 3:
                continue
            moved = _similarity(pattern[leds], blobs.uv_px[assigned[leds]], pattern)
            moved[leds] = blobs.uv_px[assigned[leds]]
            drift = np.median(moved[leds] - pattern[leds], axis=0)
            pattern = moved
            last_ns = int(self._stamps_ns[i])
            if leds.size >= MIN_INLIERS:
                out.append((i, assigned))
        return out


def _pixels(blobs: Blobs | None, blob_of_led: IntArray) -> FloatArray:
    uv = np.full((len(blob_of_led), 2), np.nan)
    if blobs is not None:
        uv[blob_of_led >= 0] = blobs.uv_px[blob_of_led[blob_of_led >= 0]]
    return uv


def _similarity(source: FloatArray, target: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (n, 2) after the shift, turn and scale that best bring source onto target."""
    a = (source - source.mean(axis=0)) @ np.array([1.0, 1.0j])
    b = (target - target.mean(axis=0)) @ np.array([1.0, 1.0j])
    factor = np.vdot(a, b) / max(float(np.vdot(a, a).real), 1e-9)
    z = ((points - source.mean(axis=0)) @ np.array([1.0, 1.0j])) * factor
    return np.asarray(np.stack([z.real, z.imag], axis=-1) + target.mean(axis=0))
