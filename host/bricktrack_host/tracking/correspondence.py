"""Which blob is which LED, for any layout: by prediction, or from nothing.

* `assign_predicted`: the track says where the LEDs should be; the pattern may have moved as a whole.
* `search_correspondence`: poses from triples of blobs and LEDs (`p3p`), ranked by how many other LEDs fall
  on blobs.

`paper_rules` has the source paper's way for its own layout, `verification` what makes an answer believed.
"""

from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np
from scipy.optimize import linear_sum_assignment

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import TrackingError
from bricktrack_host.tracking.finite import all_finite
from bricktrack_host.tracking.p3p import ray_centre_mm, rays_of, solve_p3p
from bricktrack_host.tracking.segment import Blobs
from bricktrack_host.tracking.verification import (
    MIN_FACING,
    MIN_INLIERS,
    Correspondence,
    blob_pixels,
    identity_gate_px,
    no_correspondence,
    verified_correspondence,
    verify,
)

_MAX_SEARCH_BLOBS = 12
_RIVAL_EVIDENCE = 6.0  # twenty to one
_USUAL_SD_PX, _USUAL_WEIGHT = 0.3, 2.0  # of residuals, before any were seen; worth so many of them


def assign_predicted(
    blobs_px: FloatArray, predicted_px: FloatArray, *, gate_px: float, shift_limit_px: float
) -> IntArray:
    """Assign blobs to predicted LEDs, globally optimal, after a common displacement.

    Parameters
    ----------
    blobs_px : ndarray, shape (n_blobs, 2), px
    predicted_px : ndarray, shape (n_leds, 2), px
        NaN where an LED cannot be seen.
    gate_px : float
        Farthest that a blob may lie from its LED once the displacement is taken off.
    shift_limit_px : float
        Largest displacement that is tried.

    Returns
    -------
    blob_of_led : ndarray of int64, shape (n_leds,)
        -1 where none.

    Notes
    -----
    Between two frames a brick at 10 Hz turns back: the pattern lies up to 0.3 m/s times 67 ms = 20 mm from a
    constant-velocity prediction, more than the spacing of the LEDs, but keeps its form. Each pair of LED and
    blob proposes a displacement; the one under which most LEDs find a blob, and closest, is taken.
    """
    n_leds = len(predicted_px)
    none = np.full(n_leds, -1, dtype=np.int64)
    known = np.flatnonzero(all_finite(predicted_px))
    if known.size == 0 or len(blobs_px) == 0:
        return none
    apart = blobs_px[None] - predicted_px[known][:, None]  # (leds, blobs, 2)
    shifts = apart.reshape(-1, 2)
    shifts = shifts[np.hypot(shifts[:, 0], shifts[:, 1]) <= shift_limit_px]
    if len(shifts) == 0:
        return none
    left = np.linalg.norm(apart[None] - shifts[:, None, None], axis=-1)  # (shifts, leds, blobs)
    nearest = np.minimum(left.min(axis=2), gate_px)
    # A large displacement is believed only if it explains more: one gate's worth for each shift limit.
    cost = nearest.sum(axis=1) + gate_px * np.hypot(shifts[:, 0], shifts[:, 1]) / shift_limit_px
    best = shifts[int(np.argmin(cost))]
    for _ in range(2):
        distance = np.linalg.norm(apart - best, axis=-1)
        i, j = linear_sum_assignment(np.minimum(distance, 2 * gate_px))
        near = distance[i, j] < gate_px
        i, j = i[near], j[near]
        if i.size == 0:
            return none
        best = np.median(apart[i, j], axis=0)
    none[known[i]] = j
    return none


