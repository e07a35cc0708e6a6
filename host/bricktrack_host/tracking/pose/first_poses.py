"""A first pose of every frame, taken for one instant: from PRSOI, and from three LEDs where that is in doubt.

A frame with few LEDs can have two poses that the pixels cannot tell apart. It gets none, unless the frame
beside it is near one of the two and far from the other. In motion, taken for one instant, the wrong one can
fit better: then too the frame beside it tells, if it has one pose only.
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.tracking.led_model.led_profile import collar_of
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.p3p import ray_centre_mm, rays_of, solve_p3p
from bricktrack_host.tracking.pose.prsoi import START_MM, PrsoiForm, prsoi_starts
from bricktrack_host.tracking.pose.refine import MIN_LEDS, RefinedPoses, refine_poses

_DOUBT_CHI2_PER_DOF = 9.0
RIVAL_CHI2 = 9.0  # three sigma: below this two poses cannot be told apart
SAME_POSE_RAD = 0.02
_SAME_PLACE_MM = 2.0
_QUICK_STEPS, _STEPS = 3, 20


@dataclass(frozen=True, slots=True, eq=False)
class FirstPoses:
    """Poses to start from, which do not depend on how the brick moves.

    Attributes
    ----------
    uv_px : ndarray, shape (n, n_leds, 2), px
        The centroids that they were had from; NaN where none was seen or used.
    R_camera_brick, t_camera_brick_mm : ndarray, shapes (n, 3, 3) and (n, 3)
        NaN where there is none.
    is_ambiguous : ndarray of bool, shape (n,)
        Two poses fit as well; there is none then.
    """

    uv_px: FloatArray
    R_camera_brick: FloatArray
    t_camera_brick_mm: FloatArray
    is_ambiguous: BoolArray


def first_poses(
    uv_px: FloatArray,
    cov_px2: FloatArray,
    t_ns: IntArray,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    form: PrsoiForm = "safe",
) -> FirstPoses:
    """Return first poses of a run's frames.

    Parameters
    ----------
    uv_px : ndarray, shape (n, n_leds, 2), px
        Centroids; NaN where an LED is not seen or not to be used.
    cov_px2 : ndarray, shape (n, n_leds, 2, 2), px^2
    t_ns : ndarray of int64, shape (n,)
        Instants of the frames.
    ray_model : RayModel
    brick_model : BrickModel
    form : "safe" or "printed"
        Of PRSOI, see there.
    """
    R, t = prsoi_starts(uv_px, ray_model, brick_model, form, tolerance_mm=START_MM)
    poses = refine_poses(uv_px, cov_px2, R, t, ray_model, brick_model, collar_mm=collar_of(brick_model))
    poses, ambiguous = _other_starts(uv_px, cov_px2, poses, t_ns, ray_model, brick_model)
    return FirstPoses(uv_px, poses.R_camera_brick, poses.t_camera_brick_mm, ambiguous)


def degrees_of_freedom(uv_px: FloatArray) -> FloatArray:
    """Return two for each LED seen less the six of a pose, shape (n,); negative below three LEDs."""
    return np.asarray(2.0 * all_finite(uv_px).sum(axis=1) - 6.0)


def _other_starts(
    uv: FloatArray,
    cov: FloatArray,
    poses: RefinedPoses,
    t_ns: IntArray,
    ray_model: RayModel,
    brick_model: BrickModel,
) -> tuple[RefinedPoses, BoolArray]:
    """Try poses from three LEDs where the first pose is missing, doubtful, or could have a twin.

    Returns the better poses, and which frames have two that the pixels cannot tell apart; those have NaN.
    """
    n, n_leds = uv.shape[:2]
    seen = all_finite(uv)
    enough = seen.sum(axis=1) >= MIN_LEDS
    bad = ~np.isfinite(poses.chi2)
    bad |= poses.chi2 > _DOUBT_CHI2_PER_DOF * np.maximum(degrees_of_freedom(uv), 1)
    hidden = seen.sum(axis=1) < n_leds
    frames = np.flatnonzero(enough & (bad | hidden))
    ambiguous = np.zeros(n, dtype=bool)
    if frames.size == 0:
        return poses, ambiguous
    R_try, t_try, chi2 = _poses_from_three(uv[frames], cov[frames], poses, frames, ray_model, brick_model)
    R_out, t_out = poses.R_camera_brick.copy(), poses.t_camera_brick_mm.copy()
    own = np.where(np.isfinite(poses.chi2[frames]), poses.chi2[frames], np.inf)
    all_chi2 = np.concatenate([chi2, own[:, None]], axis=1)
    posed = np.flatnonzero(np.isfinite(all_chi2).any(axis=1))
    all_chi2, i = all_chi2[posed], frames[posed]
    all_R = np.concatenate([R_try[posed], R_out[i, None]], axis=1)
    all_t = np.concatenate([t_try[posed], t_out[i, None]], axis=1)
    best = np.arange(len(posed)), np.argmin(all_chi2, axis=1)
    R_out[i], t_out[i] = all_R[best], all_t[best]
    # Taken for one instant a frame in motion misfits: what of its poses fits best says no more than a frame
    # beside it that leaves no choice.
    least = all_chi2[best]
    misfit = np.maximum(least / np.maximum(degrees_of_freedom(uv[i]), 1), 1.0)
    row, rival = np.nonzero(all_chi2 < (least + RIVAL_CHI2 * misfit)[:, None])
    turn = np.linalg.norm(rvec_from_matrix(np.swapaxes(R_out[i[row]], -1, -2) @ all_R[row, rival]), axis=1)
    apart = turn > SAME_POSE_RAD
    is_open = np.zeros(n, dtype=bool)
    is_open[i[row[apart]]] = True
    ambiguous[i[row[apart & (all_chi2[row, rival] < least[row] + RIVAL_CHI2)]]] = True
    alike = all_chi2 / misfit[:, None]
    believe_neighbours(is_open, R_out, t_out, all_R, all_t, alike, i, t_ns, one_by_one=False)
    ambiguous &= is_open
    believe_neighbours(ambiguous, R_out, t_out, R_try, t_try, chi2, frames, t_ns)
    R_out[ambiguous] = np.nan
    changed = frames[((R_out != poses.R_camera_brick) | np.isnan(R_out)).any(axis=(1, 2))[frames]]
    again = refine_poses(
        uv[changed], cov[changed], R_out[changed], t_out[changed], ray_model, brick_model,
        collar_mm=collar_of(brick_model),
    )  # fmt: skip
    return poses.replaced(changed, again), ambiguous


def _poses_from_three(
    uv: FloatArray,
    cov: FloatArray,
    poses: RefinedPoses,
    frames: IntArray,
    ray_model: RayModel,
    brick_model: BrickModel,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return refined poses of ``frames`` from three LEDs each, shapes (m, 4, 3, 3), (m, 4, 3), and chi2.

    Chi-square, shape (m, 4), is infinite where there is no such pose, or it would hide an LED that is seen.
    """
    seen = all_finite(uv)
    patterns, pattern_of = np.unique(seen, axis=0, return_inverse=True)
    triple = np.array([_widest_triple(brick_model.led_positions_mm, s) for s in patterns])[pattern_of.ravel()]
    centre = ray_centre_mm(ray_model)
    points, _ = rays_of(ray_model, uv[np.arange(len(uv))[:, None], triple])
    bearing = points - centre
    bearing /= np.linalg.norm(bearing, axis=-1, keepdims=True)
    R, t, valid = solve_p3p(bearing, brick_model.led_positions_mm[triple])
    k = R.shape[1]
    R = np.where(valid[..., None, None], R, np.nan).reshape(-1, 3, 3)
    t = np.where(valid[..., None], t + centre, np.nan).reshape(-1, 3)
    of = np.repeat(np.arange(len(uv)), k)  # the row of `uv` that a try is of
    collar_mm = collar_of(brick_model)
    own_R, own_t = poses.R_camera_brick[frames[of]], poses.t_camera_brick_mm[frames[of]]

    def fit(rows: IntArray, R: FloatArray, t: FloatArray, steps: int) -> RefinedPoses:
        return refine_poses(
            uv[of[rows]], cov[of[rows]], R, t, ray_model, brick_model, collar_mm=collar_mm, max_steps=steps
        )

    # Most tries end at the pose that the frame has already: where a fifth LED tells twins apart, those on
    # their way to it go no further. With four LEDs tries are followed to the end, along whatever valley.
    enough = (seen.sum(axis=1) > MIN_LEDS)[of]
    quick, slow = np.flatnonzero(enough), np.flatnonzero(~enough)
    tries = fit(np.arange(len(of)), np.where(enough[:, None, None], R, np.nan), t, _QUICK_STEPS)
    turned = np.linalg.norm(rvec_from_matrix(np.swapaxes(own_R, -1, -2) @ tries.R_camera_brick), axis=1)
    apart_mm = np.linalg.norm(own_t - tries.t_camera_brick_mm, axis=1)
    same = enough & (turned < 0.5 * SAME_POSE_RAD) & (apart_mm < _SAME_PLACE_MM)
    rows = quick[(~same & np.isfinite(tries.chi2))[quick]]
    if rows.size:
        again = fit(rows, tries.R_camera_brick[rows], tries.t_camera_brick_mm[rows], _STEPS - _QUICK_STEPS)
        tries = tries.replaced(rows, again)
    if slow.size:
        tries = tries.replaced(slow, fit(slow, R[slow], t[slow], _STEPS))
    facing = np.where(same[:, None], poses.facing[frames[of]], tries.facing)
    chi2 = np.where(same, poses.chi2[frames[of]], tries.chi2)
    visible = np.where(seen[of], facing > 0, True).all(axis=1)
    return (
        np.where(same[:, None, None], own_R, tries.R_camera_brick).reshape(-1, k, 3, 3),
        np.where(same[:, None], own_t, tries.t_camera_brick_mm).reshape(-1, k, 3),
        np.where(np.isfinite(chi2) & visible, chi2, np.inf).reshape(-1, k),
    )


