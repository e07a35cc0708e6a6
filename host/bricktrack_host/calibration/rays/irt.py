"""Incident-ray tracking (IRT): one polynomial of the pixel for each of two planes gives every pixel's ray.

The pixel (u, v) sees the point x = sum C_rs u^r v^s, y = sum D_rs u^r v^s, r + s <= q, of plane z = a, and
another such point of plane z = b (source paper, eqs 2 and 3; q = 5 gives 21 coefficients). The line through
both is the ray. Rays need not meet in a point, so the model serves lenses without a projection centre; but
each plane is known only where it had dots, and beyond them a polynomial is no guide.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.camera_model import Projection, SensorMode
from bricktrack_host.calibration.dots.picture_region import ConvexRegion
from bricktrack_host.calibration.rays.dot_data import Planes, central_start, gather
from bricktrack_host.calibration.rays.fit_residuals import PlaneResiduals, residuals_of
from bricktrack_host.calibration.rays.pixel_legendre import legendre_terms, monomials_of_legendre
from bricktrack_host.calibration.rays.pixel_polynomials import (
    NEAREST_SHARE,
    InverseStart,
    PixelPolynomial,
    PixelScaling,
    Which,
    as_points,
    in_chunks,
    n_terms,
    newton_inverse,
    picture_grid,
)
from bricktrack_host.calibration.rays.ray_families import TwoPlaneFamily, two_plane_rows
from bricktrack_host.calibration.rays.ray_fit import RayFit, fit_rays, terms_needed
from bricktrack_host.calibration.rays.ray_projection import pixel_jacobian, project_in_chunks
from bricktrack_host.calibration.rays.ray_uncertainty import UncertainRays
from bricktrack_host.calibration.rays.rig_tolerance import RigTolerance

PAPER_ORDER = 5


@dataclass(frozen=True, eq=False)
class TwoPlaneIrt(UncertainRays):
    """Rays through two polynomial planes; a `bricktrack_common.camera_model.RayModel`.

    Attributes
    ----------
    sensor_mode : SensorMode
    plane_a_mm, plane_b_mm : float, mm
        Depths z = a and z = b, camera frame.
    order : int
        The paper's q.
    coefficients_a, coefficients_b : ndarray, shape (2, n_terms), mm
        C (for x) and D (for y) of the scaled pixel, in the order of `pixel_polynomials.exponents`.
    covariance_order : int
        Highest degree that the covariance speaks of: ``order`` or, with misfit, more.
    covariance : ndarray, shape (4 m, 4 m), mm^2, m terms up to ``covariance_order``
        Of [C at A, C at B, D at A, D at B] as coefficients of Legendre products
        (`calibration.rays.pixel_legendre`): what the planes have in common is in the blocks off the diagonal.
    region_a, region_b : ConvexRegion
        Hull of the dots seen at either plane.
    residuals : tuple of PlaneResiduals
    """

    sensor_mode: SensorMode
    plane_a_mm: float
    plane_b_mm: float
    order: int
    coefficients_a: FloatArray
    coefficients_b: FloatArray
    covariance_order: int
    covariance: FloatArray
    region_a: ConvexRegion
    region_b: ConvexRegion
    residuals: tuple[PlaneResiduals, ...]

    @cached_property
    def _scaling(self) -> PixelScaling:
        return PixelScaling.of_mode(self.sensor_mode)

    @cached_property
    def _both(self) -> PixelPolynomial:
        """At the middle plane, and the slope: (x, y) = first two rows + (z - middle) * last two."""
        middle = (self.coefficients_a + self.coefficients_b) / 2
        slope = (self.coefficients_b - self.coefficients_a) / (self.plane_b_mm - self.plane_a_mm)
        return PixelPolynomial(np.vstack([middle, slope]), self.order)

    @property
    def _middle_mm(self) -> float:
        return (self.plane_a_mm + self.plane_b_mm) / 2

    @cached_property
    def _centre_mm(self) -> FloatArray:
        """The point, shape (3,), nearest to all rays of the picture: start of the inverse mapping only."""
        m = self._both.values(self._scaling.scaled(picture_grid(self.sensor_mode)))
        d_point, d_slope = (x - x.mean(axis=1, keepdims=True) for x in (m[:2], m[2:]))
        back = -float(np.sum(d_point * d_slope) / np.sum(d_slope * d_slope))
        xy = (m[:2] + back * m[2:]).mean(axis=1)
        return np.array([xy[0], xy[1], self._middle_mm + back])

    @cached_property
    def _start(self) -> InverseStart:
        st = self._scaling.scaled(picture_grid(self.sensor_mode))
        m = self._both.values(st)
        centre = self._centre_mm
        slopes = (m[:2] - centre[:2, None]) / (self._middle_mm - centre[2])
        return InverseStart(slopes, st)

    def points_on_plane(self, uv_px: ArrayLike, z_mm: ArrayLike) -> FloatArray:
        """Return the points (x, y), shape (..., 2), mm, camera frame, that pixels see on the plane z.

        Parameters
        ----------
        uv_px : array_like, shape (..., 2), px
        z_mm : float, or array_like, shape (...), mm
        """
        uv, shape = as_points("uv_px", uv_px, 2)
        depth = np.broadcast_to(np.asarray(z_mm, dtype=np.float64), shape).reshape(-1) - self._middle_mm
        xy = np.empty((len(uv), 2))
        for piece in in_chunks(len(uv)):
            m = self._both.values(self._scaling.scaled(uv[piece]))
            xy[piece] = (m[:2] + depth[piece] * m[2:]).T
        return xy.reshape(*shape, 2)

    def project(self, points_camera_mm: ArrayLike) -> Projection:
        """Return the pixels of points, shape (..., 3), mm, camera frame, with their Jacobian.

        NaN behind or in the lens, farther outside the picture than `pixel_polynomials.PICTURE_MARGIN`, and
        where the inverse does not converge.
        """
        return project_in_chunks(points_camera_mm, self._project)

    def _project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        x, y, z = points.T
        target = np.stack([x, y])
        depth = z - self._middle_mm
        centre = self._centre_mm
        before = z - centre[2]
        before = np.where(before > NEAREST_SHARE * (self.plane_a_mm - centre[2]), before, np.nan)

        def evaluate(st: FloatArray, which: Which) -> tuple[FloatArray, FloatArray]:
            m = self._both.values_and_derivatives(st)
            along = m[:, :2] + depth[which] * m[:, 2:]  # (value, d/ds, d/dt), (x, y), n
            return along[0] - target[:, which], np.swapaxes(along[1:], 0, 1)

        st, M = newton_inverse(self._start((target - centre[:2, None]) / before), evaluate)
        slope = self._both.values(st)[2:]
        return self._scaling.pixels(st), pixel_jacobian(self._scaling, M, slope)

    def is_covered(self, uv_px: ArrayLike) -> BoolArray:
        """Tell for pixels, shape (..., 2), whether dots surrounded them at both planes."""
        return self.region_a.contains(uv_px) & self.region_b.contains(uv_px)

    def point_derivatives(self, uv_px: FloatArray, z_mm: FloatArray) -> FloatArray:
        """Return d(x, y) / d parameters, shape (n, 2, p), see `UncertainRays`."""
        V = legendre_terms(self._scaling.scaled(uv_px), self.covariance_order)
        return two_plane_rows(V, z_mm, a_mm=self.plane_a_mm, b_mm=self.plane_b_mm)


def fit_two_plane_irt(
    planes: Planes,
    *,
    sensor_mode: SensorMode,
    order: int | None = PAPER_ORDER,
    tolerance: RigTolerance | None = None,
) -> TwoPlaneIrt:
    """Fit the polynomials of the nearest and the farthest plane to the dots of two or more.

    Parameters
    ----------
    planes : sequence of (float, DotObservations)
        Depth z, mm, and the dots seen there. Dots of planes between bear on both polynomials.
    sensor_mode : SensorMode
    order : int or None, optional
        The paper's q; None holds coefficients of high degree as the data say.
    tolerance : RigTolerance, optional
        How well the planes are known; exactly by default.

    Returns
    -------
    TwoPlaneIrt

    Raises
    ------
    CalibrationError
        If the planes do not differ, the dots are too few for the order or lie on too few lines.

    Notes
    -----
    Source paper, eqs 2 and 3.
    """
    fewest = min((len(dots) for _, dots in planes), default=0)
    data = gather(planes, sensor_mode=sensor_mode, order=terms_needed(order, fewest))
    family = TwoPlaneFamily(float(central_start(data)[1][2]))
    fit = fit_rays(data, family, order=order, tolerance=tolerance)
    return two_plane_irt_of(fit, planes, sensor_mode=sensor_mode)


def two_plane_irt_of(fit: RayFit, planes: Planes, *, sensor_mode: SensorMode) -> TwoPlaneIrt:
    """Return the rays of a fit of `ray_families.TwoPlaneFamily` to planes."""
    if not isinstance(fit.family, TwoPlaneFamily):
        raise TypeError(f"a fit of {fit.family.name}; expected one of two planes")
    planes = sorted(planes, key=lambda p: p[0])
    (a_mm, dots_a), (b_mm, dots_b) = planes[0], planes[-1]
    T = fit.family.on_planes(fit.covariance_order, a_mm, b_mm)
    used = n_terms(fit.order)
    x_a, x_b, y_a, y_b = (T @ fit.parameters).reshape(4, -1)[:, :used]
    to_monomials = monomials_of_legendre(fit.order).T
    return TwoPlaneIrt(
        sensor_mode=sensor_mode,
        plane_a_mm=a_mm,
        plane_b_mm=b_mm,
        order=fit.order,
        coefficients_a=np.stack([x_a, y_a]) @ to_monomials,
        coefficients_b=np.stack([x_b, y_b]) @ to_monomials,
        covariance_order=fit.covariance_order,
        covariance=T @ fit.covariance @ T.T,
        region_a=ConvexRegion.around(dots_a.uv_px),
        region_b=ConvexRegion.around(dots_b.uv_px),
        residuals=tuple(residuals_of(r, z_mm=z) for r, (z, _) in zip(fit.residual_mm, planes, strict=True)),
    )
