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
from bricktrack_host.compiled import compiled, compiled_fast
from bricktrack_host.tracking.led_model.hit_polynomials import hit_polynomials, hits_at
from bricktrack_host.tracking.pose.finite import all_finite

PrsoiForm = Literal["safe", "printed"]

_MIN_DEPTH_MM = 1.0  # LEDs flatter than this leave the third column of H undetermined
TOLERANCE_MM = 1e-7
ROUGH_MM = 0.01  # of depth; the form's own error is several times that at 0.05 px of noise
START_MM = 0.05  # a refinement ends at the same pose


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
    )


def prsoi_starts(
    uv_px: FloatArray,
    ray_model: RayModel,
    brick_model: BrickModel,
    form: PrsoiForm = "safe",
    *,
    tolerance_mm: float = TOLERANCE_MM,
) -> tuple[FloatArray, FloatArray]:
    """Return the PRSOI poses, (n, 3, 3) and (n, 3), of centroids (n, n_leds, 2), NaN where unseen.

    ``tolerance_mm`` is where the iteration ends; `ROUGH_MM` will do to judge a pose by its pixels,
    `START_MM` to refine it.
    """
    a, b = ray_model.plane_a_mm, ray_model.plane_b_mm
    hits = hits_at(hit_polynomials(ray_model), uv_px)
    on_a, on_b = hits[..., :2], hits[..., 2:]
    found = _iterate(
        on_a,
        on_b,
        brick_model.led_positions_mm,
        a=a,
        b=b,
        printed=form == "printed",
        max_iterations=200,
        tolerance_mm=tolerance_mm,
    )
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
    cross_sign: float = 1.0,
    tolerance_mm: float = TOLERANCE_MM,
) -> PrsoiPoses:
    if A.shape != B.shape or A.shape[1] != P.shape[0]:
        raise ShapeError(f"hits have shapes {A.shape} and {B.shape} for {P.shape[0]} LEDs; expected the same")
    n = A.shape[0]
    seen = all_finite(A) & all_finite(B)
    out = PrsoiPoses(
        R_camera_brick=np.full((n, 3, 3), np.nan),
        t_camera_brick_mm=np.full((n, 3), np.nan),
        converged=np.zeros(n, dtype=bool),
        n_iterations=np.zeros(n, dtype=np.int64),
    )
    # The LEDs' positions less the reference's, G, and its pseudo-inverse are the same for all frames that see
    # the same LEDs.
    _, first, which = np.unique(
        seen @ (1 << np.arange(seen.shape[1])), return_index=True, return_inverse=True
    )
    G = np.where(seen[first][..., None], P[None] - P[np.argmax(seen[first], axis=1)][:, None], 0.0)
    solvable = seen[first].sum(axis=1) >= 4
    solvable &= np.linalg.svd(G, compute_uv=False)[..., -1] >= _MIN_DEPTH_MM
    H = np.zeros((len(G), 3, len(P)))
    H[solvable] = np.linalg.pinv(G[solvable])
    _solve_frames(
        np.ascontiguousarray(A),
        np.ascontiguousarray(B),
        np.ascontiguousarray(P),
        seen,
        np.where(solvable[which], which, -1),
        G,
        H,
        a,
        b,
        printed,
        max_iterations,
        cross_sign,
        tolerance_mm,
        out.R_camera_brick,
        out.t_camera_brick_mm,
        out.converged,
        out.n_iterations,
    )
    return out


