"""How well a fitted ray model knows its rays: its parameters' covariance, at any pixel and depth."""

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import FloatArray
from bricktrack_host.calibration.rays.pixel_polynomials import as_points, in_chunks

CHI_95 = float(np.sqrt(5.991))
"""Half-axis of the 95 % ellipse of two normal numbers, in standard deviations."""


class UncertainRays(ABC):
    """A ray model with the covariance of its parameters.

    The covariance holds the dots' noise, the smooth misfit of the polynomials, and what the rig's tolerance
    leaves open (`calibration.rays.ray_fit`).
    """

    covariance: FloatArray
    plane_a_mm: float
    plane_b_mm: float

    @abstractmethod
    def point_derivatives(self, uv_px: FloatArray, z_mm: FloatArray) -> FloatArray:
        """Return d(x, y) / d parameters, shape (n, 2, p), of pixels, shape (n, 2), at depths, shape (n,).

        The parameters are those that `covariance` is of.
        """

    def point_covariance_mm2(self, uv_px: ArrayLike, z_mm: ArrayLike) -> FloatArray:
        """Return the covariance, shape (..., 2, 2), mm^2, of the points that pixels (..., 2) see on plane z.

        Parameters
        ----------
        uv_px : array_like, shape (..., 2), px
        z_mm : float, or array_like, shape (...), mm
        """
        uv, shape = as_points("uv_px", uv_px, 2)
        z = np.broadcast_to(np.asarray(z_mm, dtype=np.float64), shape).reshape(-1)
        covariance = np.empty((len(uv), 2, 2))
        for piece in in_chunks(len(uv)):
            rows = self.point_derivatives(uv[piece], z[piece])
            covariance[piece] = (rows @ self.covariance) @ np.swapaxes(rows, 1, 2)
        return covariance.reshape(*shape, 2, 2)

    def point_sd_mm(self, uv_px: ArrayLike, z_mm: ArrayLike) -> FloatArray:
        """Return the standard deviation, shape (...), mm, of points on plane z: of x or y, the greater."""
        covariance = self.point_covariance_mm2(uv_px, z_mm)
        return np.asarray(np.sqrt(np.maximum(covariance[..., 0, 0], covariance[..., 1, 1])))

    def ray_covariance_mm2(self, uv_px: ArrayLike) -> FloatArray:
        """Return the covariance, shape (..., 4, 4), mm^2, of rays: x, y at plane A, then x, y at plane B.

        The blocks off the diagonal are what both planes' points have in common.
        """
        uv, shape = as_points("uv_px", uv_px, 2)
        covariance = np.empty((len(uv), 4, 4))
        for piece in in_chunks(len(uv)):
            n = len(uv[piece])
            rows = np.concatenate(
                [
                    self.point_derivatives(uv[piece], np.full(n, z))
                    for z in (self.plane_a_mm, self.plane_b_mm)
                ],
                axis=1,
            )
            covariance[piece] = (rows @ self.covariance) @ np.swapaxes(rows, 1, 2)
        return covariance.reshape(*shape, 4, 4)
