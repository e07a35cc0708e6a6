"""The central ray model: all rays pass one point, and one polynomial of the pixel gives their slopes.

The pixel (u, v) sees the point ``(x, y) = (x0, y0) + (z - z0 - w |P|^2) P(u, v)`` of the plane z: z0 is the
depth of the projection centre, P the pair of slopes dx/dz, dy/dz, and w, mostly 0, how far the pupil walks
along the axis for a ray of slope 1. All planes serve one polynomial, so dots seen at the near plane, where
the board fills the picture, bound the rays at the far one too.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.camera_model import Projection, SensorMode
from bricktrack_host.calibration.dots.picture_region import ConvexRegion
from bricktrack_host.calibration.rays.dot_data import Planes, gather
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
from bricktrack_host.calibration.rays.ray_families import CentralFamily
from bricktrack_host.calibration.rays.ray_fit import RayFit, fit_rays, terms_needed
from bricktrack_host.calibration.rays.ray_projection import pixel_jacobian, project_in_chunks
from bricktrack_host.calibration.rays.ray_uncertainty import UncertainRays
from bricktrack_host.calibration.rays.rig_tolerance import RigTolerance


@dataclass(frozen=True, eq=False)
class CentralRays(UncertainRays):
    """Rays through one point, or nearly so; a `bricktrack_common.camera_model.RayModel`.

    Attributes
    ----------
    sensor_mode : SensorMode
    plane_a_mm, plane_b_mm : float, mm
        Nearest and farthest depth of the dots, camera frame.
    order : int
    coefficients : ndarray, shape (2, n_terms)
        Of the slopes dx/dz and dy/dz, in the order of `pixel_polynomials.exponents`.
    centre_mm : ndarray, shape (3,), mm, camera frame
        The projection centre (x0, y0, z0) of rays near the axis.
    covariance_order : int
        Highest degree that the covariance speaks of: ``order`` or, with misfit, more.
    covariance : ndarray, shape (2 m + 3, 2 m + 3), m terms up to ``covariance_order``
        Of [slope x, x0, slope y, y0, z0], the slopes as coefficients of Legendre products
        (`calibration.rays.pixel_legendre`); with a walking pupil one more row and column, of w.
    region : ConvexRegion
        Hull of the dots seen at any plane.
    residuals : tuple of PlaneResiduals
    walk_mm : float, mm
        The walk w.
    """

    sensor_mode: SensorMode
    plane_a_mm: float
    plane_b_mm: float
    order: int
    coefficients: FloatArray
    centre_mm: FloatArray
    covariance_order: int
    covariance: FloatArray
    region: ConvexRegion
    residuals: tuple[PlaneResiduals, ...]
    walk_mm: float = 0.0

    @cached_property
    def _scaling(self) -> PixelScaling:
        return PixelScaling.of_mode(self.sensor_mode)

    @cached_property
    def _slopes(self) -> PixelPolynomial:
        return PixelPolynomial(self.coefficients, self.order)

    @cached_property
    def _start(self) -> InverseStart:
        st = self._scaling.scaled(picture_grid(self.sensor_mode))
        return InverseStart(self._slopes.values(st), st)

    @property
    def walks(self) -> bool:
        """Whether the pupil was let to walk: its covariance has a row for it."""
        return len(self.covariance) == 2 * n_terms(self.covariance_order) + 4

    def slopes(self, uv_px: ArrayLike) -> FloatArray:
        """Return the slopes dx/dz, dy/dz, shape (..., 2), of the rays of pixels, shape (..., 2)."""
        uv, shape = as_points("uv_px", uv_px, 2)
        slopes = np.empty((len(uv), 2))
        for piece in in_chunks(len(uv)):
            slopes[piece] = self._slopes.values(self._scaling.scaled(uv[piece])).T
        return slopes.reshape(*shape, 2)

    def points_on_plane(self, uv_px: ArrayLike, z_mm: ArrayLike) -> FloatArray:
        """Return the points (x, y), shape (..., 2), mm, camera frame, that pixels see on the plane z.

        Parameters
        ----------
        uv_px : array_like, shape (..., 2), px
        z_mm : float, or array_like, shape (...), mm
        """
        P = self.slopes(uv_px)
        reach = np.asarray(z_mm, dtype=np.float64) - self.centre_mm[2]
        if self.walk_mm:
            reach = reach - self.walk_mm * np.sum(P * P, axis=-1)
        return np.asarray(self.centre_mm[:2] + reach[..., None] * P)

    def project(self, points_camera_mm: ArrayLike) -> Projection:
        """Return the pixels of points, shape (..., 3), mm, camera frame, with their Jacobian.

        NaN behind or in the lens, farther outside the picture than `pixel_polynomials.PICTURE_MARGIN`, and
        where the inverse does not converge.
        """
        return project_in_chunks(points_camera_mm, self._project)

    def _project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        from_centre = (points - self.centre_mm).T
        nearest = NEAREST_SHARE * (self.plane_a_mm - self.centre_mm[2])
        depth = np.where(from_centre[2] > nearest, from_centre[2], np.nan)
        target = from_centre[:2] / depth
        walk = self.walk_mm / depth

        def evaluate(st: FloatArray, which: Which) -> tuple[FloatArray, FloatArray]:
            m = self._slopes.values_and_derivatives(st)
            P, by = m[0], np.swapaxes(m[1:], 0, 1)  # by[i, j] = d P_i / d st_j
            if self.walk_mm:
                w = walk[which]
                left = 1 - w * np.sum(P * P, axis=0)
                by = left * by - 2 * w * P[:, None] * np.sum(P[:, None] * by, axis=0)
                P = left * P
            return P - target[:, which], by

        st, M = newton_inverse(self._start(target), evaluate)
        slope = self._slopes.values(st) if self.walk_mm else target
        return self._scaling.pixels(st), pixel_jacobian(self._scaling, M, slope, reach=depth)

    def is_covered(self, uv_px: ArrayLike) -> BoolArray:
        """Tell for pixels, shape (..., 2), whether dots of any plane surrounded them."""
        return self.region.contains(uv_px)

    def point_derivatives(self, uv_px: FloatArray, z_mm: FloatArray) -> FloatArray:
        """Return d(x, y) / d parameters, shape (n, 2, p), see `UncertainRays`."""
        st = self._scaling.scaled(uv_px)
        V = legendre_terms(st, self.covariance_order)
        return (
            CentralFamily(self.walks)
            .points_of(self._slopes.values(st).T, V, z_mm, centre_mm=self.centre_mm, walk_mm=self.walk_mm)
            .D
        )


def fit_central_rays(
    planes: Planes,
    *,
    sensor_mode: SensorMode,
    order: int | None = None,
    walks: bool = False,
    tolerance: RigTolerance | None = None,
) -> CentralRays:
    """Fit one slope polynomial and the projection centre to the dots of two or more planes.

    Parameters
    ----------
    planes : sequence of (float, DotObservations)
        Depth z, mm, and the dots seen there.
    sensor_mode : SensorMode
    order : int, optional
        By default coefficients of high degree are held as the data say.
    walks : bool, optional
        Let the pupil walk along the axis.
    tolerance : RigTolerance, optional
        How well the planes are known; exactly by default.

    Returns
    -------
    CentralRays

    Raises
    ------
    CalibrationError
        If the planes do not differ, the dots are too few for the order, or no projection centre is found.
    """
    fewest = min((len(dots) for _, dots in planes), default=0)
    data = gather(planes, sensor_mode=sensor_mode, order=terms_needed(order, fewest))
    fit = fit_rays(data, CentralFamily(walks), order=order, tolerance=tolerance)
    return central_rays_of(fit, planes, sensor_mode=sensor_mode)


def central_rays_of(fit: RayFit, planes: Planes, *, sensor_mode: SensorMode) -> CentralRays:
    """Return the rays of a fit of `ray_families.CentralFamily` to planes."""
    depths = sorted(z for z, _ in planes)
    m, m_used = n_terms(fit.covariance_order), n_terms(fit.order)
    walks = isinstance(fit.family, CentralFamily) and fit.family.walks
    p = fit.parameters
    slopes = np.stack([p[:m_used], p[m + 1 : m + 1 + m_used]])
    return CentralRays(
        sensor_mode=sensor_mode,
        plane_a_mm=depths[0],
        plane_b_mm=depths[-1],
        order=fit.order,
        coefficients=slopes @ monomials_of_legendre(fit.order).T,
        centre_mm=p[[m, 2 * m + 1, 2 * m + 2]],
        covariance_order=fit.covariance_order,
        covariance=fit.covariance,
        region=ConvexRegion.around(np.concatenate([dots.uv_px for _, dots in planes])),
        residuals=tuple(residuals_of(r, z_mm=z) for r, z in zip(fit.residual_mm, depths, strict=True)),
        walk_mm=float(p[-1]) if walks else 0.0,
    )
