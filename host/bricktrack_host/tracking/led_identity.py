"""Identities through a whole run: which light of which picture is which LED.

The lights of all pictures are at hand, so the slow parts run on many frames at once: from one identified
frame the pattern of LEDs is followed, forwards and backwards, in the image alone; then the poses of all those
frames verify it together. Frames that the poses refute, and the first, are searched from nothing. At last the
run's own motion judges every frame (`identity_motion`): what scatters or turns off its course is mended, or
refused.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.ndimage import maximum_filter, median_filter

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_host.tracking.correspondence import search_correspondence
from bricktrack_host.tracking.finite import all_finite
from bricktrack_host.tracking.identity_motion import (
    RunMotion,
    poses_between,
    run_motion,
    turn_between,
    unknown_motion,
)
from bricktrack_host.tracking.led_profile import predict_brick
from bricktrack_host.tracking.paper_rules import identify_by_paper
from bricktrack_host.tracking.pattern import NOT_FOLLOWED, assign_predicted, follow_pattern
from bricktrack_host.tracking.prsoi import ROUGH_MM, prsoi_starts
from bricktrack_host.tracking.refine import LedMotion
from bricktrack_host.tracking.segment import Blobs
from bricktrack_host.tracking.verification import (
    MIN_INLIERS,
    Correspondence,
    LedLights,
    RunLights,
    Verified,
    identity_gate_px,
    motion_of,
    verify,
)

SegmentMethod = Literal["default", "paper"]

_MAX_COAST_NS = 500_000_000  # after so long without LEDs the last pattern says nothing of a shaken brick

_SUSPECT, _NEAR_FRAMES = 3.0, 9
_MOVED_PX = 0.5  # residuals beyond this may be a motion's
_LEAST_GATE_PX = 0.5  # what calibration and profile may leave, beside centroid noise
_LEAST_TURN_RAD = 0.01  # off the cubic through its neighbours; a 2 degree shake at 6 Hz is 0.011 off
_MOST_TURN_RAD = 0.1  # no shaken brick's, where its run is smooth
_SAME_TURN = 0.7  # share of a turn that is left without any one LED where it is the brick that turned
_NEAR_TURNS = 31
_WARM_ROUNDS, _SETTLE_ROUNDS = 2, 3


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
    is_strayed : ndarray of bool, shape (n, n_leds)
        The light is where the LED is seen, within the gate, but farther than its pose explains: what a card
        or the border leaves of the LED, or another light. Not for poses.
    """

    blob_of_led: IntArray
    R_camera_brick: FloatArray
    t_camera_brick_mm: FloatArray
    is_ambiguous: BoolArray
    is_strayed: BoolArray


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
    i = run.next_open(0)
    while i is not None:
        if run.search(i).n_found:
            run.follow(i)
        i = run.next_open(i + 1)
    run.settle()
    run.take_strayed_lights()
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
        self._blobs, self._stamps_ns = blobs, np.asarray(stamps_ns, dtype=np.int64)
        self._rays, self._brick = ray_model, brick_model
        self._radius_px, self._gate_px = radius_px, identity_gate_px(radius_px)
        self._collar_mm, self._method = collar_mm, method
        self._lights = RunLights.of(blobs)
        of = np.repeat(np.arange(n), self._lights.count)
        self._n_whole = np.bincount(of[self._lights.flags == 0], minlength=n)
        self._searched = np.zeros(n, dtype=bool)
        self._doubted = np.zeros(n, dtype=bool)
        self.result = Identities(
            blob_of_led=np.full((n, self._n_leds), -1, dtype=np.int64),
            R_camera_brick=np.full((n, 3, 3), np.nan),
            t_camera_brick_mm=np.full((n, 3), np.nan),
            is_ambiguous=np.zeros(n, dtype=bool),
            is_strayed=np.zeros((n, self._n_leds), dtype=bool),
        )

    def _open(self) -> BoolArray:
        """Tell which frames have lights enough, no believable identity, and were not searched yet."""
        # Two more good lights than identified LEDs: the pattern may hold on to the wrong ones.
        wanted = np.minimum(self._n_whole, self._n_leds) - 2
        few = (self.result.blob_of_led >= 0).sum(axis=1) < np.maximum(wanted, MIN_INLIERS)
        lit = self._lights.count >= MIN_INLIERS
        return np.asarray(lit & ~self._searched & (self._doubted | few))

    def next_open(self, i: int) -> int | None:
        """Return the first frame from ``i`` on that is to be searched, or `None`."""
        found = np.flatnonzero(self._open()[i:])
        return i + int(found[0]) if found.size else None

    def search(self, i: int) -> Correspondence:
        """Identify a frame from nothing; what the pattern gave stays if it is more."""
        blobs = self._blobs[i]
        assert blobs is not None  # noqa: S101 - it has lights
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
        R, t = self.result.R_camera_brick[anchor], self.result.t_camera_brick_mm[anchor]
        prediction, _ = predict_brick(R[None], t[None], self._rays, self._brick, collar_mm=self._collar_mm)
        followed = follow_pattern(
            self._lights.uv_px,
            self._lights.first,
            self._stamps_ns,
            (self.result.blob_of_led >= 0).any(axis=1) & ~self._open(),
            anchor,
            np.where(prediction.facing[0, :, None] > 0, prediction.uv_px[0], np.nan),
            radius_px=self._radius_px,
            max_coast_ns=_MAX_COAST_NS,
        )
        frames = np.flatnonzero(followed[:, 0] != NOT_FOLLOWED)
        if frames.size == 0:
            return
        assigned = followed[frames]
        lights = self._lights.of_leds(frames, assigned)
        # The pattern needs cut lights though others would do: it may hold on to the wrong ones.
        cut = (assigned >= 0) & ~lights.is_whole
        self._doubted[frames] = cut.any(axis=1) & (lights.is_whole.sum(axis=1) < MIN_INLIERS)
        self._doubted[frames] &= self._n_whole[frames] > MIN_INLIERS
        verified = self._verified(lights, R, t, frames)
        better = verified.kept.sum(axis=1) > (self.result.blob_of_led[frames] >= 0).sum(axis=1)
        self._take(frames, assigned, verified, better)
        self.result.is_ambiguous[frames[better]] = False
        self._complete(frames[better])

    def _verified(self, lights: LedLights, R: FloatArray, t: FloatArray, frames: IntArray) -> Verified:
        """Verify assignments of frames; ``R`` and ``t`` are the pose of the frame they were followed from."""
        starts = prsoi_starts(lights.uv_px, self._rays, self._brick, tolerance_mm=ROUGH_MM)
        none = ~all_finite(starts[0], 2)  # LEDs in one plane
        starts[0][none], starts[1][none] = R, t
        verified = self._verify(lights, starts, intruders=False)
        kept = verified.kept.sum(axis=1)
        whole = kept == all_finite(lights.uv_px).sum(axis=1)
        wrong, right = np.flatnonzero(~whole), np.flatnonzero(whole)
        if wrong.size and right.size:
            # PRSOI may have converged to a false pose: once more from the nearest frame that is believed.
            nearest = right[np.abs(frames[right][None] - frames[wrong][:, None]).argmin(axis=1)]
            start = (verified.poses.R_camera_brick[nearest], verified.poses.t_camera_brick_mm[nearest])
            again = self._verify(lights.take(wrong), start, intruders=False)
            more = again.kept.sum(axis=1) > kept[wrong]
            verified = verified.replaced(wrong[more], again.take(np.flatnonzero(more)))
        moved = np.flatnonzero(~_is_whole(verified, lights) | (_rms_px(verified) > _MOVED_PX))
        if moved.size:
            # Read out row by row, a brick in motion is out of shape.
            some = lights.take(moved)
            known = all_finite(verified.poses.R_camera_brick[moved], 2)
            start = (
                np.where(known[:, None, None], verified.poses.R_camera_brick[moved], starts[0][moved]),
                np.where(known[:, None], verified.poses.t_camera_brick_mm[moved], starts[1][moved]),
            )
            motion = unknown_motion(some.uv_px, self._rays)
            again = self._verify(some, start, intruders=False, motion=motion)
            more = again.kept.sum(axis=1) >= verified.kept[moved].sum(axis=1)
            verified = verified.replaced(moved[more], again.take(np.flatnonzero(more)))
        # A moving brick's residuals scatter, alike from frame to frame; where one frame's are far larger than
        # its neighbours', a false light may be among its own.
        rms = _rms_px(verified)
        suspect = np.flatnonzero(rms > _SUSPECT * median_filter(rms, _NEAR_FRAMES, mode="nearest"))
        if suspect.size == 0:
            return verified
        poses = verified.poses
        again = self._verify(
            lights.take(suspect), (poses.R_camera_brick[suspect], poses.t_camera_brick_mm[suspect])
        )
        return verified.replaced(suspect, again)

    def _verify(
        self,
        lights: LedLights,
        starts: tuple[FloatArray, FloatArray],
        *,
        intruders: bool = True,
        motion: LedMotion | None = None,
        gate_px: FloatArray | None = None,
    ) -> Verified:
        return verify(
            lights,
            starts,
            self._rays,
            self._brick,
            collar_mm=self._collar_mm,
            gate_px=self._gate_px if gate_px is None else gate_px,
            intruders=intruders,
            motion=motion,
        )

    def _take(self, frames: IntArray, assigned: IntArray, verified: Verified, better: BoolArray) -> None:
        """Believe verified assignments of frames where they are better than what there is."""
        at = frames[better]
        self.result.blob_of_led[at] = np.where(verified.kept[better], assigned[better], -1)
        self.result.R_camera_brick[at] = verified.poses.R_camera_brick[better]
        self.result.t_camera_brick_mm[at] = verified.poses.t_camera_brick_mm[better]

    def _complete(self, frames: IntArray) -> None:
        """Give LEDs that the pattern missed the free light where the verified pose sees them."""
        at, assigned = self._with_free_lights(frames)
        if at.size == 0:
            return
        start = (self.result.R_camera_brick[at], self.result.t_camera_brick_mm[at])
        verified = self._verify(self._lights.of_leds(at, assigned), start, intruders=False)
        more = verified.kept.sum(axis=1) > (self.result.blob_of_led[at] >= 0).sum(axis=1)
        self._take(at, assigned, verified, more)

    def settle(self) -> None:
        """Judge every frame by how the run moves: its shape is then known, and the gate its neighbours' own.

        Frames that scatter beyond their neighbours are identified again, from where the others show the LEDs;
        what then does not fit is refused.
        """
        self._refuse_lone()
        had = (self.result.blob_of_led >= 0).any(axis=1)
        self._settle_rounds()
        n_found = (self.result.blob_of_led >= 0).sum(axis=1)
        # What is left beside frames that were refused, with no neighbours to judge it by, may be the culprit.
        beside = maximum_filter((had & (n_found == 0)).astype(np.int64), 5, mode="constant") > 0
        R, t = self.result.R_camera_brick, self.result.t_camera_brick_mm
        turn = turn_between(R, poses_between(self._stamps_ns, R, t)[0])
        self._refuse(np.flatnonzero(beside & (n_found > 0) & (n_found < self._n_leds) & np.isnan(turn)))

    def _refuse_lone(self) -> None:
        """Refuse frames of four lights, which fit by chance, that no frame beside them bears out."""
        n_found = (self.result.blob_of_led >= 0).sum(axis=1)
        known = np.flatnonzero(n_found)
        R, t = self.result.R_camera_brick, self.result.t_camera_brick_mm
        turn = turn_between(R, poses_between(self._stamps_ns, R, t)[0])
        lone = np.isnan(turn[known]) & (n_found[known] <= MIN_INLIERS)
        lone[:2], lone[-2:] = False, False
        self._refuse(known[lone])

    def _settle_rounds(self) -> None:
        for round_ in range(_WARM_ROUNDS + _SETTLE_ROUNDS):
            frames = np.flatnonzero((self.result.blob_of_led >= 0).any(axis=1))
            if frames.size < _NEAR_FRAMES:
                return
            assigned = self.result.blob_of_led[frames]
            lights = self._lights.of_leds(frames, assigned)
            motion = self._motion()
            verified = self._verify_known(
                frames, lights, motion.within, motion, self._gate_px, intruders=False
            )
            before = self.result.blob_of_led.copy()
            if (
                round_ < _WARM_ROUNDS and np.median(_scatter_px(verified)) > _LEAST_GATE_PX / _SUSPECT
            ):  # poses first, which the motion between them makes better
                self._take(frames, assigned, verified, _is_whole(verified, lights))
                continue
            usual = median_filter(_scatter_px(verified), _NEAR_FRAMES, mode="nearest")
            tight = np.clip(_SUSPECT * usual, _LEAST_GATE_PX, self._gate_px)
            good = _is_whole(verified, lights) & (_scatter_px(verified) <= tight)
            bad = np.flatnonzero(~good)
            if bad.size:  # the spline may be a neighbour's fault
                some = lights.take(bad)
                unknown = unknown_motion(some.uv_px, self._rays)
                again = self._verify_known(frames[bad], some, unknown, motion, self._gate_px, intruders=False)
                fits = _is_whole(again, some) & (_scatter_px(again) <= tight[bad])
                verified = verified.replaced(bad[fits], again.take(np.flatnonzero(fits)))
                good[bad[fits]] = True
            self._take(frames, assigned, verified, good)
            tight_px = np.interp(np.arange(len(self._blobs)), frames, tight)
            self._leave_twins(tight_px)
            limit = self._mend_lurches(tight_px)
            self._refuse(frames[~good])
            self._again(tight_px, limit)
            if (self.result.blob_of_led == before).all():
                return

    def _leave_twins(self, tight_px: FloatArray) -> None:
        """Take the other pose of frames in a twin: LEDs nearly in one plane have two, which fit alike."""
        R, t = self.result.R_camera_brick, self.result.t_camera_brick_mm
        turn = turn_between(R, poses_between(self._stamps_ns, R, t)[0])
        calm = np.flatnonzero(turn <= 2 * _LEAST_TURN_RAD)
        frames = np.flatnonzero(turn > _MOST_TURN_RAD / 2)
        if calm.size == 0 or frames.size == 0:
            return
        nearest = calm[np.abs(calm[None] - frames[:, None]).argmin(axis=1)]
        assigned = self.result.blob_of_led[frames]
        lights = self._lights.of_leds(frames, assigned)
        verified = self._verify(
            lights,
            (R[nearest], t[nearest]),
            intruders=False,
            motion=unknown_motion(lights.uv_px, self._rays),
            gate_px=np.where(lights.is_whole, tight_px[frames][:, None], self._gate_px),
        )
        nearer = turn_between(verified.poses.R_camera_brick, R[nearest]) < 0.5 * turn_between(
            R[frames], R[nearest]
        )
        fits = _is_whole(verified, lights) & (_scatter_px(verified) <= tight_px[frames])
        self._take(frames, assigned, verified, fits & nearer)

    def _mend_lurches(self, tight_px: FloatArray) -> FloatArray:
        """Leave out the one LED without which a frame does not turn away from its neighbours.

        Some LEDs decide the attitude nearly alone: a false light in one's place turns the pose, and fits.
        Where the frame turns without any of them as well, it is the brick that did.
        Returns the turns that are usual, rad, shape (n,).
        """
        R, t = self.result.R_camera_brick, self.result.t_camera_brick_mm
        between, _ = poses_between(self._stamps_ns, R, t)
        turn = turn_between(R, between)
        judged = np.flatnonzero(np.isfinite(turn))
        if judged.size == 0:
            return np.full(len(R), _LEAST_TURN_RAD)
        usual = median_filter(turn[judged], _NEAR_TURNS)
        usual = np.interp(np.arange(len(R)), judged, usual)
        turn = np.nan_to_num(turn)
        limit = np.clip(_SUSPECT * usual, _LEAST_TURN_RAD, _MOST_TURN_RAD)
        frames = np.flatnonzero(turn > limit)
        if frames.size == 0:
            return limit
        row, led = np.nonzero(self.result.blob_of_led[frames] >= 0)
        tried = self.result.blob_of_led[frames[row]]
        tried[np.arange(len(row)), led] = -1
        at = frames[row]
        lights = self._lights.of_leds(at, tried)
        known_R = np.where(np.isfinite(between), between, R)
        worst = turn >= maximum_filter(turn, 5, mode="nearest")
        rest = np.where((worst & (turn > limit))[:, None, None], np.nan, R)
        motion = motion_of(self._motion(rest).within, at)
        gate = np.where(lights.is_whole, tight_px[at][:, None], self._gate_px)
        verified = self._verify(lights, (known_R[at], t[at]), intruders=False, motion=motion, gate_px=gate)
        kept = verified.kept.sum(axis=1)
        left = turn_between(verified.poses.R_camera_brick, between[at])
        left = np.where(_is_whole(verified, lights) & (kept >= MIN_INLIERS), left, np.nan)
        calm = np.nan_to_num(left, nan=np.inf) <= limit[at]
        best = np.full(frames.size, -1)
        for i in np.unique(row[calm]):
            mine = np.flatnonzero((row == i) & calm)
            best[i] = mine[verified.log_evidence[mine].argmax()]
        # A frame that is off turns its neighbours' cubics too, by less.
        mendable = np.zeros(len(R))
        mendable[frames] = np.where(best >= 0, turn[frames], 0.0)
        first = (best >= 0) & (turn[frames] >= maximum_filter(mendable, 5, mode="nearest")[frames])
        mended = best[first]
        self._take(at[mended], tried[mended], verified.take(mended), np.ones(mended.size, dtype=bool))
        least = np.full(frames.size, np.inf)
        np.fmin.at(least, row, left)
        few = (self.result.blob_of_led[frames] >= 0).sum(axis=1) <= MIN_INLIERS
        doubtful = few | ~(least > _SAME_TURN * turn[frames]) | np.isinf(least)
        # In a run that turns smoothly; one that jumps from frame to frame tells nothing by its neighbours.
        doubtful |= (turn[frames] > _MOST_TURN_RAD) & (limit[frames] < _MOST_TURN_RAD)
        self._refuse(frames[doubtful & worst[frames] & (best < 0)])
        return limit

    def _again(self, tight_px: FloatArray, limit_rad: FloatArray) -> None:
        """Identify frames without an identity, and LEDs without a light, from where the run shows them."""
        motion = self._motion()
        n_found = (self.result.blob_of_led >= 0).sum(axis=1)
        known = all_finite(motion.R_camera_brick, 2) & (self._lights.count >= MIN_INLIERS)
        frames = np.flatnonzero(known & (n_found < self._n_leds))
        if frames.size == 0:
            return
        new = np.full((frames.size, self._n_leds), -1, dtype=np.int64)
        for row, i in enumerate(frames):
            begin, end = self._lights.first[i : i + 2]
            limit = 4 * self._radius_px if n_found[i] == 0 else self._gate_px
            new[row] = assign_predicted(
                self._lights.uv_px[begin:end],
                motion.uv_px[i],
                gate_px=0.7 * self._radius_px if n_found[i] == 0 else self._gate_px,
                shift_limit_px=limit,
            )
        changed = (new != self.result.blob_of_led[frames]).any(axis=1) & (
            (new >= 0).sum(axis=1) >= MIN_INLIERS
        )
        frames, new = frames[changed], new[changed]
        if frames.size == 0:
            return
        lights = self._lights.of_leds(frames, new)
        verified = self._verify_known(frames, lights, motion.within, motion, tight_px, intruders=True)
        better = self._is_better(frames, verified, motion, n_found, limit_rad)
        rest = np.flatnonzero(~better)
        if rest.size:
            some = lights.take(rest)
            unknown = unknown_motion(some.uv_px, self._rays)
            again = self._verify_known(frames[rest], some, unknown, motion, tight_px, intruders=True)
            more = self._is_better(frames[rest], again, motion, n_found, limit_rad)
            verified = verified.replaced(rest[more], again.take(np.flatnonzero(more)))
            better[rest[more]] = True
        self._take(frames, new, verified, better)
        self.result.is_ambiguous[frames[better]] = False

    def _is_better(
        self,
        frames: IntArray,
        verified: Verified,
        motion: RunMotion,
        n_found: IntArray,
        limit_rad: FloatArray,
    ) -> BoolArray:
        """Tell which frames have more LEDs than were found, without a turn."""
        turn = turn_between(verified.poses.R_camera_brick, motion.R_camera_brick[frames])
        calm = np.nan_to_num(turn, nan=np.inf) <= np.maximum(limit_rad[frames], 3 * _LEAST_TURN_RAD)
        return np.asarray(calm & (verified.kept.sum(axis=1) > n_found[frames]))

    def _motion(self, R: FloatArray | None = None) -> RunMotion:
        blob = self.result.blob_of_led
        every = self._lights.of_leds(np.arange(len(blob)), blob)
        return run_motion(
            self._stamps_ns,
            every.uv_px,
            self.result.R_camera_brick if R is None else R,
            self.result.t_camera_brick_mm,
            self._rays,
            self._brick,
            collar_mm=self._collar_mm,
        )

    def _verify_known(
        self,
        frames: IntArray,
        lights: LedLights,
        within: LedMotion,
        motion: RunMotion,
        gate_px: FloatArray | float,
        *,
        intruders: bool,
    ) -> Verified:
        """Verify assignments of frames whose motion is known; what is cut may be off by the usual gate."""
        gate = np.broadcast_to(np.asarray(gate_px, dtype=np.float64), len(self._blobs))[frames]
        return self._verify(
            lights,
            (motion.R_camera_brick[frames], motion.t_camera_brick_mm[frames]),
            intruders=intruders,
            motion=within if len(within.dt_s) == len(frames) else motion_of(within, frames),
            gate_px=np.where(lights.is_whole, gate[:, None], self._gate_px),
        )

    def _refuse(self, frames: IntArray) -> None:
        self.result.blob_of_led[frames] = -1
        self.result.R_camera_brick[frames] = np.nan
        self.result.t_camera_brick_mm[frames] = np.nan

    def take_strayed_lights(self) -> None:
        """Give LEDs without a light a free one within the gate, as strayed: see `Identities.is_strayed`."""
        at, assigned = self._with_free_lights(np.flatnonzero((self.result.blob_of_led >= 0).any(axis=1)))
        self.result.is_strayed[at] = (assigned >= 0) & (self.result.blob_of_led[at] < 0)
        self.result.blob_of_led[at] = assigned

    def _with_free_lights(self, frames: IntArray) -> tuple[IntArray, IntArray]:
        """Return frames in which LEDs without a light are seen near a free one, and assignments with it."""
        frames = frames[(self.result.blob_of_led[frames] < 0).any(axis=1)]
        out = self.result.blob_of_led[frames]
        if frames.size == 0:
            return frames, out
        R, t = self.result.R_camera_brick[frames], self.result.t_camera_brick_mm[frames]
        prediction, _ = predict_brick(R, t, self._rays, self._brick, collar_mm=self._collar_mm)
        for row, k in np.argwhere((out < 0) & (prediction.facing > 0)):
            begin, end = self._lights.first[frames[row] : frames[row] + 2]
            distance = np.hypot(*(self._lights.uv_px[begin:end] - prediction.uv_px[row, k]).T)
            distance[out[row, out[row] >= 0]] = np.inf
            nearest = int(np.argmin(distance))
            if distance[nearest] < self._gate_px:
                out[row, k] = nearest
        more = (out != self.result.blob_of_led[frames]).any(axis=1)
        return frames[more], out[more]


def _is_whole(verified: Verified, lights: LedLights) -> BoolArray:
    """Tell which assignments are believed with all their LEDs."""
    return np.asarray(verified.kept.sum(axis=1) == all_finite(lights.uv_px).sum(axis=1))


def _scatter_px(verified: Verified) -> FloatArray:
    """Return the root of the squared residuals per degree of freedom; 0 where there is no pose."""
    squares = np.where(verified.kept, (verified.poses.residual_px**2).sum(axis=-1), 0.0).sum(axis=1)
    return np.asarray(np.sqrt(squares / np.maximum(2 * verified.kept.sum(axis=1) - 6, 1)))


def _rms_px(verified: Verified) -> FloatArray:
    """Return the root mean square residual of each assignment; 0 where it has no pose."""
    squares = np.where(verified.kept, (verified.poses.residual_px**2).sum(axis=-1), 0.0).sum(axis=1)
    return np.asarray(np.sqrt(squares / np.maximum(verified.kept.sum(axis=1), 1)))
