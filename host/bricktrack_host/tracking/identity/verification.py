"""What makes an identity believed, whichever way it was proposed: a pose that explains the blobs.

`verify` fits a pose and keeps the LEDs whose blobs it explains. Where two assignments explain the picture
equally well, that is the answer; none is chosen.
"""

from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, rows_of, with_rows
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_host.tracking.identity.assigned_lights import MIN_INLIERS, LedLights
from bricktrack_host.tracking.identity.evidence import Evidence
from bricktrack_host.tracking.identity.weighing import weighed_at
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.prsoi import ROUGH_MM, prsoi_starts
from bricktrack_host.tracking.pose.refine import LedMotion, RefinedPoses, refine_poses

MIN_FACING = 0.05
"""Cosine between an LED's axis and the line of sight below which it is not believed to be seen."""
_MAX_BAD, _MAX_INTRUDERS = 3, 2
_SLIM = 1e-3  # ratio of the singular values of the positions of LEDs in one line
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
        some = replace(lights.take(rows), uv_px=uv)
        return weighed_at(
            some, poses, ray_model, brick_model, collar_mm=collar_mm, motion=within, n_lights=n_lights[rows]
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
    out = np.zeros(len(given), dtype=bool)
    if not len(given):
        return out
    # Most frames show the same LEDs: once for them, and once for each that shows others.
    same = (given == given[0]).all(axis=1)
    sets = np.concatenate([given[:1], given[~same]])
    P = np.where(sets[..., None], brick_model.led_positions_mm, 0.0)
    middle = P.sum(axis=1, keepdims=True) / np.maximum(sets.sum(axis=1), 1)[:, None, None]
    size = np.linalg.svd(np.where(sets[..., None], P - middle, 0.0), compute_uv=False)
    is_line = size[:, 1] <= _SLIM * size[:, 0]
    out[same], out[~same] = is_line[0], is_line[1:]
    return out


def identity_gate_px(radius_px: float) -> float:
    """Return the residual up to which a blob is believed to be its LED: a third of its radius, over 4 px.

    An unfitted profile shifts centroids by up to a fifth of the radius, a rolling shutter by more at times;
    LEDs are more than three radii apart.
    """
    return max(4.0, radius_px / 3)
