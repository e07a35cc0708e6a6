"""What makes an identity believed, whichever way it was proposed: a pose that explains the blobs.

`verify` fits a pose and keeps the LEDs whose blobs it explains. Where two assignments explain the picture
equally well, that is the answer; none is chosen.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, rows_of, with_rows
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.rotations import matrix_from_rvec
from bricktrack_host.tracking.identity.evidence import Evidence, Given, Shown, evidence_of
from bricktrack_host.tracking.identity.identity_motion import unknown_motion
from bricktrack_host.tracking.led_model.led_profile import predict_brick, shift_per_radius
from bricktrack_host.tracking.pictures.segment import Blobs
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.frame_motion import UNKNOWN_TWIST_SD
from bricktrack_host.tracking.pose.prsoi import ROUGH_MM, prsoi_starts
from bricktrack_host.tracking.pose.refine import LedMotion, RefinedPoses, refine_poses

MIN_INLIERS = 4
MIN_FACING = 0.05
"""Cosine between an LED's axis and the line of sight below which it is not believed to be seen."""
_MAX_BAD, _MAX_INTRUDERS = 3, 2
_COLLARS, _BETWEEN_COLLARS = (0.0, 0.2, 0.4, 0.6), 0.05
"""Guesses of a collar that was not fitted, in LED radii, and what each leaves, about: the shift of the
centroid to the next guess, in radii times the sine of the view angle."""
_SLIM = 1e-3  # ratio of the singular values of the positions of LEDs in one line
_ANY_MM = np.array([0.0, 0.0, 130.0])  # in place of what is not known
_HOPELESS = 25.0  # log likelihood below the best of the picture: an intruder left out does not make up for it
_CUT_SD_GATES = 0.9
"""Trust in a cut light, over the gate: what is left has its centroid elsewhere, up to a radius."""
_IDENTITY_SD_PX = 1.5
"""Trust in a blob while identities are decided: far above centroid noise, so that rolling shutter and an
unfitted profile do not refuse a true assignment, far below the distance between two LEDs."""


@dataclass(frozen=True, slots=True, eq=False)
class Correspondence:
    """Identities in one picture, verified by a pose, or why there are none.

    Attributes
    ----------
    blob_of_led : ndarray of int64, shape (n_leds,)
        Index of the blob, -1 where the LED was not found.
    R_camera_brick, t_camera_brick_mm : ndarray, shapes (3, 3) and (3,)
        The pose that verified it; NaN where there is none.
    rms_px : float
        Of its residuals; NaN where there is none.
    is_ambiguous : bool
        Another assignment or pose fits as well.
    reason : str
        In words, why there is no assignment; empty where there is one.
    """

    blob_of_led: IntArray
    R_camera_brick: FloatArray
    t_camera_brick_mm: FloatArray
    rms_px: float
    is_ambiguous: bool
    reason: str

    @property
    def n_found(self) -> int:
        """Number of LEDs with a blob."""
        return int((self.blob_of_led >= 0).sum())


def no_correspondence(n_leds: int, reason: str, *, ambiguous: bool = False) -> Correspondence:
    """Return the answer "none", with its reason."""
    return Correspondence(
        blob_of_led=np.full(n_leds, -1, dtype=np.int64),
        R_camera_brick=np.full((3, 3), np.nan),
        t_camera_brick_mm=np.full(3, np.nan),
        rms_px=float("nan"),
        is_ambiguous=ambiguous,
        reason=reason,
    )


def verified_correspondence(blob_of_led: IntArray, poses: RefinedPoses, i: int) -> Correspondence:
    """Return an assignment with the ``i``-th of the poses, which explains it."""
    r = poses.residual_px[i][blob_of_led >= 0]
    return Correspondence(
        blob_of_led=blob_of_led,
        R_camera_brick=poses.R_camera_brick[i],
        t_camera_brick_mm=poses.t_camera_brick_mm[i],
        rms_px=float(np.sqrt(np.mean(np.sum(r**2, axis=-1)))),
        is_ambiguous=False,
        reason="",
    )