def believe_neighbours(
    ambiguous: BoolArray,
    R: FloatArray,
    t: FloatArray,
    R_try: FloatArray,
    t_try: FloatArray,
    chi2: FloatArray,
    frames: IntArray,
    t_ns: IntArray,
    *,
    one_by_one: bool = True,
) -> None:
    """Settle frames with two poses by the frame beside them, if near one and far from the other.

    One by one: what is settled settles the next.
    """
    if not ambiguous.any():
        return
    may_settle = ~ambiguous
    period = float(np.median(np.diff(t_ns))) if len(t_ns) > 1 else 0.0
    row_of = {int(i): row for row, i in enumerate(frames)}
    for order in (range(len(t_ns)), range(len(t_ns) - 1, -1, -1)):
        before: int | None = None
        for i in order:
            if ambiguous[i] and before is not None and abs(int(t_ns[i] - t_ns[before])) < 1.5 * period:
                row = row_of[i]
                near = np.isfinite(chi2[row]) & (chi2[row] < np.nanmin(chi2[row]) + RIVAL_CHI2)
                index = np.flatnonzero(near)
                turn = np.linalg.norm(rvec_from_matrix(R[before].T @ R_try[row, index]), axis=1)
                rank = np.argsort(turn)
                others = turn[rank][turn[rank] > turn[rank[0]] + SAME_POSE_RAD]
                if others.size == 0 or others[0] > 4 * turn[rank[0]] + 0.05:
                    pick = index[rank[0]]
                    R[i], t[i] = R_try[row, pick], t_try[row, pick]
                    ambiguous[i] = False
            if (may_settle[i] or (one_by_one and not ambiguous[i])) and np.isfinite(R[i]).all():
                before = i


def _widest_triple(positions: FloatArray, seen: BoolArray) -> IntArray:
    """Return the three seen LEDs that span the largest triangle."""
    index = np.flatnonzero(seen)
    p = positions[index]
    i, j, k = np.array([(a, b, c) for a in range(len(p)) for b in range(a) for c in range(b)]).T
    area = np.linalg.norm(np.cross(p[j] - p[i], p[k] - p[i]), axis=1)
    best = int(np.argmax(area))
    return np.asarray(index[[i[best], j[best], k[best]]], dtype=np.int64)
