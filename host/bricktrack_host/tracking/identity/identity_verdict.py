"""What is beyond doubt in pictures for which assignments of lights to LEDs are proposed.

The proposals are verified, and weighed with the likeliest ones without each of their LEDs. The likeliest is
the answer, in those LEDs whose lights have the odds of all that agree against all that do not. The less an
LED is needed, the surer it must be: five that fit bear each other out, a sixth or seventh tells little more,
and a false light beside a hidden LED comes as one of these.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_host.tracking.identity.assigned_lights import MIN_INLIERS, RunLights
from bricktrack_host.tracking.identity.identity_motion import unknown_motion
from bricktrack_host.tracking.identity.verification import Verified, in_line, verify
from bricktrack_host.tracking.identity.weighing import weighed_at
from bricktrack_host.tracking.pictures.segment import Blobs
from bricktrack_host.tracking.pose.refine import LedMotion, RefinedPoses

_WELL_BORNE_OUT = 5  # LEDs: two more numbers than a pose with one to spare needs
_AMONG_FIVE = 4.0  # log odds, 50 to one, of each LED's light against all else that was weighed
_BEYOND_FIVE = 10.0
"""20,000 to one. Of lights within 3 px of a hidden LED of a simulated brick at rest, which come in 1 of 7000
pictures with five false lights, 10 % are named by odds of 7 and 4 % by these."""
_AMONG_FEWER = 7.0  # 1000 to one
_CONTENDS = 12.0  # log odds below the best at which an assignment without each of its LEDs may still matter
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
        # An LED that was left out as an intruder may be right, and another the false one.
        reduced = (kept != assigned).any(axis=1) & (evidence > evidence[row[of]] - _CONTENDS) & (row[of] >= 0)
        at, without = _each_left_out(
            np.concatenate([kept[best], assigned[reduced]]),
            np.concatenate([best, np.flatnonzero(reduced)]),
        )
        # Two false lights may bear each other out.
        again_at, less = _each_left_out(without, at)
        two = verified.is_scattered[again_at]
        at, without = np.append(at, again_at[two]), np.concatenate([without, less[two]])
        answer = np.where(row[:, None] >= 0, kept[row], -1)
        log_odds = _log_odds(
            answer,
            np.concatenate([of, of[at]]),
            np.concatenate([kept, without]),
            np.concatenate([evidence, self._weighed(of[at], without, poses.take(at))]),
        )
        n_leds = (answer >= 0).sum(axis=1)
        whole = answer
        answer = self._beyond_doubt(whole, log_odds)
        has_rival = ~self._is_enough(answer)
        is_chance = evidence[row] < _BRICK
        again = np.flatnonzero((answer != whole).any(axis=1) & (row >= 0) & ~has_rival & ~is_chance)
        if again.size:
            fitted = self._verified(again, answer[again], _starts(poses, row[again]), intruders=False)
            poses = poses.replaced(row[again], fitted.poses)
            has_rival[again] = (fitted.kept != (answer[again] >= 0)).any(axis=1)
        return Verdict(row, answer, poses, n_leds, is_chance, has_rival)

    def _beyond_doubt(self, assigned: IntArray, log_odds: FloatArray) -> IntArray:
        """Return assignments without the LEDs whose odds, (n, n_leds), do not do."""
        rank = (-log_odds).argsort(axis=1, kind="stable").argsort(axis=1)
        needed = np.where(rank < _WELL_BORNE_OUT, _AMONG_FIVE, _BEYOND_FIVE)
        out = np.where(log_odds > needed, assigned, -1)
        few = ((out >= 0).sum(axis=1) < _WELL_BORNE_OUT) | ~self._is_enough(out)
        out[few] = np.where(log_odds > _AMONG_FEWER, assigned, -1)[few]
        return out

    def _is_enough(self, assigned: IntArray) -> BoolArray:
        """Tell which assignments have a pose, with an LED to spare."""
        given = assigned >= 0
        return np.asarray((given.sum(axis=1) >= MIN_INLIERS) & ~in_line(given, self._brick))

    def _weighed(self, of: IntArray, assigned: IntArray, poses: RefinedPoses) -> FloatArray:
        """Return what speaks for assignments of an LED less than the given poses were fitted to."""
        out = np.full(of.size, -np.inf)
        line = in_line(assigned >= 0, self._brick)
        rows = np.flatnonzero(line)  # they have no pose of their own, but all those about the line
        if rows.size:
            out[rows] = weighed_at(
                self._lights.of_leds(of[rows], assigned[rows]),
                poses.take(rows),
                self._rays,
                self._brick,
                collar_mm=self._collar_mm,
                motion=None,
                n_lights=self._lights.count[of[rows]],
            ).log_ratio
        rows = np.flatnonzero(~line)
        less = self._verified(of[rows], assigned[rows], _starts(poses, rows), intruders=False)
        is_whole = (less.kept == (assigned[rows] >= 0)).all(axis=1)
        out[rows] = np.where(is_whole, less.log_evidence, -np.inf)
        return out

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


def _each_left_out(assigned: IntArray, rows: IntArray) -> tuple[IntArray, IntArray]:
    """Return the rows, repeated, and their assignments without one LED each that leave enough."""
    at, led = np.nonzero(assigned >= 0)
    without = assigned[at]
    without[np.arange(at.size), led] = -1
    enough = (without >= 0).sum(axis=1) >= MIN_INLIERS
    return rows[at[enough]], without[enough]


def _starts(poses: RefinedPoses, rows: IntArray) -> tuple[FloatArray, FloatArray]:
    return poses.R_camera_brick[rows], poses.t_camera_brick_mm[rows]


def _log_odds(answer: IntArray, of: IntArray, assigned: IntArray, log_evidence: FloatArray) -> FloatArray:
    """Return the odds of the lights that answers (n, n_leds) give to LEDs, by all that was weighed.

    Parameters
    ----------
    of, assigned, log_evidence : ndarray, shapes (m,), (m, n_leds) and (m,)
        Pictures, assignments and what speaks for them; some may come more than once.
    """
    order = np.lexsort((-log_evidence, *assigned.T, of))
    order = order[np.isfinite(log_evidence[order])]
    key = np.column_stack([of, assigned])[order]
    order = order[np.append(True, (np.diff(key, axis=0) != 0).any(axis=1))[: order.size]]
    out = np.full(answer.shape, -np.inf)
    if order.size == 0:
        return out
    picture, first = np.unique(of[order], return_index=True)
    agrees = assigned[order] == answer[of[order]]
    weight = log_evidence[order, None]
    with_it = np.logaddexp.reduceat(np.where(agrees, weight, -np.inf), first, axis=0)
    without = np.logaddexp.reduceat(np.where(agrees, -np.inf, weight), first, axis=0)
    out[picture] = with_it - np.logaddexp(without, 0.0)  # or no brick at all
    return np.where(answer >= 0, out, -np.inf)