@dataclass(frozen=True, slots=True, eq=False)
class LedLights:
    """The lights that assignments give to LEDs; NaN for none.

    Attributes
    ----------
    uv_px : ndarray, shape (n, n_leds, 2), px
    cov_px2 : ndarray, shape (n, n_leds, 2, 2), px^2
    area_px2 : ndarray, shape (n, n_leds), px^2
    is_whole : ndarray of bool, shape (n, n_leds)
        False where the border or a card cuts a light, or it is two.
    """

    uv_px: FloatArray
    cov_px2: FloatArray
    area_px2: FloatArray
    is_whole: BoolArray

    def take(self, rows: IntArray) -> "LedLights":
        """Return some of the assignments."""
        return rows_of(self, rows)


@dataclass(frozen=True, slots=True, eq=False)
class RunLights:
    """The lights of many pictures, one after the other.

    Attributes
    ----------
    first : ndarray of int64, shape (n_pictures + 1,)
        Where each picture's begin.
    uv_px, cov_px2, area_px2, flags : ndarray, shapes (n, 2), (n, 2, 2), (n,) and (n,)
        See `segment.Blobs`.
    """

    first: IntArray
    uv_px: FloatArray
    cov_px2: FloatArray
    area_px2: FloatArray
    flags: IntArray

    @staticmethod
    def of(pictures: Sequence[Blobs | None]) -> "RunLights":
        """Put the lights of pictures together; `None` has none."""
        given = [b for b in pictures if b is not None]
        count = [0 if b is None else len(b) for b in pictures]
        return RunLights(
            first=np.concatenate([[0], np.cumsum(count)]).astype(np.int64),
            uv_px=np.concatenate([np.empty((0, 2)), *(b.uv_px for b in given)]),
            cov_px2=np.concatenate([np.empty((0, 2, 2)), *(b.cov_px2 for b in given)]),
            area_px2=np.concatenate([np.empty(0), *(b.area_px2 for b in given)]),
            flags=np.concatenate([np.empty(0, dtype=np.int64), *(b.flags for b in given)]),
        )

    @property
    def count(self) -> IntArray:
        """Number of lights of each picture."""
        return np.diff(self.first)

    def of_leds(self, pictures: IntArray, blob_of_led: IntArray) -> LedLights:
        """Take the lights of assignments (n, n_leds), numbered within each one's picture; -1 for none."""
        given = blob_of_led >= 0
        index = np.where(given, self.first[pictures][:, None] + blob_of_led, 0)
        uv, cov, area = (self._taken(x, index, given) for x in (self.uv_px, self.cov_px2, self.area_px2))
        return LedLights(
            uv, cov, area, given & (self._taken(self.flags.astype(np.float64), index, given) == 0)
        )

    @staticmethod
    def _taken(values: FloatArray, index: IntArray, given: BoolArray) -> FloatArray:
        out = np.full((*index.shape, *values.shape[1:]), np.nan)
        out[given] = values[index[given]]
        return out


@dataclass(frozen=True, slots=True, eq=False)
class Verified:
    """What `verify` found.

    Attributes
    ----------
    kept : ndarray of bool, shape (n, n_leds)
        LEDs that are explained; all false where fewer than four.
    poses : RefinedPoses
    log_evidence : ndarray, shape (n,)
        See `evidence`.
    is_scattered : ndarray of bool, shape (n,)
        The residuals are larger than those of a brick at rest.
    """

    kept: BoolArray
    poses: RefinedPoses
    log_evidence: FloatArray
    is_scattered: BoolArray

    def take(self, rows: IntArray) -> "Verified":
        """Return some of the assignments."""
        return rows_of(self, rows)

    def replaced(self, rows: IntArray, by: "Verified") -> "Verified":
        """Return these with some replaced."""
        return with_rows(self, rows, by)


