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

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, as_float_array
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import ShapeError
from bricktrack_common.rotations import nearest_rotation
from bricktrack_host.tracking.finite import all_finite

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
    on_a, on_b = np.full_like(uv_px, np.nan), np.full_like(uv_px, np.nan)
    seen = all_finite(uv_px)
    on_a[seen] = ray_model.points_on_plane(uv_px[seen], a)
    on_b[seen] = ray_model.points_on_plane(uv_px[seen], b)
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
    depth_mm = np.linalg.svd(G, compute_uv=False)[..., -1]
    active = rows[(seen.sum(axis=1) >= 4) & (depth_mm >= _MIN_DEPTH_MM)]
    if active.size == 0:
        return PrsoiPoses(R_all, t_all, converged, n_iterations)
    G, seen, reference = G[active], seen[active], reference[active]
    A, B = A[active], B[active]
    here = np.arange(active.size)
    H = np.linalg.pinv(G)
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

    m = np.zeros(active.size)
    eps = np.zeros(used.shape)
    R = np.empty((active.size, 3, 3))
    done = np.zeros(active.size, dtype=bool)
    count = np.zeros(active.size, dtype=np.int64)
    with np.errstate(all="ignore"):
        for step in range(max_iterations):
            scale = (b - m[:, None, None]) + (m - a)[:, None, None] * kappa
            X = dA + np.where(used[..., None], BA * eps[..., None] / scale, 0.0) if step else dA
            IJ = H @ X  # (n, 3, 2): I and J as columns
            lengths = np.linalg.norm(IJ, axis=1)
            s = np.sqrt(lengths[:, 0] * lengths[:, 1])
            i, j = IJ[..., 0] / s[:, None], IJ[..., 1] / s[:, None]
            k = cross_sign * np.cross(i, j)
            per_led = ((b - a) / s[:, None, None] - b + a * kappa) / (kappa - 1)  # eq. 20
            if printed:
                m = np.where(used[..., None], per_led, 0.0).sum(axis=(1, 2)) / (2 * used.sum(axis=1))
            else:
                m = per_led[:, 0, 0]
            new_eps = np.einsum("nlc,nc->nl", G, k)
            change = np.abs(new_eps - eps).max(axis=1)
            eps = new_eps
            R[:, 0], R[:, 1], R[:, 2] = i, j, k
            count += ~done
            done |= change < _TOLERANCE_MM
            if (done | ~np.isfinite(change)).all():
                break
    good = done & all_finite(R, 2) & np.isfinite(m)
    if good.any():
        rotation = nearest_rotation(R[good])
        along = ((m - a) / (b - a))[:, None]
        T = np.concatenate([A0 + (B0 - A0) * along, m[:, None]], axis=1)[good]  # eq. 27
        R_all[active[good]] = rotation
        t_all[active[good]] = T - np.einsum("nij,nj->ni", rotation, P[reference[good]])
    converged[active[good]] = True
    n_iterations[active] = count
    return PrsoiPoses(R_all, t_all, converged, n_iterations)
