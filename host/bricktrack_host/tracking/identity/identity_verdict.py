"""What is beyond doubt in pictures for which assignments of lights to LEDs are proposed.

The proposals are verified, and the likeliest is the answer, in those LEDs in which all agree that are nearly
as likely. Among them are the likeliest one without each of its LEDs: by these the LED's own light has odds.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_host.tracking.identity.identity_motion import unknown_motion
from bricktrack_host.tracking.identity.verification import (
    MIN_INLIERS,
    RunLights,
    Verified,
    in_line,
    verify,
)
from bricktrack_host.tracking.pictures.segment import Blobs
from bricktrack_host.tracking.pose.refine import LedMotion, RefinedPoses

_RIVAL = 4.6  # log odds, 100 to one, of an answer against one with other lights
_LED = 7.0  # 1000 to one, of an LED's light against its being false
_BESIDE_LINE = 4.0
"""50 to one, of the only LED beside others in one line, which tell so little of where it is that of right
ones too one in some hundred has less than 1000 to one."""
_BRICK = 7.0  # log odds of any brick at all: false lights alone reach it in one picture of 1000, at most


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """What is said of n pictures.

    Attributes
    ----------
    row : ndarray of int64, shape (n,)
        Which of the proposals, and of ``poses``, explains a picture best; -1 where none does.
    blob_of_led : ndarray of int64, shape (n, n_leds)
        Lights of LEDs that are beyond doubt, numbered within the picture; -1 for none.
    poses : RefinedPoses
    n_leds : ndarray of int64, shape (n,)
        That the best proposal explains.
    is_chance : ndarray of bool, shape (n,)
        False lights may well lie like that.
    has_rival : ndarray of bool, shape (n,)
        Fewer than four LEDs are beyond doubt, or these stand in one line.
    """

    row: IntArray
    blob_of_led: IntArray
    poses: RefinedPoses
    n_leds: IntArray
    is_chance: BoolArray
    has_rival: BoolArray


class Pictures:
    """Pictures of a brick, at rest or not, in which assignments are verified, each picture for itself.

    Parameters
    ----------
    blobs : sequence of Blobs
    gate_px : ndarray, shape (n,)
        Largest residual that is believed in each.
    collar_mm : float or None
        See `led_profile`.
    """

    def __init__(
        self,
        blobs: Sequence[Blobs],
        ray_model: RayModel,
        brick_model: BrickModel,
        *,
        collar_mm: float | None,
        gate_px: FloatArray,
    ) -> None:
        self._lights = RunLights.of(blobs)
        self._rays, self._brick, self._collar_mm, self._gate_px = ray_model, brick_model, collar_mm, gate_px

    def decide(self, of: IntArray, assigned: IntArray, starts: tuple[FloatArray, FloatArray]) -> Verdict:
        """Say what is beyond doubt.

        Parameters
        ----------
        of : ndarray of int64, shape (m,)
            Picture of each proposal.
        assigned : ndarray of int64, shape (m, n_leds)
            Lights of the LEDs, numbered within the picture; -1 for none.
        starts : (R, t)
            Poses, shapes (m, 3, 3) and (m, 3), mm.
        """
        verified = self._verified(of, assigned, starts)
        kept = np.where(verified.kept, assigned, -1)
        best = _likeliest(of, verified.log_evidence)
        best = best[np.isfinite(verified.log_evidence[best])]
        row = np.full(self._lights.count.size, -1)
        row[of[best]] = best
        poses, evidence = verified.poses, verified.log_evidence
        at, without = _each_left_out(kept, best)
        less = self._verified(of[at], without, _starts(poses, at), intruders=False)
        answer = np.where(row[:, None] >= 0, kept[row], -1)
        others = np.concatenate([kept, np.where(less.kept, without, -1)])
        is_doubtful = _doubtful(
            answer,
            evidence[row],
            np.concatenate([of, of[at]]),
            others,
            np.concatenate([evidence, less.log_evidence]),
            is_in_line=in_line(others >= 0, self._brick),
        )
        n_leds = (answer >= 0).sum(axis=1)
        answer[is_doubtful] = -1
        has_rival = ((answer >= 0).sum(axis=1) < MIN_INLIERS) | in_line(answer >= 0, self._brick)
        is_chance = evidence[row] < _BRICK
        again = np.flatnonzero(is_doubtful.any(axis=1) & (row >= 0) & ~has_rival & ~is_chance)
        if again.size:
            fitted = self._verified(again, answer[again], _starts(poses, row[again]), intruders=False)
            poses = poses.replaced(row[again], fitted.poses)
            has_rival[again] = (fitted.kept != (answer[again] >= 0)).any(axis=1)
        return Verdict(row, answer, poses, n_leds, is_chance, has_rival)

    def _verified(
        self,
        of: IntArray,
        assigned: IntArray,
        starts: tuple[FloatArray, FloatArray],
        *,
        intruders: bool = True,
    ) -> Verified:
        """Verify assignments; where a brick at rest does not explain a picture, of one that moves as well."""
        lights = self._lights.of_leds(of, assigned)

        def verify_some(rows: IntArray, motion: LedMotion | None) -> Verified:
            return verify(
                lights.take(rows),
                (starts[0][rows], starts[1][rows]),
                self._rays,
                self._brick,
                collar_mm=self._collar_mm,
                gate_px=self._gate_px[of[rows]],
                picture=of[rows],
                intruders=intruders,
                motion=motion,
                n_lights=self._lights.count[of[rows]],
            )

        verified = verify_some(np.arange(of.size), None)
        best = _likeliest(of, verified.log_evidence)
        is_at_rest = np.zeros(self._lights.count.size, dtype=bool)
        is_at_rest[of[best]] = ~verified.is_scattered[best] & np.isfinite(verified.log_evidence[best])
        rows = np.flatnonzero(~is_at_rest[of])
        if rows.size == 0:
            return verified
        moving = verify_some(rows, unknown_motion(lights.take(rows).uv_px, self._rays))
        better = moving.log_evidence > verified.log_evidence[rows]
        return verified.replaced(rows[better], moving.take(np.flatnonzero(better)))


def _likeliest(of: IntArray, log_evidence: FloatArray) -> IntArray:
    """Return the likeliest assignment of each picture that has any."""
    order = np.lexsort((-log_evidence, of))
    return np.asarray(order[np.unique(of[order], return_index=True)[1]])


def _each_left_out(kept: IntArray, rows: IntArray) -> tuple[IntArray, IntArray]:
    """Return the rows, repeated, and their assignments without one LED each that leave enough."""
    at, led = np.nonzero(kept[rows] >= 0)
    at = rows[at]
    without = kept[at]
    without[np.arange(at.size), led] = -1
    enough = (without >= 0).sum(axis=1) >= MIN_INLIERS
    return at[enough], without[enough]


def _starts(poses: RefinedPoses, rows: IntArray) -> tuple[FloatArray, FloatArray]:
    return poses.R_camera_brick[rows], poses.t_camera_brick_mm[rows]


def _doubtful(
    answer: IntArray,
    log_evidence: FloatArray,
    of: IntArray,
    others: IntArray,
    others_evidence: FloatArray,
    *,
    is_in_line: BoolArray,
) -> BoolArray:
    """Return which LEDs of answers (n, n_leds) other assignments ``of`` the same pictures leave in doubt."""
    own = answer[of]
    has_other_lights = ((others >= 0) & (others != own)).any(axis=1)
    margin = np.where(has_other_lights, _RIVAL, np.where(is_in_line, _BESIDE_LINE, _LED))
    near = (own >= 0).any(axis=1) & (others_evidence > log_evidence[of] - margin)
    out = np.zeros(answer.shape, dtype=bool)
    np.logical_or.at(out, of, near[:, None] & (own >= 0) & (others != own))
    return out
