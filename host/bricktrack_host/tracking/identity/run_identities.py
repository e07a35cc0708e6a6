"""The identities of a run while they are being decided: what is found so far, and tools to change it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_host.tracking.identity.assigned_lights import LedLights, RunLights
from bricktrack_host.tracking.identity.identity_motion import RunMotion, run_motion
from bricktrack_host.tracking.identity.verification import Verified, identity_gate_px, in_line, verify
from bricktrack_host.tracking.led_model.led_profile import LedPrediction, predict_brick
from bricktrack_host.tracking.pictures.segment import Blobs
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.neighbour_poses import poses_between, turn_between
from bricktrack_host.tracking.pose.refine import LedMotion

SUSPECT, NEAR_FRAMES = 3.0, 9
"""Residuals so many times those of so many frames about are not the motion's alone."""


@dataclass(frozen=True, slots=True, eq=False)
class Identities:
    """What `led_identity.identify_run` found.

    Attributes
    ----------
    blob_of_led : ndarray of int64, shape (n, n_leds)
        -1 where an LED was not found.
    R_camera_brick, t_camera_brick_mm : ndarray, shapes (n, 3, 3) and (n, 3)
        The verifying poses, to a tenth of a millimetre or so; NaN where there is none.
    is_ambiguous : ndarray of bool, shape (n,)
    is_strayed : ndarray of bool, shape (n, n_leds)
        The light is where the LED is seen, within the gate, but farther than its pose explains: what a card
        or the border leaves of the LED, or another light; or a jolt moved it while the rows were read, which
        its area tells.
    """

    blob_of_led: IntArray
    R_camera_brick: FloatArray
    t_camera_brick_mm: FloatArray
    is_ambiguous: BoolArray
    is_strayed: BoolArray


