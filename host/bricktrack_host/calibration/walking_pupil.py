"""Rays of a lens whose pupil walks along its axis: central rays with one number more.

The steeper a ray, the farther along the axis it crosses it:
``(x, y) = (x0, y0) + (z - z0 - w |P|^2) P(u, v)``, P the slopes, w the walk in mm at slope 1. With w = 0
these are `calibration.central_rays`. One polynomial still serves both planes, so the rays hold where the
far plane had no dots; free polynomials for each plane (`calibration.irt`) do not. The result is stored as
an ordinary `TwoPlaneIrt` of a somewhat higher order, into which ``|P|^2 P`` is expanded.
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.camera_model import SensorMode
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.central_rays import fit_central_rays
from bricktrack_host.calibration.dot_observations import DotObservations
from bricktrack_host.calibration.fit_residuals import residuals_of
from bricktrack_host.calibration.irt import TwoPlaneIrt
from bricktrack_host.calibration.picture_region import ConvexRegion
from bricktrack_host.calibration.pixel_polynomials import (
    PixelScaling,
    least_squares,
    left_out_errors,
    monomials,
    n_terms,
    picture_grid,
)

TwoPlanes = tuple[tuple[float, DotObservations], tuple[float, DotObservations]]

EXPANSION_ORDERS = 4
"""Orders added for ``|P|^2 P``, which P's own order does not hold."""
CONVERGED_MM = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """Unknowns [x coefficients, x0, y coefficients, y0, step of z0, w], and the last linear equations."""

    unknowns: FloatArray
    z0_mm: float
    design: FloatArray
    residual: FloatArray
    weight: FloatArray


def _solve(planes: TwoPlanes, mode: SensorMode, order: int) -> _Solution:
    """Fit by Gauss-Newton; linear but for products of z0 and w with the slopes."""
    what = f"walking pupil, order {order}"
    scaling = PixelScaling.of_mode(mode)
    central = fit_central_rays(planes, sensor_mode=mode, order=order)
    V = np.vstack([monomials(scaling.scaled(dots.uv_px), order).T for _, dots in planes])
    z_mm = np.concatenate([np.full(len(dots), z) for z, dots in planes])
    xy = np.concatenate([dots.xy_mm for _, dots in planes])
    m = V.shape[1]
    slopes, z0, walk = central.coefficients.T, float(central.centre_mm[2]), 0.0
    for _ in range(30):
        P = V @ slopes
        r2 = np.sum(P * P, axis=1)
        # Centroids err equally in pixels, hence on the planes as their distance.
        weight = 1.0 / (z_mm - z0)
        own = weight[:, None] * np.hstack([(z_mm - z0)[:, None] * V, np.ones((len(V), 1))])
        design = np.zeros((2 * len(V), 2 * m + 4))
        for axis in (0, 1):
            rows = slice(axis * len(V), (axis + 1) * len(V))
            design[rows, axis * (m + 1) : (axis + 1) * (m + 1)] = own
            design[rows, -2] = -weight * P[:, axis]
            design[rows, -1] = -weight * r2 * P[:, axis]
        wanted = (weight[:, None] * xy).T.reshape(-1, 1)
        c, _ = least_squares(design, wanted, what=what)
        step, walk_step = float(c[-2, 0]), float(c[-1, 0]) - walk
        slopes = np.stack([c[:m, 0], c[m + 1 : 2 * m + 1, 0]], axis=1)
        z0, walk = z0 + step, walk + walk_step
        if not -10 * z_mm.max() < z0 < z_mm.min():
            break
        if max(abs(step), abs(walk_step)) < CONVERGED_MM:
            return _Solution(c[:, 0], z0, design, (design @ c - wanted)[:, 0], weight)
    raise CalibrationError(
        f"{what}: does not converge (z0 = {z0:g} mm, w = {walk:g} mm); fit central rays instead"
    )


