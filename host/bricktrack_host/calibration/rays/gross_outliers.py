"""Dots that contradict the others of their plane: smeared, dirty, or not of the grid."""

import numpy as np

from bricktrack_common.arrays import BoolArray
from bricktrack_common.camera_model import SensorMode
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dots.dot_observations import DotObservations
from bricktrack_host.calibration.dots.neighbours import median_spacing
from bricktrack_host.calibration.rays.pixel_polynomials import PixelScaling, least_squares, monomials, n_terms

OUTLIER_SIGMAS = 6.0
OUTLIER_STEPS = 0.01
"""No dot is gross that errs by less than this share of the pitch (40 um of 4 mm: a printer's error)."""
MAX_OUTLIER_SHARE = 0.05
"""Past this share the dots are not a few smears: the grid is misread or the board is bent."""


def gross_outliers(dots: DotObservations, *, sensor_mode: SensorMode, what: str) -> BoolArray:
    """Return which dots contradict the others of their plane: smeared, dirty, or not of the grid.

    A polynomial as flexible as the dots allow is fitted to the plane; residuals count by what each dot
    would show had it been left out.
    """
    order = max(q for q in (2, 3, 5, 7) if q == 2 or 4 * n_terms(q) <= len(dots))
    design = monomials(PixelScaling.of_mode(sensor_mode).scaled(dots.uv_px), order).T
    step_mm = median_spacing(dots.xy_mm)
    out = np.zeros(len(dots), dtype=np.bool_)
    for _ in range(10):
        c, inverse_normal = least_squares(design[~out], dots.xy_mm[~out], what=what)
        leverage = np.einsum("ni,ij,nj->n", design, inverse_normal, design, optimize=True)
        distance = np.hypot(*(design @ c - dots.xy_mm).T)
        distance = np.where(out, distance, distance / np.maximum(1 - leverage, 1e-3))
        # The distance of two equal normal errors has its median at 1.177 sigma.
        sigma = float(np.median(distance[~out])) / 1.1774
        now_out = distance > max(OUTLIER_SIGMAS * sigma, OUTLIER_STEPS * step_mm)
        if np.array_equal(now_out, out):
            break
        # The worst first: a single wrong dot at the rim bends the fit for its neighbours.
        worst = float(distance[~out].max())
        out = now_out & (out | (distance >= 0.5 * worst))
    n_out = int(np.count_nonzero(out))
    if n_out > max(2.0, MAX_OUTLIER_SHARE * len(dots)):
        raise CalibrationError(
            f"{what}: {n_out} of {len(dots)} dots lie more than {OUTLIER_SIGMAS:g} standard deviations off a "
            f"smooth map (order {order}); is the board flat and its grid read rightly?"
        )
    return out