def verify(
    lights: LedLights,
    starts: tuple[FloatArray, FloatArray] | None,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    collar_mm: float | None,
    gate_px: FloatArray | float,
    picture: IntArray | None = None,
    intruders: bool = True,
    weighed: bool = True,
    motion: LedMotion | None = None,
    n_lights: IntArray | None = None,
) -> Verified:
    """Fit poses to assignments and keep the LEDs that each pose explains.

    Parameters
    ----------
    lights : LedLights
        Of each LED under each of n assignments.
    starts : (R, t) or None
        Shapes (n, 3, 3) and (n, 3); `None`: by PRSOI.
    gate_px : float or ndarray, shape (n,) or (n, n_leds)
        Largest residual that is believed.
    picture : ndarray of int64, shape (n,), optional
        Assignments of one picture compete: the hopeless are not looked at further. Default: each has its own.
    intruders : bool
        False: LEDs are left out only beyond the gate, however much the residuals scatter.
    weighed : bool
        False: without intruders, the evidence is not wanted, and NaN.
    motion : LedMotion, optional
        How the brick moves within each of the n pictures, read out row by row; default: not at all.
    n_lights : ndarray of int64, shape (n,), optional
        Of each one's picture; default: as many as there are LEDs.

    Notes
    -----
    LEDs beyond the gate, or that the pose hides, are left out one at a time, the worst: a false light drags
    its neighbours' residuals with it. Where residuals scatter more than centroids do, a false light may be
    among them: the assignment is tried without each of its LEDs. The likeliest of these is taken where it is
    likelier.
    """
    uv = lights.uv_px.copy()
    n = len(uv)
    R, t = starts if starts is not None else prsoi_starts(uv, ray_model, brick_model, tolerance_mm=ROUGH_MM)
    gate = np.asarray(gate_px, dtype=np.float64)
    gate = np.broadcast_to(gate[:, None] if gate.ndim == 1 else gate, uv.shape[:2])
    picture = np.arange(n) if picture is None else picture
    n_lights = np.full(n, brick_model.n_leds) if n_lights is None else n_lights
    mode = ray_model.sensor_mode
    variance = np.where(lights.is_whole, _IDENTITY_SD_PX**2, (_CUT_SD_GATES * gate) ** 2)
    cov = variance[..., None, None] * np.eye(2)

    def fit(rows: IntArray, uv: FloatArray, R: FloatArray, t: FloatArray) -> RefinedPoses:
        return refine_poses(
            uv,
            cov[rows],
            R,
            t,
            ray_model,
            brick_model,
            collar_mm=collar_mm,
            motion=None if motion is None else motion_of(motion, rows),
            max_steps=6,
        )

    def weigh(rows: IntArray, uv: FloatArray, poses: RefinedPoses) -> Evidence:
        within = None if motion is None else motion_of(motion, rows)
        given = _given(lights.take(rows), uv, within, n_lights[rows], ray_model)
        return evidence_of(
            given,
            _guesses(poses, within, ray_model, brick_model, collar_mm),
            all_finite(uv),
            poses.t_camera_brick_mm[:, 2],
            n_pixels=mode.width * mode.height,
            min_leds=MIN_INLIERS,
        )

    def start(rows: IntArray) -> tuple[FloatArray, FloatArray]:
        known = all_finite(poses.R_camera_brick[rows], 2)
        return (
            np.where(known[:, None, None], poses.R_camera_brick[rows], R[rows]),
            np.where(known[:, None], poses.t_camera_brick_mm[rows], t[rows]),
        )

    poses = fit(np.arange(n), uv, R, t)
    for _ in range(_MAX_BAD):
        length, bad = _beyond(uv, poses, gate)
        rows = np.flatnonzero(bad.any(axis=1))
        if rows.size == 0:
            break
        uv[rows, np.where(bad[rows], length[rows], -1.0).argmax(axis=1)] = np.nan
        poses = poses.replaced(rows, fit(rows, uv[rows], *start(rows)))
    if intruders or weighed:
        evidence = weigh(np.arange(n), uv, poses)
    else:
        evidence = Evidence(np.full(n, np.nan), np.zeros(n, dtype=bool))
    for _ in range(_MAX_INTRUDERS if intruders else 0):
        best = np.full(int(picture.max(initial=0)) + 1, -np.inf)
        np.maximum.at(best, picture, evidence.log_ratio)
        hopeful = evidence.log_ratio > best[picture] - _HOPELESS
        rows = np.flatnonzero(hopeful & evidence.is_scattered & (all_finite(uv).sum(axis=1) > MIN_INLIERS))
        row, led = np.nonzero(all_finite(uv[rows]))
        if row.size == 0:
            break
        tried = uv[rows[row]]
        tried[np.arange(len(row)), led] = np.nan
        pose = ~in_line(all_finite(tried), brick_model)
        row, tried = row[pose], tried[pose]
        if row.size == 0:
            break
        without = fit(rows[row], tried, *start(rows[row]))
        new = weigh(rows[row], tried, without)
        gain = new.log_ratio - evidence.log_ratio[rows[row]]
        order = np.lexsort((-gain, row))
        top = order[np.unique(row[order], return_index=True)[1]]  # the likeliest of each row
        top = top[gain[top] > 0]
        if top.size == 0:
            break
        at = rows[row[top]]
        uv[at] = tried[top]
        poses, evidence = poses.replaced(at, without.take(top)), evidence.replaced(at, new.take(top))
    _, bad = _beyond(uv, poses, gate)
    kept = np.asarray(all_finite(uv) & ~bad.any(axis=1, keepdims=True))
    kept[kept.sum(axis=1) < MIN_INLIERS] = False
    return Verified(
        kept, poses, np.where(kept.any(axis=1), evidence.log_ratio, -np.inf), evidence.is_scattered
    )


