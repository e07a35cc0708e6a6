"""What a fit's residuals tell of the board: dots printed off their places, and a stretched print."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from bricktrack_common.arrays import FloatArray
from bricktrack_host.calibration.rays.central_rays import CentralRays
from bricktrack_host.calibration.rays.dot_data import Planes
from bricktrack_host.calibration.rays.irt import TwoPlaneIrt
from bricktrack_host.calibration.rays.pixel_polynomials import picture_grid

LEAST_COMMON_DOTS = 30
"""Fewer dots in common say nothing of the print."""
SEEN_SIGMAS = 4.0


@dataclass(frozen=True, slots=True)
class PrintError:
    """Misplacement of dots that stays with the board from plane to plane.

    Attributes
    ----------
    n_common : int
        Dots seen at both planes.
    sd_um : float, um
        In x and in y, of what the lens does not explain; 0 where none is seen.
    limit_um : float, um
        More than this would have been seen.
    """

    n_common: int
    sd_um: float
    limit_um: float


def print_error(planes: Planes, residual_mm: tuple[FloatArray, ...]) -> PrintError | None:
    """Return how far dots of the two outermost planes err alike, or None where too few are common.

    A dot printed off its place is off at every plane by the same millimetres, while the lens and the sensor
    show it elsewhere: the mean product of its residuals is the variance of the print. What is smooth over the
    board (stretch, bow) the rays have taken in, and does not show here.

    Parameters
    ----------
    planes : sequence of (float, DotObservations)
        Nearest first.
    residual_mm : tuple of ndarray, shape (n, 2), mm
        Of the same planes.
    """
    near, far = planes[0][1].xy_mm, planes[-1][1].xy_mm
    place = {(round(1e3 * x), round(1e3 * y)): k for k, (x, y) in enumerate(near.tolist())}
    pairs = [
        (place[key], k)
        for k, (x, y) in enumerate(far.tolist())
        if (key := (round(1e3 * x), round(1e3 * y))) in place
    ]
    if len(pairs) < LEAST_COMMON_DOTS:
        return None
    i, j = np.array(pairs).T
    products = (residual_mm[0][i] * residual_mm[-1][j]).reshape(-1)
    variance = float(products.mean())
    error = float(products.std() / np.sqrt(len(products)))
    seen = variance > SEEN_SIGMAS * error
    return PrintError(
        n_common=len(pairs),
        sd_um=1e3 * float(np.sqrt(variance)) if seen else 0.0,
        limit_um=1e3 * float(np.sqrt(SEEN_SIGMAS * error)),
    )


@dataclass(frozen=True, slots=True)
class PixelShape:
    """Shape of a pixel seen through a lens that is round: square pixels seen otherwise are a stretched print.

    Attributes
    ----------
    stretch : float
        Millimetres per pixel along x over those along y, less 1.
    shear_rad : float, rad
        Angle between the pixel's axes on the target, less a right angle.
    doubt : float
        Stretches and shears (in rad) below this say nothing: three times what the round lens leaves
        unexplained, as a share of half the picture's width.
    """

    stretch: float
    shear_rad: float
    doubt: float


def pixel_shape(model: CentralRays | TwoPlaneIrt) -> PixelShape:
    """Return the shape of pixels that makes the lens round, from the rays' points on the far plane.

    Distortion about a centre beside the picture's middle stretches pixels there too, so the lens is fitted
    with it: slopes radial to order 7 about a free centre, seen on a plane that may be stretched and sheared.
    """
    mode = model.sensor_mode
    uv = picture_grid(mode)
    uv = uv[model.is_covered(uv)]
    xy = model.points_on_plane(uv, model.plane_b_mm)
    middle, half = np.array([mode.width - 1, mode.height - 1]) / 2, mode.width / 2
    size_mm = float(np.ptp(xy[:, 0]) / np.ptp(uv[:, 0]) * half)

    def left(p: FloatArray) -> FloatArray:
        q = (uv - middle) / half - p[:2]
        r2 = np.sum(q * q, axis=1, keepdims=True)
        seen = q * (1 + p[2] * r2 + p[3] * r2**2 + p[4] * r2**3)
        # Symmetric: stretch and shear; antisymmetric: the board's turn in its plane.
        onto = p[5] * np.array([[1 + p[6], p[7] - p[8]], [p[7] + p[8], 1 - p[6]]])
        return np.asarray((seen @ onto.T + p[9:11] - xy / size_mm).reshape(-1))

    start = np.array([0, 0, 0, 0, 0, 1, 0, 0, 0, *(xy.mean(axis=0) / size_mm)])
    found = least_squares(left, start, method="lm")
    return PixelShape(
        stretch=float((1 + found.x[6]) / (1 - found.x[6]) - 1),
        shear_rad=float(-2 * found.x[7]),
        doubt=3 * float(np.sqrt(2 * np.mean(found.fun**2))),
    )