def fit_walking_pupil(
    plane_a: DotObservations,
    plane_b: DotObservations,
    *,
    a_mm: float,
    b_mm: float,
    sensor_mode: SensorMode,
    order: int,
) -> TwoPlaneIrt:
    """Fit rays whose crossing of the axis walks with the square of their slope.

    Parameters
    ----------
    plane_a, plane_b : DotObservations
    a_mm, b_mm : float, mm
        Depths of the planes; a < b.
    sensor_mode : SensorMode
    order : int
        Of the slopes; the stored planes have `EXPANSION_ORDERS` more.

    Raises
    ------
    CalibrationError
        If the dots are too few for the order, or the fit does not converge.
    """
    planes: TwoPlanes = ((a_mm, plane_a), (b_mm, plane_b))
    s = _solve(planes, sensor_mode, order)
    m, m_stored = n_terms(order), n_terms(order + EXPANSION_ORDERS)
    scaling = PixelScaling.of_mode(sensor_mode)

    # Expand the last two columns' functions, P and |P|^2 P, over the picture.
    grid = scaling.scaled(picture_grid(sensor_mode, 41, 25))
    V = monomials(grid, order + EXPANSION_ORDERS).T
    slopes = np.stack([s.unknowns[:m], s.unknowns[m + 1 : 2 * m + 1]], axis=1)
    P = V[:, :m] @ slopes
    cubes, _ = least_squares(V, np.sum(P * P, axis=1, keepdims=True) * P, what="expansion of the walk")

    def to_plane(z_mm: float) -> FloatArray:
        """Return what turns the unknowns into the plane's coefficients, x above y."""
        T = np.zeros((2 * m_stored, len(s.unknowns)))
        for axis in (0, 1):
            rows = slice(axis * m_stored, axis * m_stored + m)
            T[rows, axis * (m + 1) : axis * (m + 1) + m] = (z_mm - s.z0_mm) * np.eye(m)
            T[axis * m_stored, axis * (m + 1) + m] = 1.0
            T[rows, -2] = -slopes[:, axis]
            T[axis * m_stored : (axis + 1) * m_stored, -1] = -cubes[:, axis]
        return T

    _, inverse_normal = least_squares(s.design, s.residual[:, None], what=f"walking pupil, order {order}")
    freedom = max(len(s.residual) - len(s.unknowns), 1)
    covariance = inverse_normal * float(np.sum(s.residual**2)) / freedom
    coefficients, covariances, residuals = [], [], []
    for z_mm, dots in planes:
        T = to_plane(z_mm)
        own = (T @ s.unknowns).reshape(2, m_stored)
        both = T @ covariance @ T.T
        coefficients.append(own)
        # x and y differ only by what z0 and w do to them: their mean serves both.
        covariances.append((both[:m_stored, :m_stored] + both[m_stored:, m_stored:]) / 2)
        seen = monomials(scaling.scaled(dots.uv_px), order + EXPANSION_ORDERS).T @ own.T
        residuals.append(residuals_of(seen - dots.xy_mm, z_mm=z_mm))
    # Dots of either plane bound the one polynomial.
    region = ConvexRegion.around(np.concatenate([plane_a.uv_px, plane_b.uv_px]))
    return TwoPlaneIrt(
        sensor_mode=sensor_mode,
        plane_a_mm=a_mm,
        plane_b_mm=b_mm,
        order=order + EXPANSION_ORDERS,
        coefficients_a=coefficients[0],
        coefficients_b=coefficients[1],
        covariance_a=covariances[0],
        covariance_b=covariances[1],
        region_a=region,
        region_b=region,
        residuals=tuple(residuals),
    )


def left_out_errors_mm(
    planes: TwoPlanes, folds: tuple[IntArray, IntArray], *, sensor_mode: SensorMode, order: int
) -> list[FloatArray]:
    """Return, for each plane, the errors, shape (n, 2), mm, at dots left out of the fit fold by fold.

    Linearised about the fit to all.
    """
    s = _solve(planes, sensor_mode, order)
    basis, _ = np.linalg.qr(s.design)
    fold = np.concatenate([*folds, *folds])
    errors = left_out_errors(basis, s.residual[:, None], fold, what=f"walking pupil, order {order}")
    xy = errors.reshape(2, -1).T / s.weight[:, None]
    return np.split(xy, [len(folds[0])])
