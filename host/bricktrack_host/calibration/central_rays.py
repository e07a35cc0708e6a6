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
        from_centre = (points - self.centre_mm).T
        nearest = NEAREST_SHARE * (self.plane_a_mm - self.centre_mm[2])
        depth = np.where(from_centre[2] > nearest, from_centre[2], np.nan)
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
    """Coefficients (n_terms + 1, 2) with x0, y0 last, and z0."""

    coefficients: FloatArray
    z0_mm: float


class _Problem:
    """The dots of all planes, each plane's reduced once to as many equations as there are coefficients.

    With V = Q R the monomials at a plane's dots, the equations ``(z - z0) V c + x0 = x`` become
    ``(z - z0) R c + Q'1 x0 = Q'x`` whatever z0 and the plane's weight, and Q'1 is R's first column.
    """

    def __init__(self, planes: Sequence[tuple[float, DotObservations]], mode: SensorMode, order: int) -> None:
        scaling = PixelScaling.of_mode(mode)
        self.what = f"central rays, order {order}"
        self.z_mm = [z for z, _ in planes]
        self.xy_mm = [dots.xy_mm for _, dots in planes]
        self.V = [monomials(scaling.scaled(dots.uv_px), order).T for _, dots in planes]
        self.Q, self.R = zip(*(np.linalg.qr(V) for V in self.V), strict=True)
        self.weight = np.ones(len(planes))
        n, needed = sum(len(xy) for xy in self.xy_mm), n_terms(order) + 1
        if n < needed:
            raise CalibrationError(
                f"{self.what}: {n} dots for {needed} coefficients; take a lower order or more dots"
            )

    def design(self, z0_mm: float, n_coefficients: int | None = None) -> FloatArray:
        """Return the weighted, reduced equations' matrix."""
        return np.vstack(
            [
                w * np.hstack([(z - z0_mm) * R[:, :n_coefficients], R[:, :1]])
                for z, R, w in zip(self.z_mm, self.R, self.weight, strict=True)
            ]
        )

    def wanted(self) -> FloatArray:
        """Return the weighted, reduced equations' right side, for x and y."""
        return np.vstack([w * (Q.T @ xy) for Q, xy, w in zip(self.Q, self.xy_mm, self.weight, strict=True)])

    def by_z0(self, solution: _Solution) -> FloatArray:
        """Return the derivative of the weighted, reduced model by z0, for x and y."""
        c = solution.coefficients[:-1]
        return np.vstack([-w * (R @ c) for R, w in zip(self.R, self.weight, strict=True)])

    def residual_mm(self, solution: _Solution) -> list[FloatArray]:
        """Return fit less truth at the dots, (n, 2) for each plane."""
        c, xy0 = solution.coefficients[:-1], solution.coefficients[-1]
        return [
            (z - solution.z0_mm) * (V @ c) + xy0 - xy
            for z, V, xy in zip(self.z_mm, self.V, self.xy_mm, strict=True)
        ]

    def start_mm(self) -> float:
        """Return z0 from the affine parts: dots at b stand (b - z0) / (a - z0) closer than at a."""
        best, z0 = np.inf, 0.0
        wanted = self.wanted()
        for candidate in np.linspace(-min(self.z_mm), 0.9 * min(self.z_mm), 39):
            D = self.design(float(candidate), 3)
            c, *_ = np.linalg.lstsq(D, wanted, rcond=None)
            left = float(np.sum((D @ c - wanted) ** 2))
            if left < best:
                best, z0 = left, float(candidate)
        return z0

    def solve(self, z0_mm: float, *, steps: int = 30) -> _Solution:
        """Fit from a first z0 (variable projection)."""
        wanted = self.wanted()
        for _ in range(steps):
            D = self.design(z0_mm)
            c, _ = least_squares(D, wanted, what=self.what)
            q, _ = np.linalg.qr(D)
            across = self.by_z0(_Solution(c, z0_mm))
            across -= q @ (q.T @ across)
            step = float(np.sum(across * (wanted - D @ c)) / np.sum(across * across))
            z0_mm += step
            if not -10 * max(self.z_mm) < z0_mm < min(self.z_mm):
                break
            if abs(step) < 1e-9 * max(self.z_mm):
                c, _ = least_squares(self.design(z0_mm), wanted, what=self.what)
                return _Solution(c, z0_mm)
        raise CalibrationError(
            f"{self.what}: the depth of the projection centre is not found (last {z0_mm:g} mm); the planes "
            "are too close together or their depths, pitch or origins do not belong together"
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
        region=ConvexRegion.around(np.concatenate([dots.uv_px for _, dots in planes])),
        residuals=tuple(
            residuals_of(residual, z_mm=z)
            for residual, z in zip(problem.residual_mm(solution), depths, strict=True)
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
    scatter = np.array([np.sqrt(np.mean(r**2)) for r in problem.residual_mm(solution)])
    scatter = np.maximum(scatter, max(scatter.max() / MAX_WEIGHT_RATIO, 1e-12))
    problem.weight = scatter.min() / scatter
    return problem, problem.solve(solution.z0_mm)


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
    # An orthonormal basis of the full equations: each plane's Q times the reduced equations' one.
    small, _ = np.linalg.qr(problem.design(solution.z0_mm))
    ends = np.cumsum([len(R) for R in problem.R])[:-1]
    basis = np.vstack([Q @ part for Q, part in zip(problem.Q, np.split(small, ends), strict=True)])
    w = np.concatenate([np.full(len(xy), w) for xy, w in zip(problem.xy_mm, problem.weight, strict=True)])
    errors = left_out_errors(
        basis,
        w[:, None] * np.concatenate(problem.residual_mm(solution)),
        np.concatenate(list(folds)),
        what=problem.what,
    )
    ends = np.cumsum([len(xy) for xy in problem.xy_mm])[:-1]
    return np.split(errors / w[:, None], ends)


def _covariance(problem: _Problem, solution: _Solution) -> FloatArray:
    """Return the covariance of [x coefficients, x0, y coefficients, y0, z0]."""
    D = problem.design(solution.z0_mm)
    by_z0 = problem.by_z0(solution)
    m = D.shape[1]
    along, inverse_normal = least_squares(D, by_z0, what="covariance of central rays")
    across = by_z0 - D @ along
    residual = problem.residual_mm(solution)
    freedom = max(2 * sum(len(r) for r in residual) - 2 * m - 1, 1)
    variance = (
        sum(float(np.sum((w * r) ** 2)) for w, r in zip(problem.weight, residual, strict=True)) / freedom
    )
    covariance = np.zeros((2 * m + 1, 2 * m + 1))
    covariance[:m, :m] = covariance[m : 2 * m, m : 2 * m] = inverse_normal
    # Block inverse with the single column of z0: -along is how the others follow it.
    follow = np.concatenate([-along[:, 0], -along[:, 1], [1.0]])
    covariance += np.outer(follow, follow) / float(np.sum(across**2))
    return np.asarray(covariance * variance)