def _given(
    lights: LedLights, uv_px: FloatArray, motion: LedMotion | None, n_lights: IntArray, ray_model: RayModel
) -> Given:
    within = unknown_motion(uv_px, ray_model) if motion is None else motion
    return Given(
        uv_px=uv_px,
        cov_px2=lights.cov_px2,
        area_px2=lights.area_px2,
        is_whole=lights.is_whole,
        dt_s=within.dt_s,
        twist_sd=np.tile(UNKNOWN_TWIST_SD, (len(uv_px), 1)) if within.twist_sd is None else within.twist_sd,
        n_lights=n_lights,
    )


def _guesses(
    poses: RefinedPoses,
    motion: LedMotion | None,
    ray_model: RayModel,
    brick_model: BrickModel,
    collar_mm: float | None,
) -> list[Shown]:
    """Return what poses show by each guess of the profile: one where it was fitted."""
    R, t_mm = poses.R_camera_brick[:, None], poses.t_camera_brick_mm[:, None]
    if motion is not None:
        R, t_mm = R @ matrix_from_rvec(motion.rvec_brick_rad), t_mm + motion.shift_camera_mm
    posed = all_finite(R, 3) & all_finite(t_mm, 2)
    R, t_mm = (
        np.where(posed[:, None, None, None], R, np.eye(3)),
        np.where(posed[:, None, None], t_mm, _ANY_MM),
    )
    wider, collars_mm = 1.0, [collar_mm or 0.0]
    if collar_mm is None:
        radius_mm = float(np.median(brick_model.led_radii_mm))
        wider = _BETWEEN_COLLARS / shift_per_radius(0.0, brick_model)
        collars_mm = [share * radius_mm for share in _COLLARS]
    out = []
    for guess_mm in collars_mm:
        seen, J = predict_brick(R, t_mm, ray_model, brick_model, collar_mm=guess_mm)
        places = np.where(posed[:, None, None], seen.uv_px, np.nan)
        out.append(Shown(places, seen.area_px2, seen.facing, J, wider * seen.model_shift_px))
    return out


def motion_of(motion: LedMotion, rows: IntArray) -> LedMotion:
    """Return the motion within some of the pictures."""
    return LedMotion(
        rvec_brick_rad=motion.rvec_brick_rad[rows],
        shift_camera_mm=motion.shift_camera_mm[rows],
        dt_s=motion.dt_s[rows],
        twist_sd=None if motion.twist_sd is None else motion.twist_sd[rows],
    )


def _beyond(uv: FloatArray, poses: RefinedPoses, gate: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the residuals' lengths, and which LEDs are beyond the gate or cannot be seen, (n, n_leds)."""
    seen = all_finite(uv)
    length = np.where(seen, np.nan_to_num(np.linalg.norm(poses.residual_px, axis=-1), nan=np.inf), 0.0)
    return length, seen & ~((length <= gate) & (poses.facing > MIN_FACING))


def in_line(given: BoolArray, brick_model: BrickModel) -> BoolArray:
    """Tell which sets of LEDs (n, n_leds) stand in one line: they have no pose, whatever fits them."""
    P = np.where(given[..., None], brick_model.led_positions_mm, 0.0)
    middle = P.sum(axis=1, keepdims=True) / np.maximum(given.sum(axis=1), 1)[:, None, None]
    size = np.linalg.svd(np.where(given[..., None], P - middle, 0.0), compute_uv=False)
    return np.asarray(size[:, 1] <= _SLIM * size[:, 0])


def identity_gate_px(radius_px: float) -> float:
    """Return the residual up to which a blob is believed to be its LED: a third of its radius, over 4 px.

    An unfitted profile shifts centroids by up to a fifth of the radius, a rolling shutter by more at times;
    LEDs are more than three radii apart.
    """
    return max(4.0, radius_px / 3)