@compiled
def _solve_frames(
    A: FloatArray,
    B: FloatArray,
    P: FloatArray,
    seen: BoolArray,
    which: IntArray,
    G: FloatArray,
    H: FloatArray,
    a: float,
    b: float,
    printed: bool,
    max_iterations: int,
    cross_sign: float,
    tolerance_mm: float,
    R_all: FloatArray,
    t_all: FloatArray,
    converged: BoolArray,
    count: IntArray,
) -> None:
    """Iterate frame by frame; ``which`` is the frame's row of G and H, -1 for a frame without a pose."""
    n, n_leds = seen.shape
    R, new, rotation = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    # Of the LEDs that a frame sees beside its reference, without gaps:
    eps, dA, BA, kappas = (
        np.empty(n_leds),
        np.empty((n_leds, 2)),
        np.empty((n_leds, 2)),
        np.empty((n_leds, 2)),
    )
    Gs, Hs = np.empty((n_leds, 3)), np.empty((n_leds, 3))
    for f in range(n):
        w = which[f]
        if w < 0:
            continue
        reference = 0
        while not seen[f, reference]:
            reference += 1
        n_others, kappa = _differences(A, B, G, H, f, w, reference, seen, printed, dA, BA, Gs, Hs, kappas)
        eps[:] = 0.0
        m, change, rounds = 0.0, np.inf, 0
        while change > tolerance_mm and rounds < max_iterations:
            per_eps = 1 / ((b - m) + (m - a) * kappa) if rounds else 0.0
            i0, i1, i2, j0, j1, j2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(n_others):
                per_x, per_y = per_eps, per_eps
                if printed:
                    per_x = 1 / ((b - m) + (m - a) * kappas[k, 0]) if rounds else 0.0
                    per_y = 1 / ((b - m) + (m - a) * kappas[k, 1]) if rounds else 0.0
                x, y = dA[k, 0] + BA[k, 0] * eps[k] * per_x, dA[k, 1] + BA[k, 1] * eps[k] * per_y
                i0, i1, i2 = i0 + Hs[k, 0] * x, i1 + Hs[k, 1] * x, i2 + Hs[k, 2] * x
                j0, j1, j2 = j0 + Hs[k, 0] * y, j1 + Hs[k, 1] * y, j2 + Hs[k, 2] * y
            per_s = 1 / math.sqrt(math.sqrt((i0 * i0 + i1 * i1 + i2 * i2) * (j0 * j0 + j1 * j1 + j2 * j2)))
            i0, i1, i2, j0, j1, j2 = i0 * per_s, i1 * per_s, i2 * per_s, j0 * per_s, j1 * per_s, j2 * per_s
            k0, k1, k2 = i1 * j2 - i2 * j1, i2 * j0 - i0 * j2, i0 * j1 - i1 * j0
            change = 0.0
            for k in range(n_others):
                depth = cross_sign * (k0 * Gs[k, 0] + k1 * Gs[k, 1] + k2 * Gs[k, 2])
                change = max(change, abs(depth - eps[k]))
                eps[k] = depth
            m = ((b - a) * per_s - b + a * kappa) / (kappa - 1)
            if printed:  # eq. 20, over LEDs and axes
                m = 0.0
                for k in range(n_others):
                    for axis in range(2):
                        m += ((b - a) * per_s - b + a * kappas[k, axis]) / (kappas[k, axis] - 1)
                m /= 2 * n_others
            rounds += 1
            if not (math.isfinite(k0 + k1 + k2) and math.isfinite(m)):
                change = np.nan
                break
        R[0, 0], R[0, 1], R[0, 2] = i0, i1, i2
        R[1, 0], R[1, 1], R[1, 2] = j0, j1, j2
        R[2, 0], R[2, 1], R[2, 2] = k0, k1, k2  # i x j, whatever sign the iteration was asked to take
        count[f] = rounds
        if change <= tolerance_mm and math.isfinite(m) and _nearest_rotation(R, new, rotation):
            converged[f] = True
            along = (m - a) / (b - a)
            for r in range(3):  # eq. 27, and from the reference LED to the brick's origin
                t_all[f, r] = A[f, reference, r] * (1 - along) + B[f, reference, r] * along if r < 2 else m
                for c in range(3):
                    R_all[f, r, c] = rotation[r, c]
                    t_all[f, r] -= rotation[r, c] * P[reference, c]


@compiled_fast
def _differences(
    A: FloatArray,
    B: FloatArray,
    G: FloatArray,
    H: FloatArray,
    f: int,
    w: int,
    reference: int,
    seen: BoolArray,
    printed: bool,
    dA: FloatArray,
    BA: FloatArray,
    Gs: FloatArray,
    Hs: FloatArray,
    kappas: FloatArray,
) -> tuple[int, float]:
    """Fill in what the LEDs seen beside the reference bring to a frame; return their number and kappa.

    That is hits on plane a less the reference's, what it is from there to plane b, rows of G and H, and the
    ratio kappa of the hits' distances from the reference on the two planes; where ``printed``, also LED by
    LED and axis by axis.
    """
    both, own, n_others = 0.0, 0.0, 0
    for k in range(seen.shape[1]):
        if seen[f, k] and k != reference:
            for axis in range(2):
                dA[n_others, axis] = A[f, k, axis] - A[f, reference, axis]
                BA[n_others, axis] = B[f, k, axis] - A[f, k, axis]
                dB = B[f, k, axis] - B[f, reference, axis]
                if printed:
                    kappas[n_others, axis] = dB / dA[n_others, axis]  # eq. 6
                both, own = both + dA[n_others, axis] * dB, own + dA[n_others, axis] ** 2
            for c in range(3):
                Gs[n_others, c], Hs[n_others, c] = G[w, k, c], H[w, c, k]
            n_others += 1
    return n_others, both / own


@compiled_fast
def _nearest_rotation(M: FloatArray, new: FloatArray, R: FloatArray) -> bool:
    """Put the rotation nearest to a matrix of positive determinant into ``R``, by Newton's polar iteration.

    Each round takes half the sum of the matrix and its inverse's transpose, which is its cofactors over its
    determinant (Higham 1986). False where there is none.
    """
    for r in range(3):
        for c in range(3):
            R[r, c] = M[r, c]
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
        if change < 1e-8:  # the next would be its square
            break
    return True
