"""The central ray model: all rays pass one point, and one polynomial of the pixel gives their slopes.

The pixel (u, v) sees the point ``(x, y) = (x0, y0) + (z - z0) P(u, v)`` of the plane z: z0 is the depth of
the projection centre, P the pair of slopes dx/dz, dy/dz. For a given z0 the fit is linear; z0 itself
is found by Gauss-Newton on what the linear part leaves. All planes serve one polynomial, so
dots seen at the near plane, where the board fills the picture, bound the rays at the far one too.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.camera_model import Projection, SensorMode
from bricktrack_common.errors import CalibrationError
from bricktrack_host.dot_observations import DotObservations
from bricktrack_host.fit_residuals import PlaneResiduals, residuals_of
from bricktrack_host.picture_region import ConvexRegion
from bricktrack_host.pixel_polynomials import (
    InverseStart,
    PixelPolynomial,
    PixelScaling,
    Which,
    as_points,
    in_chunks,
    least_squares,
    left_out_errors,
    monomials,
    n_terms,
    newton_inverse,
    picture_grid,
)

DEFAULT_ORDER = 7
MAX_WEIGHT_RATIO = 3.0
"""Planes are weighted by their own scatter, within this factor of each other."""


@dataclass(frozen=True, eq=False)
class CentralRays:
    """Rays through one point; a `bricktrack_common.camera_model.RayModel`.

    Attributes
    ----------
    sensor_mode : SensorMode
    plane_a_mm, plane_b_mm : float, mm
        Nearest and farthest depth of the dots, camera frame.
    order : int
    coefficients : ndarray, shape (2, n_terms)
        Of the slopes dx/dz and dy/dz, in the order of `pixel_polynomials.exponents`.
    centre_mm : ndarray, shape (3,), mm, camera frame
        The projection centre (x0, y0, z0).
    covariance : ndarray, shape (2 n_terms + 3, 2 n_terms + 3)
        Of [slope coefficients of x, x0, those of y, y0, z0], from the scatter of the dots about the fit.
    region : ConvexRegion
        Hull of the dots seen at any plane.
    residuals : tuple of PlaneResiduals
    """

    sensor_mode: SensorMode
    plane_a_mm: float
    plane_b_mm: float
    order: int
    coefficients: FloatArray
    centre_mm: FloatArray
    covariance: FloatArray
    region: ConvexRegion
    residuals: tuple[PlaneResiduals, ...]

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
        depth = np.asarray(z_mm, dtype=np.float64) - self.centre_mm[2]
        return np.asarray(self.centre_mm[:2] + depth[..., None] * self.slopes(uv_px))

    def project(self, points_camera_mm: ArrayLike) -> Projection:
        """Return the pixels of points, shape (..., 3), mm, camera frame, with their Jacobian.

        NaN behind the lens, farther outside the picture than `pixel_polynomials.PICTURE_MARGIN`, and
        where the inverse does not converge.
        """
        points, shape = as_points("points_camera_mm", points_camera_mm, 3)
        uv = np.empty((len(points), 2))
        J = np.empty((len(points), 2, 3))
        for piece in in_chunks(len(points)):
            uv[piece], J[piece] = self._project(points[piece])
        return Projection(uv.reshape(*shape, 2), J.reshape(*shape, 2, 3))

    def _project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        from_centre = (points - self.centre_mm).T
        depth = np.where(from_centre[2] > 0, from_centre[2], np.nan)
        target = from_centre[:2] / depth

        def evaluate(st: FloatArray, which: Which) -> tuple[FloatArray, FloatArray]:
            m = self._slopes.values_and_derivatives(st)
            return m[0] - target[:, which], np.swapaxes(m[1:], 0, 1)

        st, M = newton_inverse(self._start(target), evaluate)
        # slopes = (x - x0) / depth; d slopes = (dx - slope dz) / depth; d st = M^-1 d slopes
        half = self._scaling.half_px
        J = np.empty((len(points), 2, 3))
        with np.errstate(invalid="ignore", divide="ignore"):
            determinant = (M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0]) * depth
            J[:, 0, 0], J[:, 0, 1] = half[0] * M[1, 1] / determinant, -half[0] * M[0, 1] / determinant
            J[:, 1, 0], J[:, 1, 1] = -half[1] * M[1, 0] / determinant, half[1] * M[0, 0] / determinant
            J[:, :, 2] = -(J[:, :, 0] * target[0][:, None] + J[:, :, 1] * target[1][:, None])
        return self._scaling.pixels(st), J

    def is_covered(self, uv_px: ArrayLike) -> BoolArray:
        """Tell for pixels, shape (..., 2), whether dots of any plane surrounded them."""
        return self.region.contains(uv_px)

    def point_sd_mm(self, uv_px: ArrayLike, z_mm: float) -> FloatArray:
        """Return the standard deviation, shape (...), mm, of a point on plane z from the fit's noise.

        The greater of the x and the y direction's. It says nothing of what the order cannot follow; the
        cross-validated error does.
        """
        uv, shape = as_points("uv_px", uv_px, 2)
        V = monomials(self._scaling.scaled(uv), self.order)
        depth = z_mm - self.centre_mm[2]
        slopes = self.coefficients @ V
        m = len(V) + 1
        variance = np.empty((2, len(uv)))
        for axis in (0, 1):
            rows = np.vstack([depth * V, np.ones(len(uv)), -slopes[axis]])
            own = np.r_[np.arange(axis * m, (axis + 1) * m), 2 * m]
            variance[axis] = np.einsum(
                "kn,kl,ln->n", rows, self.covariance[np.ix_(own, own)], rows, optimize=True
            )
        return np.asarray(np.sqrt(variance.max(axis=0)).reshape(shape))


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """Coefficients (n_terms + 1, 2) with x0, y0 last, z0, and residuals (n, 2) in mm."""

    coefficients: FloatArray
    z0_mm: float
    residual_mm: FloatArray


class _Problem:
    """The dots of all planes, one below the other, and the solution for any choice of them."""

    def __init__(self, planes: Sequence[tuple[float, DotObservations]], mode: SensorMode, order: int) -> None:
        scaling = PixelScaling.of_mode(mode)
        self.order = order
        self.uv_px = np.concatenate([dots.uv_px for _, dots in planes])
        self.xy_mm = np.concatenate([dots.xy_mm for _, dots in planes])
        self.z_mm = np.concatenate([np.full(len(dots), z) for z, dots in planes])
        self.plane = np.concatenate([np.full(len(dots), k) for k, (_, dots) in enumerate(planes)])
        self.V = monomials(scaling.scaled(self.uv_px), order).T
        self.weight = np.ones(len(self.z_mm))

    def design(self, z0_mm: float) -> FloatArray:
        return np.hstack([(self.z_mm - z0_mm)[:, None] * self.V, np.ones((len(self.V), 1))])

    def start_mm(self) -> float:
        """Return z0 from the affine parts: dots at b stand (b - z0) / (a - z0) closer than at a."""
        V = self.V[:, :3]
        best, z0 = np.inf, 0.0
        nearest = float(self.z_mm.min())
        for candidate in np.linspace(-nearest, 0.9 * nearest, 39):
            D = np.hstack([(self.z_mm - candidate)[:, None] * V, np.ones((len(V), 1))])
            c, *_ = np.linalg.lstsq(D, self.xy_mm, rcond=None)
            left = float(np.sum((D @ c - self.xy_mm) ** 2))
            if left < best:
                best, z0 = left, float(candidate)
        return z0

    def solve(self, z0_mm: float, *, steps: int = 30) -> _Solution:
        """Fit from a first z0 (variable projection)."""
        what = f"central rays, order {self.order}"
        w = self.weight[:, None]
        wanted = w * self.xy_mm
        for _ in range(steps):
            q, r = np.linalg.qr(w * self.design(z0_mm))
            onto = q.T @ wanted
            residual = wanted - q @ onto
            by_z0 = -w * (self.V @ np.linalg.lstsq(r, onto, rcond=None)[0][:-1])
            by_z0 -= q @ (q.T @ by_z0)
            step = float(np.sum(by_z0 * residual) / np.sum(by_z0 * by_z0))
            z0_mm += step
            if not -10 * self.z_mm.max() < z0_mm < self.z_mm.min():
                break
            if abs(step) < 1e-9 * self.z_mm.max():
                design = self.design(z0_mm)
                c, _ = least_squares(w * design, wanted, what=what)
                return _Solution(c, z0_mm, design @ c - self.xy_mm)
        raise CalibrationError(
            f"{what}: the depth of the projection centre is not found (last {z0_mm:g} mm); the planes are "
            "too close together or their depths, pitch or origins do not belong together"
        )


def fit_central_rays(
    planes: Sequence[tuple[float, DotObservations]],
    *,
    sensor_mode: SensorMode,
    order: int = DEFAULT_ORDER,
) -> CentralRays:
    """Fit one slope polynomial and the projection centre to the dots of two or more planes.

    Parameters
    ----------
    planes : sequence of (float, DotObservations)
        Depth z, mm, and the dots seen there.
    sensor_mode : SensorMode
    order : int, optional

    Returns
    -------
    CentralRays

    Raises
    ------
    CalibrationError
        If the planes do not differ, the dots are too few for the order, or no projection centre is found.
    """
    problem, solution = _solve(planes, sensor_mode, order)
    depths = [z for z, _ in planes]
    return CentralRays(
        sensor_mode=sensor_mode,
        plane_a_mm=min(depths),
        plane_b_mm=max(depths),
        order=order,
        coefficients=solution.coefficients[:-1].T.copy(),
        centre_mm=np.array([*solution.coefficients[-1], solution.z0_mm]),
        covariance=_covariance(problem, solution),
        region=ConvexRegion.around(problem.uv_px),
        residuals=tuple(
            residuals_of(solution.residual_mm[problem.plane == k], z_mm=depths[k]) for k in range(len(planes))
        ),
    )


def _solve(
    planes: Sequence[tuple[float, DotObservations]], sensor_mode: SensorMode, order: int
) -> tuple[_Problem, _Solution]:
    """Fit twice: with equal weights, then each plane weighted by its own scatter."""
    depths = [z for z, _ in planes]
    if len(planes) < 2 or not 0 < min(depths) < max(depths):
        raise CalibrationError(f"planes at z = {depths} mm: expected two or more different depths over 0")
    problem = _Problem(planes, sensor_mode, order)
    solution = problem.solve(problem.start_mm())
    # Where a plane scatters more (board print, light, distance), its dots weigh less in the second pass.
    scatter = np.array(
        [np.sqrt(np.mean(solution.residual_mm[problem.plane == k] ** 2)) for k in range(len(planes))]
    )
    scatter = np.maximum(scatter, max(scatter.max() / MAX_WEIGHT_RATIO, 1e-12))
    problem.weight = (scatter.min() / scatter)[problem.plane]
    solution = problem.solve(solution.z0_mm)
    return problem, solution


def left_out_errors_mm(
    planes: Sequence[tuple[float, DotObservations]],
    folds: Sequence[IntArray],
    *,
    sensor_mode: SensorMode,
    order: int,
) -> list[FloatArray]:
    """Return, for each plane, the errors, shape (n, 2), mm, at dots left out of the fit fold by fold.

    The depth of the projection centre and the planes' weights, a few numbers that all dots share, are those
    of the fit to all.
    """
    problem, solution = _solve(planes, sensor_mode, order)
    w = problem.weight[:, None]
    errors = left_out_errors(
        w * problem.design(solution.z0_mm),
        w * problem.xy_mm,
        np.concatenate(list(folds)),
        what=f"central rays, order {order}",
    )
    return [(errors / w)[problem.plane == k] for k in range(len(planes))]


def _covariance(problem: _Problem, solution: _Solution) -> FloatArray:
    """Return the covariance of [x coefficients, x0, y coefficients, y0, z0]."""
    w = problem.weight[:, None]
    D = w * problem.design(solution.z0_mm)
    by_z0 = -w * (problem.V @ solution.coefficients[:-1])
    m = n_terms(problem.order) + 1
    along, inverse_normal = least_squares(D, by_z0, what="covariance of central rays")
    across = by_z0 - D @ along
    residual = w * solution.residual_mm
    freedom = max(2 * len(w) - 2 * m - 1, 1)
    variance = float(np.sum(residual**2)) / freedom
    covariance = np.zeros((2 * m + 1, 2 * m + 1))
    covariance[:m, :m] = covariance[m : 2 * m, m : 2 * m] = inverse_normal
    # Block inverse with the single column of z0: -along is how the others follow it.
    follow = np.concatenate([-along[:, 0], -along[:, 1], [1.0]])
    covariance += np.outer(follow, follow) / float(np.sum(across**2))
    return covariance * variance
