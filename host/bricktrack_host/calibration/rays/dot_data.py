"""The dots of all planes side by side, with what a pixel is worth in mm at each: what a fit works on."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.camera_model import SensorMode
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dots.dot_observations import DotObservations
from bricktrack_host.calibration.rays.pixel_legendre import legendre_terms
from bricktrack_host.calibration.rays.pixel_polynomials import (
    PixelPolynomial,
    PixelScaling,
    least_squares,
    monomials,
    n_terms,
)

Planes = Sequence[tuple[float, DotObservations]]
"""Depth z, mm, and the dots seen there."""


@dataclass(frozen=True, slots=True, eq=False)
class DotData:
    """Dots of all planes in one row of arrays; n in all.

    Attributes
    ----------
    order : int
        Of the Legendre terms.
    V : ndarray, shape (n, n_terms)
        Legendre terms of the dots' pixels.
    plane : ndarray of int64, shape (n,)
        Plane of each dot, nearest first.
    z_mm : ndarray, shape (n_planes,), mm
        Nominal depths.
    xy_mm : ndarray, shape (n, 2), mm
        Nominal places.
    cov_px2 : ndarray, shape (n, 2, 2), px^2
    mm_per_px : ndarray, shape (n, 2, 2), mm/px
        Derivative of the place on the plane by the pixel.
    """

    order: int
    V: FloatArray
    plane: IntArray
    z_mm: FloatArray
    xy_mm: FloatArray
    cov_px2: FloatArray
    mm_per_px: FloatArray

    def counts(self) -> IntArray:
        """Return how many dots each plane has."""
        return np.bincount(self.plane, minlength=len(self.z_mm))

    def of_order(self, order: int) -> "DotData":
        """Return the same dots with terms of a lower order."""
        V = self.V[:, : n_terms(order)]
        return DotData(order, V, self.plane, self.z_mm, self.xy_mm, self.cov_px2, self.mm_per_px)


def gather(planes: Planes, *, sensor_mode: SensorMode, order: int) -> DotData:
    """Return the dots of two or more planes, nearest first, with Legendre terms of an order.

    Raises
    ------
    CalibrationError
        If the planes do not differ, a covariance is not positive, or a plane's dots allow no map of it.
    """
    depths = [z for z, _ in planes]
    if len(planes) < 2 or not 0 < min(depths) < max(depths):
        raise CalibrationError(f"planes at z = {depths} mm: expected two or more different depths over 0")
    planes = sorted(planes, key=lambda p: p[0])
    scaling = PixelScaling.of_mode(sensor_mode)
    uv = np.concatenate([dots.uv_px for _, dots in planes])
    cov = np.concatenate([dots.cov_px2 for _, dots in planes])
    # NaN compares false: it is refused too.
    if not np.all((cov[:, 0, 0] > 0) & (np.linalg.det(cov) > 0)):
        raise CalibrationError(
            "a dot's covariance is not positive definite: measure the dots again, or give every one the "
            "square of its standard deviation in pixels"
        )
    return DotData(
        order=order,
        V=legendre_terms(scaling.scaled(uv), order),
        plane=np.concatenate([np.full(len(dots), k) for k, (_, dots) in enumerate(planes)]),
        z_mm=np.array([z for z, _ in planes]),
        xy_mm=np.concatenate([dots.xy_mm for _, dots in planes]),
        cov_px2=cov,
        mm_per_px=np.concatenate([_mm_per_px(dots, scaling, z) for z, dots in planes]),
    )


def _mm_per_px(dots: DotObservations, scaling: PixelScaling, z_mm: float) -> FloatArray:
    """Return d(x, y) / d(u, v) at each dot, shape (n, 2, 2), from a smooth map of its plane alone."""
    order = max((q for q in (1, 2, 3, 5) if 2 * n_terms(q) <= len(dots)), default=1)
    st = scaling.scaled(dots.uv_px)
    c, _ = least_squares(monomials(st, order).T, dots.xy_mm, what=f"the plane at z = {z_mm:g} mm")
    values = PixelPolynomial(c.T, order).values_and_derivatives(st)  # (value, d/ds, d/dt), (x, y), n
    return np.stack([values[1 + k].T / scaling.half_px[k] for k in (0, 1)], axis=-1)


def central_start(data: DotData) -> tuple[FloatArray, FloatArray]:
    """Return slope coefficients, shape (2, n_terms), and the centre, shape (3,), mm, of nearly these rays.

    The depth z0 of the centre is scanned with affine slopes, then refined with slopes of order 5 at most.
    """
    order = max((q for q in (1, 3, 5) if q <= data.order and 2 * n_terms(q) < len(data.plane)), default=1)
    z = data.z_mm[data.plane]
    near = float(data.z_mm[0])

    def solve(z0: float, m: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        # Centroids err equally in pixels, hence on the planes as their distance.
        weight = 1 / (z - z0)[:, None]
        design = np.hstack([data.V[:, :m], weight])
        c, *_ = np.linalg.lstsq(design, weight * data.xy_mm, rcond=None)
        return np.asarray(c), design, np.asarray(weight * data.xy_mm - design @ c)

    scanned = np.linspace(-near, 0.9 * near, 39)
    z0 = float(min(scanned, key=lambda z0: float(np.sum(solve(float(z0), 3)[2] ** 2))))
    m = n_terms(order)
    for _ in range(20):
        c, design, left = solve(z0, m)
        across = -(data.V[:, :m] @ c[:m]) / (z - z0)[:, None]
        q, _ = np.linalg.qr(design)
        across -= q @ (q.T @ across)
        step = float(np.sum(across * left) / np.sum(across * across))
        if not -10 * data.z_mm[-1] < z0 + step < near:
            raise CalibrationError(
                f"the depth of the projection centre is not found (last {z0 + step:g} mm); the planes are "
                "too close together or their depths, pitch or origins do not belong together"
            )
        z0 += step
        if abs(step) < 1e-6 * near:
            break
    c, _, _ = solve(z0, m)
    slopes: FloatArray = np.zeros((2, data.V.shape[1]))
    slopes[:, :m] = c[:m].T
    return slopes, np.array([*c[m].tolist(), z0])
