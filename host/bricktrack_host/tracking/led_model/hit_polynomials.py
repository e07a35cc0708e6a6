"""Rays of any camera model in the one form that the compiled geometry takes: hits on two planes.

A ray is a straight line, so its hits on z = a and z = b, as functions of its pixel, say all there is to know
of a model. One polynomial over the whole picture tells whether the model is smooth; from it each cell of the
picture gets a cubic of its own, which is as exact there and ten times quicker. Near a pixel seen, hits with
their first and second derivatives describe its neighbourhood: where a point of space falls follows in closed
form, without inverting the model.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import polynomial

from bricktrack_common.arrays import FloatArray
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import TrackingError
from bricktrack_host.compiled import compiled, compiled_fast, compiled_in_place

_ORDERS = (5, 7, 9, 11, 13, 15, 17)
_REACH = 1.02  # scaled pixels: a centroid never lies farther outside than the rim of the last pixel
_EXACT_MM = 1e-6  # 1e-5 px
_GOOD_MM = 2e-5  # 3e-4 px
_CELLS_PX = (32.0, 16.0, 8.0)
_TERMS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))


@dataclass(frozen=True, slots=True, eq=False)
class HitPolynomials:
    """Hits of a camera's rays on two planes, cell by cell of the picture.

    Attributes
    ----------
    cells : ndarray, shape (rows, columns, 10, 4), mm
        Along the second last axis the coefficients of 1, d, e, d^2, d e, e^2, d^3, d^2 e, d e^2 and e^3,
        where d and e are how far, px, a pixel is right of and below the cell's middle; along the last x and y
        on plane a, x and y on plane b. The first cell begins at pixel (0, 0).
    cell_px : float, px
        The cells' edge.
    plane_a_mm, plane_b_mm : float, mm
    """

    cells: FloatArray
    cell_px: float
    plane_a_mm: float
    plane_b_mm: float


def hit_polynomials(ray_model: RayModel) -> HitPolynomials:
    """Return the hits of a ray model as polynomials; had once for each model.

    Raises
    ------
    TrackingError
        If no polynomial up to order 17 follows the model to 0.02 um over the picture, or no cubic follows
        that one within 8 px.
    """
    return _polynomials_of(_ByIdentity(ray_model))


class _ByIdentity:
    """A key for a cache: the same where the model is the same object."""

    def __init__(self, ray_model: RayModel) -> None:
        self.ray_model = ray_model

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByIdentity) and self.ray_model is other.ray_model

    def __hash__(self) -> int:
        return id(self.ray_model)


@lru_cache(maxsize=8)
def _polynomials_of(key: _ByIdentity) -> HitPolynomials:
    ray_model = key.ray_model
    mode = ray_model.sensor_mode
    half = np.array([(mode.width - 1) / 2, (mode.height - 1) / 2])
    # Chebyshev's points: a polynomial that is good there is good up to the border.
    s, t = (
        g.ravel() for g in np.meshgrid(*(_REACH * np.cos(np.pi * (np.arange(n) + 0.5) / n) for n in (26, 22)))
    )
    uv = np.stack([s, t], axis=1) * half + half
    a, b = ray_model.plane_a_mm, ray_model.plane_b_mm
    wanted = np.hstack([ray_model.points_on_plane(uv, a), ray_model.points_on_plane(uv, b)])
    if not np.isfinite(wanted).all():
        raise TrackingError("camera model: some pixels of the picture have no ray; calibrate it anew")
    worst = np.inf
    for order in _ORDERS:
        j, i = (k.ravel() for k in np.indices((order + 1, order + 1)))
        terms = np.flatnonzero(i + j <= order)
        design = s[:, None] ** i[terms] * t[:, None] ** j[terms]
        found = np.linalg.lstsq(design, wanted, rcond=None)[0]
        worst = float(np.abs(design @ found - wanted).max())
        if worst < _EXACT_MM:
            break
    if worst > _GOOD_MM:
        raise TrackingError(
            f"camera model: its rays bend by {worst:.2g} mm about a polynomial of order {order}; expected a "
            "smooth lens. Look at the calibration's residuals"
        )
    coefficients = np.zeros((4, (order + 1) ** 2))
    coefficients[:, terms] = found.T
    return _in_cells(coefficients.reshape(4, order + 1, order + 1), half, a, b)


def _in_cells(whole: FloatArray, half_px: FloatArray, a_mm: float, b_mm: float) -> HitPolynomials:
    """Return the cubics of the largest cells that follow a polynomial [c, j, i] of s^i t^j, scaled pixels."""
    for cell_px in _CELLS_PX:
        columns, rows = (math.ceil((2 * h + 1) / cell_px) for h in half_px)
        s = (np.arange(columns) + 0.5) * cell_px / half_px[0] - 1
        t = (np.arange(rows) + 0.5) * cell_px / half_px[1] - 1
        cells = np.empty((rows, columns, len(_TERMS), 4))
        for term, (i, j) in enumerate(_TERMS):
            by_s = polynomial.polyder(whole, i, axis=2)
            derivative = np.asarray(polynomial.polyder(by_s, j, axis=1), dtype=np.float64)
            scale = math.factorial(i) * math.factorial(j) * half_px[0] ** i * half_px[1] ** j
            cells[:, :, term] = _on_grid(derivative, s, t) / scale
        found = HitPolynomials(np.ascontiguousarray(cells), cell_px, a_mm, b_mm)
        # Corners are where a cubic about the middle is worst.
        corner_s, corner_t = s + 0.5 * cell_px / half_px[0], t + 0.5 * cell_px / half_px[1]
        inside_s, inside_t = corner_s <= 1, corner_t <= 1
        wanted = _on_grid(whole, corner_s[inside_s], corner_t[inside_t])
        u, v = np.meshgrid(
            (corner_s[inside_s] + 1) * half_px[0] - 1e-9, (corner_t[inside_t] + 1) * half_px[1] - 1e-9
        )
        worst = float(np.abs(hits_at(found, np.stack([u, v], axis=-1)) - wanted).max())
        if worst < _EXACT_MM:
            return found
    raise TrackingError(
        f"camera model: its rays bend by {worst:.2g} mm about a cubic within {cell_px:.0f} px; expected a "
        "smooth lens. Look at the calibration's residuals"
    )


def _on_grid(coefficients: FloatArray, s: FloatArray, t: FloatArray) -> FloatArray:
    """Return polynomials [c, j, i] of s^i t^j on a grid, shape (n_t, n_s, c)."""
    by_s = polynomial.polyvander(s, coefficients.shape[2] - 1)
    by_t = polynomial.polyvander(t, coefficients.shape[1] - 1)
    return np.asarray(np.einsum("tj,cji,si->tsc", by_t, coefficients, by_s, optimize=True))


def expand_at(polynomials: HitPolynomials, uv_px: FloatArray) -> FloatArray:
    """Return hits at pixels (..., 2) with their derivatives by the pixel, shape (..., 6, 4), mm, px.

    Along the second last axis: value, d/du, d/dv, d2/du2, d2/du dv, d2/dv2. Along the last: x and y on plane
    a, x and y on plane b. NaN where the pixel is.
    """
    uv = np.ascontiguousarray(uv_px.reshape(-1, 2))
    out = np.empty((len(uv), 6, 4))
    _expand_all(uv, polynomials.cells, polynomials.cell_px, out)
    return out.reshape(*uv_px.shape[:-1], 6, 4)


def hits_at(polynomials: HitPolynomials, uv_px: FloatArray) -> FloatArray:
    """Return hits at pixels (..., 2), shape (..., 4), mm: x and y on plane a, x and y on plane b."""
    uv = np.ascontiguousarray(uv_px.reshape(-1, 2))
    out = np.empty((len(uv), 4))
    _hits_all(uv, polynomials.cells, polynomials.cell_px, out)
    return out.reshape(*uv_px.shape[:-1], 4)


@compiled_in_place
def _cell_of(x_px: float, cell_px: float, n: int) -> int:
    """Return the cell of a pixel, one at the border for those outside and for NaN."""
    at = x_px / cell_px
    return int(at) if 0 <= at < n else n - 1 if at >= n else 0


@compiled
def _hits_all(uv: FloatArray, cells: FloatArray, cell_px: float, out: FloatArray) -> None:
    for k in range(len(uv)):
        column = _cell_of(uv[k, 0], cell_px, cells.shape[1])
        row = _cell_of(uv[k, 1], cell_px, cells.shape[0])
        d, e = uv[k, 0] - (column + 0.5) * cell_px, uv[k, 1] - (row + 0.5) * cell_px
        C = cells[row, column]
        for c in range(4):
            by_d = C[1, c] + d * (C[3, c] + d * C[6, c])
            by_e = C[2, c] + d * (C[4, c] + d * C[7, c])
            out[k, c] = C[0, c] + d * by_d + e * (by_e + e * (C[5, c] + d * C[8, c] + e * C[9, c]))


@compiled
def _expand_all(uv: FloatArray, cells: FloatArray, cell_px: float, out: FloatArray) -> None:
    for k in range(len(uv)):
        expand_pixel(uv[k, 0], uv[k, 1], cells, cell_px, out, k)


@compiled_fast
def expand_pixel(u: float, v: float, cells: FloatArray, cell_px: float, hits: FloatArray, k: int) -> None:
    """Fill in ``hits[k]``, (6, 4): hits at a pixel with their derivatives, see `expand_at`."""
    column, row = _cell_of(u, cell_px, cells.shape[1]), _cell_of(v, cell_px, cells.shape[0])
    d, e = u - (column + 0.5) * cell_px, v - (row + 0.5) * cell_px
    C, out = cells[row, column], hits[k]
    for c in range(4):
        c3, c4, c5, c6, c7, c8, c9 = C[3, c], C[4, c], C[5, c], C[6, c], C[7, c], C[8, c], C[9, c]
        by_d = C[1, c] + d * (c3 + d * c6)
        by_e = C[2, c] + d * (c4 + d * c7)
        out[0, c] = C[0, c] + d * by_d + e * (by_e + e * (c5 + d * c8 + e * c9))
        out[1, c] = C[1, c] + d * (2 * c3 + 3 * d * c6) + e * (c4 + 2 * d * c7 + e * c8)
        out[2, c] = by_e + e * (2 * (c5 + d * c8) + 3 * e * c9)
        out[3, c] = 2 * (c3 + 3 * d * c6 + e * c7)
        out[4, c] = c4 + 2 * (d * c7 + e * c8)
        out[5, c] = 2 * (c5 + d * c8 + 3 * e * c9)