def search_correspondence(
    blobs: Blobs, ray_model: RayModel, brick_model: BrickModel, *, collar_mm: float | None
) -> Correspondence:
    """Identify the LEDs of any layout from nothing.

    Parameters
    ----------
    blobs : Blobs
        LEDs, false lights among them; of more than twelve, those of the likeliest shape and size are taken.
    ray_model : RayModel
    brick_model : BrickModel
    collar_mm : float or None
        See `led_profile`.

    Returns
    -------
    Correspondence
        Ambiguous where another assignment or pose explains as many LEDs about as well.

    Raises
    ------
    TrackingError
        If the layout has no triple of LEDs out of line.
    """
    n_leds = brick_model.n_leds
    blobs, original = _likeliest(blobs)
    if len(blobs) < MIN_INLIERS:
        return no_correspondence(n_leds, f"{len(blobs)} blobs; four are needed")
    geometry = _Geometry.of(blobs, ray_model, brick_model)
    R, t = _hypotheses(geometry, brick_model)
    hypotheses, R, t = _score(R, t, geometry, brick_model)
    if len(hypotheses) == 0:
        return no_correspondence(n_leds, "no pose brings four LEDs onto blobs")
    gate_px = identity_gate_px(geometry.radius_px)
    starts = (R, t + geometry.centre_mm)
    explained, poses = verify(
        blob_pixels(blobs, hypotheses), starts, ray_model, brick_model, collar_mm=collar_mm, gate_px=gate_px
    )
    kept = np.where(explained, hypotheses, -1)
    n_kept = (kept >= 0).sum(axis=1)
    if n_kept.max(initial=0) < MIN_INLIERS:
        return no_correspondence(n_leds, "no pose explains four LEDs within the gate")
    mode = ray_model.sensor_mode
    evidence = _evidence(poses.residual_px, kept >= 0, mode.width * mode.height)
    order = np.argsort(-evidence, kind="stable")
    best = int(order[0])
    for i in order[1:]:
        if not evidence[i] > evidence[best] - _RIVAL_EVIDENCE:
            break
        both = (kept[i] >= 0) & (kept[best] >= 0)
        turn = np.trace(poses.R_camera_brick[i].T @ poses.R_camera_brick[best])
        if (kept[i] != kept[best])[both].any() or turn < 1 + 2 * np.cos(np.radians(2.0)):
            return no_correspondence(n_leds, "two assignments fit equally well", ambiguous=True)
    answer = kept[best].copy()
    answer[answer >= 0] = original[answer[answer >= 0]]
    return verified_correspondence(answer, poses, best)


def _evidence(residual_px: FloatArray, kept: BoolArray, n_pixels: int) -> FloatArray:
    """Return twice the log likelihood ratio of assignments, shape (n,), to blobs that fell anywhere.

    A blob that is its LED lies within its residuals' scatter, which each assignment shows itself (a rolling
    shutter or an unfitted profile leaves several pixels); one that is not lies anywhere in the picture. So a
    sixth LED found at eight pixels does not outweigh that the five others then miss their blobs as well. Any
    three blobs can be fitted, so only what is beyond three LEDs is evidence.
    """
    n_leds = kept.sum(axis=1)
    squares = np.where(kept, np.nan_to_num(residual_px**2).sum(axis=-1), 0.0).sum(axis=1)
    freedom = np.maximum(2 * n_leds - 6, 0)
    variance = (squares + _USUAL_WEIGHT * _USUAL_SD_PX**2) / (freedom + _USUAL_WEIGHT)
    evidence = freedom * np.log(n_pixels / (2 * np.pi * variance)) - squares / variance
    return np.where(n_leds >= MIN_INLIERS, evidence, -np.inf)


def _likeliest(blobs: Blobs) -> tuple[Blobs, IntArray]:
    """Return the blobs most like LEDs, at most `_MAX_SEARCH_BLOBS`, and their indices."""
    index = np.arange(len(blobs))
    if len(blobs) <= _MAX_SEARCH_BLOBS:
        return blobs, index
    usual = np.median(blobs.area_px2[blobs.flags == 0]) if (blobs.flags == 0).any() else 1.0
    odd = (blobs.flags != 0) * 2.0 + np.abs(np.log(blobs.area_px2 / usual)) + 10 * np.abs(1 - blobs.fill)
    index = np.sort(np.argsort(odd, kind="stable")[:_MAX_SEARCH_BLOBS])
    return blobs.take(index), index


@dataclass(frozen=True, slots=True, eq=False)
class _Geometry:
    """Blobs as bearings from the rays' common point, with what their sizes say of their distance."""

    centre_mm: FloatArray
    bearings: FloatArray
    slopes: FloatArray
    px_per_slope: float
    radius_px: float
    distance_mm: FloatArray

    @staticmethod
    def of(blobs: Blobs, ray_model: RayModel, brick_model: BrickModel) -> "_Geometry":
        centre = ray_centre_mm(ray_model)
        points, _ = rays_of(ray_model, blobs.uv_px)
        d = points - centre
        bearings = d / np.linalg.norm(d, axis=1, keepdims=True)
        J = ray_model.project(points).J_px_per_mm[..., :2]
        det = np.abs(np.linalg.det(J))
        px_per_mm = np.sqrt(det)
        radius_mm = float(np.median(brick_model.led_radii_mm))
        # A dome shows between half and all of its disc.
        radius_px = np.sqrt(blobs.area_px2 / np.pi / 0.8)
        distance = np.linalg.norm(d, axis=1) * px_per_mm * radius_mm / np.maximum(radius_px, 1e-6)
        return _Geometry(
            centre_mm=centre,
            bearings=bearings,
            slopes=bearings[:, :2] / bearings[:, 2:],
            px_per_slope=float(np.median(px_per_mm * d[:, 2])),
            radius_px=float(np.median(radius_px)),
            distance_mm=np.where(blobs.flags == 0, distance, np.nan),
        )


