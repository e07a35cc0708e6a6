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

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.camera_model import Projection, SensorMode
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dot_observations import DotObservations
from bricktrack_host.calibration.fit_residuals import PlaneResiduals, residuals_of
from bricktrack_host.calibration.picture_region import ConvexRegion
from bricktrack_host.calibration.pixel_polynomials import (
    NEAREST_SHARE,
    InverseStart,
    PixelPolynomial,
    PixelScaling,
    Which,
    as_points,
    in_chunks,
    least_squares,
    left_out_errors,
    monomials,
    newton_inverse,
    picture_grid,
)

PAPER_ORDER = 5


@dataclass(frozen=True, eq=False)
class TwoPlaneIrt:
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
    covariance_a, covariance_b : ndarray, shape (n_terms, n_terms), mm^2
        Of C, and equally of D, from the scatter of the dots about the fit.
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
    covariance_a: FloatArray
    covariance_b: FloatArray
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
        points, shape = as_points("points_camera_mm", points_camera_mm, 3)
        uv = np.empty((len(points), 2))
        J = np.empty((len(points), 2, 3))
        for piece in in_chunks(len(points)):
            uv[piece], J[piece] = self._project(points[piece])
        return Projection(uv.reshape(*shape, 2), J.reshape(*shape, 2, 3))

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
        # d st = M^-1 (d(x, y) - slope dz)
        slope = self._both.values(st)[2:]
        half = self._scaling.half_px
        J = np.empty((len(points), 2, 3))
        with np.errstate(invalid="ignore", divide="ignore"):
            determinant = M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0]
            J[:, 0, 0], J[:, 0, 1] = half[0] * M[1, 1] / determinant, -half[0] * M[0, 1] / determinant
            J[:, 1, 0], J[:, 1, 1] = -half[1] * M[1, 0] / determinant, half[1] * M[0, 0] / determinant
            J[:, :, 2] = -(J[:, :, 0] * slope[0][:, None] + J[:, :, 1] * slope[1][:, None])
        return self._scaling.pixels(st), J

    def is_covered(self, uv_px: ArrayLike) -> BoolArray:
        """Tell for pixels, shape (..., 2), whether dots surrounded them at both planes."""
        return self.region_a.contains(uv_px) & self.region_b.contains(uv_px)

    def point_sd_mm(self, uv_px: ArrayLike, z_mm: float) -> FloatArray:
        """Return the standard deviation, shape (...), mm, of x (and of y) on plane z from the fit's noise.

        It says nothing of what the order cannot follow; the cross-validated error does.
        """
        uv, shape = as_points("uv_px", uv_px, 2)
        V = monomials(self._scaling.scaled(uv), self.order)
        share_b = (z_mm - self.plane_a_mm) / (self.plane_b_mm - self.plane_a_mm)
        covariance = (1 - share_b) ** 2 * self.covariance_a + share_b**2 * self.covariance_b
        variance = np.einsum("kn,kl,ln->n", V, covariance, V, optimize=True)
        return np.asarray(np.sqrt(variance).reshape(shape))


def fit_two_plane_irt(
    plane_a: DotObservations,
    plane_b: DotObservations,
    *,
    a_mm: float,
    b_mm: float,
    sensor_mode: SensorMode,
    order: int = PAPER_ORDER,
) -> TwoPlaneIrt:
    """Fit the polynomials of both planes to the dots seen there.

    Parameters
    ----------
    plane_a, plane_b : DotObservations
    a_mm, b_mm : float, mm
        Depths of the planes; a < b.
    sensor_mode : SensorMode
    order : int, optional
        The paper's q.

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
    if not 0 < a_mm < b_mm:
        raise CalibrationError(f"planes at a = {a_mm:g} mm and b = {b_mm:g} mm: expected 0 < a < b")
    scaling = PixelScaling.of_mode(sensor_mode)
    coefficients, covariances, residuals = [], [], []
    for name, dots, z_mm in (("plane A", plane_a, a_mm), ("plane B", plane_b, b_mm)):
        design = monomials(scaling.scaled(dots.uv_px), order).T
        c, inverse_normal = least_squares(design, dots.xy_mm, what=f"{name}, order {order}")
        residual = design @ c - dots.xy_mm
        freedom = 2 * max(len(dots) - design.shape[1], 1)
        coefficients.append(c.T.copy())
        covariances.append(inverse_normal * float(np.sum(residual**2)) / freedom)
        residuals.append(residuals_of(residual, z_mm=z_mm))
    return TwoPlaneIrt(
        sensor_mode=sensor_mode,
        plane_a_mm=a_mm,
        plane_b_mm=b_mm,
        order=order,
        coefficients_a=coefficients[0],
        coefficients_b=coefficients[1],
        covariance_a=covariances[0],
        covariance_b=covariances[1],
        region_a=ConvexRegion.around(plane_a.uv_px),
        region_b=ConvexRegion.around(plane_b.uv_px),
        residuals=tuple(residuals),
    )


def left_out_errors_mm(
    dots: DotObservations, fold: IntArray, *, sensor_mode: SensorMode, order: int
) -> FloatArray:
    """Return the errors, shape (n, 2), mm, at the dots of one plane left out of its fit fold by fold."""
    design = monomials(PixelScaling.of_mode(sensor_mode).scaled(dots.uv_px), order).T
    basis, _ = np.linalg.qr(design)
    residual = basis @ (basis.T @ dots.xy_mm) - dots.xy_mm
    return left_out_errors(basis, residual, fold, what=f"two-plane, order {order}")
