"""PRSOI, the source paper's pose recovery: scaled orthography, iterated, on calibrated incident rays.

Each LED is known as the ray of its pixel, given by its hits on two planes z = a and z = b. As a first guess
all LEDs lie in one plane parallel to the image (scaled orthography), which makes the pose linear in the hits;
the depths that this pose gives the LEDs correct the hits, and so on. It needs no start and no projection
centre.

Two differences from the paper as printed. Its eq. 21 takes ``k = -(i x j)``; in right-handed frames it must
be ``k = i x j``, or the iteration converges to wrong poses without a sign. And its eqs 6 and 20 divide, LED
by LED and axis by axis, by the hits' distances from the origin LED's, which are zero for LEDs in line with
it: the "safe" form, the default, takes one ratio ``kappa`` for all LEDs and both axes. The "printed" form
stays for comparison with the literature.

Everything is vectorised over frames, each with its own set of seen LEDs.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, as_float_array
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import ShapeError
from bricktrack_host.compiled import compiled
from bricktrack_host.tracking.finite import all_finite
from bricktrack_host.tracking.hit_polynomials import expand_at, hit_polynomials

PrsoiForm = Literal["safe", "printed"]

_MIN_DEPTH_MM = 1.0  # LEDs flatter than this leave the third column of H undetermined
_TOLERANCE_MM = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class PrsoiPoses:
    """Poses of the iteration, one a frame.

    Attributes
    ----------
    R_camera_brick : ndarray, shape (n, 3, 3)
        NaN where there is no pose.
    t_camera_brick_mm : ndarray, shape (n, 3), mm
    converged : ndarray of bool, shape (n,)
        False: fewer than four LEDs, LEDs in one plane, or no convergence. A pose that converged may still be
        false where LEDs are hidden: verify it by its residuals.
    n_iterations : ndarray of int, shape (n,)
    """

    R_camera_brick: FloatArray
    t_camera_brick_mm: FloatArray
    converged: BoolArray
    n_iterations: IntArray


def prsoi_poses(
    points_a_mm: ArrayLike,
    points_b_mm: ArrayLike,
    led_positions_mm: ArrayLike,
    *,
    plane_a_mm: float,
    plane_b_mm: float,
    form: PrsoiForm = "safe",
    max_iterations: int = 200,
) -> PrsoiPoses:
    """Recover poses from the hits of the LEDs' rays on two planes.

    Parameters
    ----------
    points_a_mm, points_b_mm : array_like, shape (n_frames, n_leds, 2), mm, camera frame
        Hits on z = a and z = b; NaN where an LED was not seen.
    led_positions_mm : array_like, shape (n_leds, 3), mm, brick frame
    plane_a_mm, plane_b_mm : float, mm
    form : "safe" or "printed"
    max_iterations : int

    Returns
    -------
    PrsoiPoses

    Notes
    -----
    Paper eqs 6, 7, 15, 18-27 with ``k = i x j``. The reference is the first seen LED, m0 of the paper where
    it is seen; ``t`` is always that of the brick's origin. In the printed form ``m`` of eq. 20 is averaged
    over LEDs and axes.
    """
    if form not in ("safe", "printed"):
        raise ShapeError(f"PRSOI form is {form!r}; expected 'safe' or 'printed'")
    return _iterate(
        as_float_array("points_a_mm", points_a_mm, (None, None, 2)),
        as_float_array("points_b_mm", points_b_mm, (None, None, 2)),
        as_float_array("led_positions_mm", led_positions_mm, (None, 3)),
        a=plane_a_mm,
        b=plane_b_mm,
        printed=form == "printed",
        max_iterations=max_iterations,
        cross_sign=1.0,
    )


def prsoi_starts(
    uv_px: FloatArray, ray_model: RayModel, brick_model: BrickModel, form: PrsoiForm = "safe"
) -> tuple[FloatArray, FloatArray]:
    """Return the PRSOI poses, (n, 3, 3) and (n, 3), of centroids (n, n_leds, 2), NaN where unseen."""
    a, b = ray_model.plane_a_mm, ray_model.plane_b_mm
    hits = expand_at(hit_polynomials(ray_model), uv_px)[..., 0, :]
    on_a, on_b = hits[..., :2], hits[..., 2:]
    found = prsoi_poses(on_a, on_b, brick_model.led_positions_mm, plane_a_mm=a, plane_b_mm=b, form=form)
    return found.R_camera_brick, found.t_camera_brick_mm


def _iterate(
    A: FloatArray,
    B: FloatArray,
    P: FloatArray,
    *,
    a: float,
    b: float,
    printed: bool,
    max_iterations: int,
    cross_sign: float,
) -> PrsoiPoses:
    if A.shape != B.shape or A.shape[1] != P.shape[0]:
        raise ShapeError(f"hits have shapes {A.shape} and {B.shape} for {P.shape[0]} LEDs; expected the same")
    n = A.shape[0]
    seen = all_finite(A) & all_finite(B)
    R_all = np.full((n, 3, 3), np.nan)
    t_all = np.full((n, 3), np.nan)
    converged = np.zeros(n, dtype=bool)
    n_iterations = np.zeros(n, dtype=np.int64)

    reference = np.argmax(seen, axis=1)
    rows = np.arange(n)
    G = np.where(seen[..., None], P[None] - P[reference][:, None], 0.0)
    # G, and with it H, are the same for all frames that see the same LEDs.
    _, first, which = np.unique(
        seen @ (1 << np.arange(seen.shape[1])), return_index=True, return_inverse=True
    )
    depth_mm = np.linalg.svd(G[first], compute_uv=False)[..., -1]
    pseudo_inverses = np.linalg.pinv(G[first])
    active = rows[(seen.sum(axis=1) >= 4) & (depth_mm[which] >= _MIN_DEPTH_MM)]
    if active.size == 0:
        return PrsoiPoses(R_all, t_all, converged, n_iterations)
    G, seen, reference = G[active], seen[active], reference[active]
    A, B = A[active], B[active]
    here = np.arange(active.size)
    H = pseudo_inverses[which[active]]
    A0, B0 = A[here, reference], B[here, reference]
    used = seen.copy()
    used[here, reference] = False
    dA = np.where(used[..., None], A - A0[:, None], 0.0)
    dB = np.where(used[..., None], B - B0[:, None], 0.0)
    BA = np.where(used[..., None], B - A, 0.0)
    kappa_one = (dA * dB).sum(axis=(1, 2)) / (dA * dA).sum(axis=(1, 2))
    if printed:
        with np.errstate(divide="ignore", invalid="ignore"):
            kappa = dB / dA  # eq. 6: one ratio for each LED and axis
    else:
        kappa = np.broadcast_to(kappa_one[:, None, None], dA.shape)

    kappa = np.ascontiguousarray(np.broadcast_to(kappa, dA.shape))
    R, m, count, good = _solve_frames(
        G, H, dA, BA, kappa, used, a, b, printed, max_iterations, cross_sign, _TOLERANCE_MM
    )
    if good.any():
        along = ((m - a) / (b - a))[:, None]
        T = np.concatenate([A0 + (B0 - A0) * along, m[:, None]], axis=1)[good]  # eq. 27
        R_all[active[good]] = R[good]
        t_all[active[good]] = T - np.einsum("nij,nj->ni", R[good], P[reference[good]])
    converged[active[good]] = True
    n_iterations[active] = count
    return PrsoiPoses(R_all, t_all, converged, n_iterations)


@compiled
def _solve_frames(
    G: FloatArray,
    H: FloatArray,
    dA: FloatArray,
    BA: FloatArray,
    kappa: FloatArray,
    used: BoolArray,
    a: float,
    b: float,
    printed: bool,
    max_iterations: int,
    cross_sign: float,
    tolerance_mm: float,
) -> tuple[FloatArray, FloatArray, IntArray, BoolArray]:
    """Iterate frame by frame; return R, (n, 3, 3), m of the reference LED, rounds, and which converged."""
    n, n_leds = used.shape
    R_all, m_all = np.empty((n, 3, 3)), np.empty(n)
    count, good = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.bool_)
    eps, IJ, R = np.empty(n_leds), np.empty((2, 3)), np.empty((3, 3))
    for f in range(n):
        eps[:] = 0.0
        m, change = 0.0, np.inf
        while change > tolerance_mm and count[f] < max_iterations:
            IJ[:] = 0.0
            for k in range(n_leds):
                if used[f, k]:
                    for axis in range(2):
                        x = dA[f, k, axis]
                        if count[f]:
                            x += BA[f, k, axis] * eps[k] / ((b - m) + (m - a) * kappa[f, k, axis])
                        for c in range(3):
                            IJ[axis, c] += H[f, c, k] * x
            length_i = math.sqrt(IJ[0, 0] ** 2 + IJ[0, 1] ** 2 + IJ[0, 2] ** 2)
            length_j = math.sqrt(IJ[1, 0] ** 2 + IJ[1, 1] ** 2 + IJ[1, 2] ** 2)
            s = math.sqrt(length_i * length_j)
            for c in range(3):
                R[0, c], R[1, c] = IJ[0, c] / s, IJ[1, c] / s
            for c in range(3):
                p, q = (c + 1) % 3, (c + 2) % 3
                R[2, c] = cross_sign * (R[0, p] * R[1, q] - R[0, q] * R[1, p])
            total, n_used, change = 0.0, 0, 0.0
            for k in range(n_leds):
                if not used[f, k]:
                    continue
                for axis in range(2):  # eq. 20; the same for all LEDs and axes but in the printed form
                    if printed or n_used == 0:
                        total += ((b - a) / s - b + a * kappa[f, k, axis]) / (kappa[f, k, axis] - 1)
                        n_used += 1
                new = R[2, 0] * G[f, k, 0] + R[2, 1] * G[f, k, 1] + R[2, 2] * G[f, k, 2]
                change = max(change, abs(new - eps[k])) if math.isfinite(new) else np.nan
                eps[k] = new
            m = total / n_used
            count[f] += 1
            if not (math.isfinite(change) and math.isfinite(m)):
                break
        for c in range(3):  # k = i x j, whatever sign the iteration was asked to take
            R[2, c] *= cross_sign
        good[f] = change <= tolerance_mm and math.isfinite(m) and _nearest_rotation(R, R_all[f])
        m_all[f] = m
    return R_all, m_all, count, good


@compiled
def _nearest_rotation(M: FloatArray, out: FloatArray) -> bool:
    """Put the rotation nearest to a matrix of positive determinant into ``out``, by Newton's polar iteration.

    Each round takes half the sum of the matrix and its inverse's transpose, which is its cofactors over its
    determinant (Higham 1986). False where there is none.
    """
    R, new = M.copy(), np.empty((3, 3))
    for _ in range(30):
        for r in range(3):
            for c in range(3):
                r1, r2, c1, c2 = (r + 1) % 3, (r + 2) % 3, (c + 1) % 3, (c + 2) % 3
                new[r, c] = R[r1, c1] * R[r2, c2] - R[r1, c2] * R[r2, c1]
        det = R[0, 0] * new[0, 0] + R[0, 1] * new[0, 1] + R[0, 2] * new[0, 2]
        if not det > 0:
            return False
        change = 0.0
        for r in range(3):
            for c in range(3):
                x = 0.5 * (R[r, c] + new[r, c] / det)
                change = max(change, abs(x - R[r, c]))
                R[r, c] = x
        if change < 1e-15:
            break
    out[:] = R
    return True