def _hypotheses(geometry: _Geometry, brick_model: BrickModel) -> tuple[FloatArray, FloatArray]:
    """Return poses, from the rays' common point, of all triples of blobs and LEDs that sizes allow."""
    P = brick_model.led_positions_mm
    led = np.array(
        [
            q
            for c in combinations(range(len(P)), 3)
            if np.linalg.norm(np.cross(P[c[1]] - P[c[0]], P[c[2]] - P[c[0]]))
            > 0.05 * np.linalg.norm(P[c[1]] - P[c[0]]) * np.linalg.norm(P[c[2]] - P[c[0]])
            for q in permutations(c)
        ]
    )
    if len(led) == 0:
        raise TrackingError("layout: all LEDs stand in one line; a pose needs three that do not")
    blob = np.array(list(combinations(range(len(geometry.bearings)), 3)))
    gaps = np.linalg.norm(P[:, None] - P[None], axis=-1)
    f, z = geometry.bearings, geometry.distance_mm
    near = np.where(np.isfinite(z), 0.65 * z, 0.0)
    sine = np.linalg.norm(np.cross(f[:, None], f[None]), axis=-1)
    least = sine * np.maximum(near[:, None], near[None])  # two LEDs are at least this far apart
    far = np.where(np.isfinite(z), 1.55 * z, 1e9)
    chord = np.linalg.norm(f[:, None] - f[None], axis=-1)
    spread = np.maximum(far[:, None] - near[None], far[None] - near[:, None])
    most = np.hypot(chord * np.maximum(far[:, None], far[None]), spread)
    possible = np.ones((len(blob), len(led)), dtype=bool)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        gap = gaps[led[:, i], led[:, j]][None]
        pair = (blob[:, i], blob[:, j])
        possible &= (gap >= least[pair][:, None]) & (gap <= most[pair][:, None])
    ib, il = np.nonzero(possible)
    R, t, valid = solve_p3p(f[blob[ib]], P[led[il]])
    if np.isfinite(z).any():
        depth = np.einsum("nkij,nlj->nkli", R, P[led[il]])[..., 2] + t[..., None, 2]
        estimate = (z * f[:, 2])[blob[ib]][:, None]
        with np.errstate(invalid="ignore"):
            wrong = (depth < 0.65 * estimate) | (depth > 1.55 * estimate)
        valid &= ~wrong.any(axis=-1)
    axes = np.einsum("nkij,nlj->nkli", R, brick_model.led_axes[led[il]])
    facing = -(axes * f[blob[ib]][:, None]).sum(axis=-1)
    valid &= (facing > MIN_FACING).all(axis=-1)
    return R[valid], t[valid]


def _score(
    R: FloatArray, t: FloatArray, geometry: _Geometry, brick_model: BrickModel, *, keep: int = 80
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the hypotheses that bring most LEDs onto blobs, best first, at most ``keep``."""
    n_leds = brick_model.n_leds
    gate = 0.8 * geometry.radius_px / geometry.px_per_slope
    blob_of_led = np.empty((len(R), n_leds), dtype=np.int64)
    score = np.empty(len(R))
    for first in range(0, len(R), 4000):
        part = slice(first, first + 4000)
        X = np.einsum("nij,lj->nli", R[part], brick_model.led_positions_mm) + t[part][:, None]
        axes = np.einsum("nij,lj->nli", R[part], brick_model.led_axes)
        visible = (X[..., 2] > 1.0) & ((axes * X).sum(axis=-1) < 0)
        with np.errstate(all="ignore"):
            slopes = X[..., :2] / X[..., 2:]
            apart = np.linalg.norm(slopes[:, :, None] - geometry.slopes[None, None], axis=-1)
        apart = np.where(visible[..., None], apart, np.inf)
        blob = apart.argmin(axis=2)
        distance = apart.min(axis=2)
        # A blob serves the nearest LED alone.
        nearest_led = apart.argmin(axis=1)
        mine = np.take_along_axis(nearest_led, blob, axis=1) == np.arange(n_leds)
        hit = mine & (distance < gate)
        blob_of_led[part] = np.where(hit, blob, -1)
        score[part] = hit.sum(axis=1) - 0.5 * np.where(hit, distance / gate, 0.0).sum(axis=1) / n_leds
    order = np.argsort(-score, kind="stable")
    order = order[(blob_of_led[order] >= 0).sum(axis=1) >= MIN_INLIERS]
    order = order[score[order] > np.floor(score[order[0]]) - 1.6] if order.size else order
    seen: dict[bytes, int] = {}
    chosen: list[int] = []
    for i in order:
        key = blob_of_led[i].tobytes()
        if seen.get(key, 0) < 3:  # a few poses each: one may be the mirrored one
            seen[key] = seen.get(key, 0) + 1
            chosen.append(int(i))
        if len(chosen) >= keep:
            break
    return blob_of_led[chosen], R[chosen], t[chosen]
