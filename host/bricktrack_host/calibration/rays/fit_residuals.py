"""What a ray model's fit leaves on each plane, as the source paper's section 6.1 reports it."""

import msgspec
import numpy as np

from bricktrack_common.arrays import FloatArray


class PlaneResiduals(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Distances on one plane between the dots and where the fit sees them.

    Attributes
    ----------
    z_mm : float, mm
    n_dots : int
    mean_um, rms_um, max_um : float, um
        Of the distance, over the dots fitted.
    """

    z_mm: float
    n_dots: int
    mean_um: float
    rms_um: float
    max_um: float


def residuals_of(residual_mm: FloatArray, *, z_mm: float) -> PlaneResiduals:
    """Return the statistics of residuals, shape (n, 2), mm, on the plane z."""
    distance_um = 1e3 * np.hypot(residual_mm[:, 0], residual_mm[:, 1])
    return PlaneResiduals(
        z_mm=z_mm,
        n_dots=len(distance_um),
        mean_um=float(distance_um.mean()),
        rms_um=float(np.sqrt(np.mean(distance_um**2))),
        max_um=float(distance_um.max()),
    )
