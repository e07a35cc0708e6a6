"""What the inverses of both ray models share: points cut into pieces, and the Jacobian of their pixels."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import FloatArray
from bricktrack_common.camera_model import Projection
from bricktrack_host.calibration.rays.pixel_polynomials import PixelScaling, as_points, in_chunks


def project_in_chunks(
    points_camera_mm: ArrayLike, project: Callable[[FloatArray], tuple[FloatArray, FloatArray]]
) -> Projection:
    """Return the pixels of points, shape (..., 3), mm, camera frame, with their Jacobian.

    ``project`` takes points of shape (n, 3) and returns their pixels (n, 2) and Jacobian (n, 2, 3), px/mm.
    """
    points, shape = as_points("points_camera_mm", points_camera_mm, 3)
    uv = np.empty((len(points), 2))
    J = np.empty((len(points), 2, 3))
    for piece in in_chunks(len(points)):
        uv[piece], J[piece] = project(points[piece])
    return Projection(uv.reshape(*shape, 2), J.reshape(*shape, 2, 3))


def pixel_jacobian(
    scaling: PixelScaling, M: FloatArray, slope: FloatArray, *, reach: FloatArray | float = 1.0
) -> FloatArray:
    """Return the derivative of pixels by points, shape (n, 2, 3), px/mm.

    Along a ray d(x, y) = slope dz, so that d st = M^-1 (d(x, y) - slope dz) / reach.

    Parameters
    ----------
    scaling : PixelScaling
    M : ndarray, shape (2, 2, n)
        ``M[i, j]`` = d x_i / d st_j, per ``reach``.
    slope : ndarray, shape (2, n)
        dx/dz, dy/dz of the ray through each point.
    reach : ndarray, shape (n,), or float, mm
        Distance along z by which ``M`` is multiplied, where it is of slopes rather than of positions.
    """
    half = scaling.half_px
    J = np.empty((M.shape[2], 2, 3))
    with np.errstate(invalid="ignore", divide="ignore"):
        determinant = (M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0]) * reach
        J[:, 0, 0], J[:, 0, 1] = half[0] * M[1, 1] / determinant, -half[0] * M[0, 1] / determinant
        J[:, 1, 0], J[:, 1, 1] = -half[1] * M[1, 0] / determinant, half[1] * M[0, 0] / determinant
        J[:, :, 2] = -(J[:, :, 0] * slope[0][:, None] + J[:, :, 1] * slope[1][:, None])
    return J