class RunIdentities:
    """The lights of a run and what is believed of them so far, in ``found``, which is changed in place."""

    def __init__(
        self,
        blobs: Sequence[Blobs | None],
        stamps_ns: IntArray,
        ray_model: RayModel,
        brick_model: BrickModel,
        *,
        radius_px: float,
        collar_mm: float | None,
    ) -> None:
        n, n_leds = len(blobs), brick_model.n_leds
        self.blobs, self.stamps_ns = blobs, np.asarray(stamps_ns, dtype=np.int64)
        self.ray_model, self.brick_model, self.collar_mm = ray_model, brick_model, collar_mm
        self.radius_px, self.gate_px = radius_px, identity_gate_px(radius_px)
        self.lights = RunLights.of(blobs)
        self.found = Identities(
            blob_of_led=np.full((n, n_leds), -1, dtype=np.int64),
            R_camera_brick=np.full((n, 3, 3), np.nan),
            t_camera_brick_mm=np.full((n, 3), np.nan),
            is_ambiguous=np.zeros(n, dtype=bool),
            is_strayed=np.zeros((n, n_leds), dtype=bool),
        )
        self._motion: tuple[tuple[IntArray, FloatArray, FloatArray], RunMotion] | None = None

    @property
    def n_found(self) -> IntArray:
        """Number of LEDs with a light in each frame."""
        return np.asarray((self.found.blob_of_led >= 0).sum(axis=1))

    def known_frames(self) -> IntArray:
        """Return the frames that have an identity."""
        return np.flatnonzero(self.n_found)

    def lights_of(self, frames: IntArray) -> LedLights:
        """Return the lights that the LEDs of frames have."""
        return self.lights.of_leds(frames, self.found.blob_of_led[frames])

    def predict(self, frames: IntArray) -> LedPrediction:
        """Return where the poses of frames show the LEDs."""
        R, t_mm = self.found.R_camera_brick[frames], self.found.t_camera_brick_mm[frames]
        return predict_brick(R, t_mm, self.ray_model, self.brick_model, collar_mm=self.collar_mm)[0]

    def turns(self) -> tuple[FloatArray, FloatArray]:
        """Return how far frames turn from where their neighbours show them, rad, and these attitudes."""
        R = self.found.R_camera_brick
        between, _ = poses_between(self.stamps_ns, R, self.found.t_camera_brick_mm)
        return turn_between(R, between), between

    def motion(self, R_camera_brick: FloatArray | None = None) -> RunMotion:
        """Return the run's motion by the poses found, or with other attitudes; NaN: a frame tells nothing."""
        R = self.found.R_camera_brick if R_camera_brick is None else R_camera_brick
        given = self.found.blob_of_led, R, self.found.t_camera_brick_mm
        if self._motion is not None:
            before, motion = self._motion
            if all(np.array_equal(a, b, equal_nan=True) for a, b in zip(given, before, strict=True)):
                return motion
        motion = run_motion(
            self.stamps_ns,
            self.lights_of(np.arange(len(self.blobs))).uv_px,
            R,
            self.found.t_camera_brick_mm,
            self.ray_model,
            self.brick_model,
            collar_mm=self.collar_mm,
        )
        self._motion = (given[0].copy(), R.copy(), given[2].copy()), motion
        return motion

    def verify(
        self,
        lights: LedLights,
        starts: tuple[FloatArray, FloatArray],
        *,
        intruders: bool = False,
        weighed: bool = False,
        motion: LedMotion | None = None,
        gate_px: FloatArray | None = None,
        n_lights: IntArray | None = None,
    ) -> Verified:
        """Verify assignments; ``gate_px``, of each one, is that of whole lights: cut ones have the usual."""
        gate = np.full(len(lights.uv_px), self.gate_px) if gate_px is None else gate_px
        verified = verify(
            lights,
            starts,
            self.ray_model,
            self.brick_model,
            collar_mm=self.collar_mm,
            gate_px=np.where(lights.is_whole, gate[:, None], self.gate_px),
            intruders=intruders,
            weighed=weighed,
            motion=motion,
            n_lights=n_lights,
        )
        verified.kept[in_line(verified.kept, self.brick_model)] = False
        return verified

    def take(
        self, frames: IntArray, assigned: IntArray, verified: Verified, better: BoolArray | None = None
    ) -> None:
        """Believe verified assignments of frames, those that are better than what there is."""
        better = np.ones(frames.size, dtype=bool) if better is None else better
        at = frames[better]
        self.found.blob_of_led[at] = np.where(verified.kept[better], assigned[better], -1)
        self.found.R_camera_brick[at] = verified.poses.R_camera_brick[better]
        self.found.t_camera_brick_mm[at] = verified.poses.t_camera_brick_mm[better]

    def refuse(self, frames: IntArray) -> None:
        """Believe nothing of frames."""
        self.found.blob_of_led[frames] = -1
        self.found.R_camera_brick[frames] = np.nan
        self.found.t_camera_brick_mm[frames] = np.nan

    def with_free_lights(self, frames: IntArray) -> tuple[IntArray, IntArray]:
        """Return frames in which LEDs without a light are seen near a free one, and assignments with it."""
        frames = frames[(self.found.blob_of_led[frames] < 0).any(axis=1)]
        out = self.found.blob_of_led[frames]
        if frames.size == 0:
            return frames, out
        prediction = self.predict(frames)
        for row, k in np.argwhere((out < 0) & (prediction.facing > 0)):
            begin, end = self.lights.first[frames[row] : frames[row] + 2]
            distance = np.hypot(*(self.lights.uv_px[begin:end] - prediction.uv_px[row, k]).T)
            distance[out[row, out[row] >= 0]] = np.inf
            nearest = int(np.argmin(distance))
            if distance[nearest] < self.gate_px:
                out[row, k] = nearest
        more = (out != self.found.blob_of_led[frames]).any(axis=1)
        return frames[more], out[more]


def is_whole(verified: Verified, lights: LedLights) -> BoolArray:
    """Tell which assignments are believed with all their LEDs."""
    return np.asarray(verified.kept.sum(axis=1) == all_finite(lights.uv_px).sum(axis=1))


def scatter_px(verified: Verified) -> FloatArray:
    """Return the root of the squared residuals per degree of freedom; 0 where there is no pose."""
    freedom = np.maximum(2 * verified.kept.sum(axis=1) - 6, 1)
    return np.asarray(np.sqrt(_squares_px2(verified) / freedom))


def rms_px(verified: Verified) -> FloatArray:
    """Return the root mean square residual of each assignment; 0 where it has no pose."""
    return np.asarray(np.sqrt(_squares_px2(verified) / np.maximum(verified.kept.sum(axis=1), 1)))


def _squares_px2(verified: Verified) -> FloatArray:
    squares = np.where(verified.kept, (verified.poses.residual_px**2).sum(axis=-1), 0.0)
    return np.asarray(squares.sum(axis=1))
