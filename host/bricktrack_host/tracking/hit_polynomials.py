"""Rays of any camera model in the one form that the compiled geometry takes: hits on two planes.

A ray is a straight line, so its hits on z = a and z = b, as functions of its pixel, say all there is to know
of a model. They are put into polynomials of the scaled pixel; for models that are polynomials this is exact.
Near a pixel seen, hits with their first and second derivatives describe its neighbourhood: where a point of
space falls follows in closed form, without inverting the model.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import TrackingError
from bricktrack_host.compiled import compiled

_ORDERS = (5, 7, 9, 11, 13, 15, 17)
_REACH = 1.02  # scaled pixels: a centroid never lies farther outside than the rim of the last pixel
_EXACT_MM = 1e-6  # 1e-5 px
_GOOD_MM = 2e-5  # 3e-4 px


@dataclass(frozen=True, slots=True, eq=False)
class HitPolynomials:
    """Hits of a camera's rays on two planes.

    Attributes
    ----------
    coefficients : ndarray, shape (4, order + 1, order + 1), mm
        ``[c, j, i]`` belongs to s^i t^j; c is x and y on plane a, x and y on plane b.
    half_px : ndarray, shape (2,), px
        Middle of the picture, and half its extent: it spans -1 to 1 in s and t.
    plane_a_mm, plane_b_mm : float, mm
    """

    coefficients: FloatArray
    half_px: FloatArray
    plane_a_mm: float
    plane_b_mm: float


def hit_polynomials(ray_model: RayModel) -> HitPolynomials:
    """Return the hits of a ray model as polynomials; had once for each model.

    Raises
    ------
    TrackingError
        If no polynomial up to order 17 follows the model to 0.02 um over the picture.
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
    return HitPolynomials(
        coefficients=coefficients.reshape(4, order + 1, order + 1),
        half_px=half,
        plane_a_mm=a,
        plane_b_mm=b,
    )


def expand_at(polynomials: HitPolynomials, uv_px: FloatArray) -> FloatArray:
    """Return hits at pixels (..., 2) with their derivatives by the pixel, shape (..., 6, 4), mm, px.

    Along the second last axis: value, d/du, d/dv, d2/du2, d2/du dv, d2/dv2. Along the last: x and y on plane
    a, x and y on plane b. NaN where the pixel is.
    """
    p = polynomials
    st = np.ascontiguousarray(uv_px.reshape(-1, 2) / p.half_px - 1.0)
    out = np.empty((len(st), 6, 4))
    _expand(st, p.coefficients, p.half_px, out)
    return out.reshape(*uv_px.shape[:-1], 6, 4)


def hits_at(polynomials: HitPolynomials, uv_px: FloatArray) -> FloatArray:
    """Return hits at pixels (..., 2), shape (..., 4), mm: x and y on plane a, x and y on plane b."""
    p = polynomials
    st = np.ascontiguousarray(uv_px.reshape(-1, 2) / p.half_px - 1.0)
    out = np.empty((len(st), 4))
    _evaluate(st, p.coefficients, out)
    return out.reshape(*uv_px.shape[:-1], 4)


@compiled
def _evaluate(st: FloatArray, coefficients: FloatArray, out: FloatArray) -> None:
    """Horner's scheme in s inside Horner's scheme in t, by blocks, whose points run innermost."""
    order, block = coefficients.shape[1] - 1, 16
    s, t, q, f = np.zeros(block), np.zeros(block), np.empty(block), np.empty(block)
    for first in range(0, len(st), block):
        m = min(block, len(st) - first)
        for p in range(m):
            s[p], t[p] = st[first + p, 0], st[first + p, 1]
        for c in range(4):
            f[:] = 0.0
            for j in range(order, -1, -1):
                q[:] = 0.0
                for i in range(order - j, -1, -1):
                    k = coefficients[c, j, i]
                    for p in range(block):
                        q[p] = q[p] * s[p] + k
                for p in range(block):
                    f[p] = f[p] * t[p] + q[p]
            for p in range(m):
                out[first + p, c] = f[p]


@compiled
def _expand(st: FloatArray, coefficients: FloatArray, half: FloatArray, out: FloatArray) -> None:
    """Horner's scheme in s inside Horner's scheme in t, each with two derivatives (halved), by blocks.

    The points of a block run along the innermost loops, which fill whole vector registers.
    """
    order, block = coefficients.shape[1] - 1, 16
    s, t = np.zeros(block), np.zeros(block)
    q, qs, qss = np.empty(block), np.empty(block), np.empty(block)
    f = np.empty((6, block))  # value, s, t, ss / 2, st, tt / 2
    for first in range(0, len(st), block):
        m = min(block, len(st) - first)
        for p in range(m):
            s[p], t[p] = st[first + p, 0], st[first + p, 1]
        for c in range(4):
            f[:] = 0.0
            for j in range(order, -1, -1):
                q[:], qs[:], qss[:] = 0.0, 0.0, 0.0
                for i in range(order - j, -1, -1):
                    k = coefficients[c, j, i]
                    for p in range(block):
                        qss[p] = qss[p] * s[p] + qs[p]
                        qs[p] = qs[p] * s[p] + q[p]
                        q[p] = q[p] * s[p] + k
                for p in range(block):
                    f[5, p] = f[5, p] * t[p] + f[2, p]
                    f[2, p] = f[2, p] * t[p] + f[0, p]
                    f[0, p] = f[0, p] * t[p] + q[p]
                    f[4, p] = f[4, p] * t[p] + f[1, p]
                    f[1, p] = f[1, p] * t[p] + qs[p]
                    f[3, p] = f[3, p] * t[p] + qss[p]
            for p in range(m):
                o = out[first + p]
                o[0, c] = f[0, p]
                o[1, c], o[2, c] = f[1, p] / half[0], f[2, p] / half[1]
                o[3, c], o[5, c] = 2 * f[3, p] / half[0] ** 2, 2 * f[5, p] / half[1] ** 2
                o[4, c] = f[4, p] / (half[0] * half[1])
