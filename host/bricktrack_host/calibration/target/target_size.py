"""How large a target must be to fill a camera's picture, and how its dots will look there."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.target.printed_target import DotTarget

FEWEST_COLUMNS_SEEN = 24
"""Across the picture at the near plane: enough for the polynomials that a lens needs."""
SPARE = 0.05
"""Share of the picture by which a target reaches beyond it: nobody sets a sheet up exactly."""
GOOD_DOT_PX = (10.0, 45.0)
"""Diameters that are measured best."""


@dataclass(frozen=True, slots=True)
class Field:
    """What a camera sees of a plane.

    Attributes
    ----------
    z_mm : float, mm
    width_mm, height_mm : float, mm
        Across the whole picture.
    px_per_mm : float
    """

    z_mm: float
    width_mm: float
    height_mm: float
    px_per_mm: float

    def dots_seen(self, target: DotTarget) -> tuple[int, int]:
        """Return how many columns and rows of a target, set up in the middle, are in view."""
        return (
            min(target.columns, int(self.width_mm / target.pitch_mm)),
            min(target.rows, int(self.height_mm / target.pitch_mm)),
        )

    def share_filled(self, target: DotTarget) -> float:
        """Return the share of the picture among the target's dots."""
        width = min((target.columns - 1) * target.pitch_mm / self.width_mm, 1.0)
        height = min((target.rows - 1) * target.pitch_mm / self.height_mm, 1.0)
        return width * height


def field_of_angles(fov_deg: tuple[float, float], *, z_mm: float, width_px: int) -> Field:
    """Return what a camera of these angles of view, across and down, sees of a plane square to it.

    Raises
    ------
    CalibrationError
        If an angle is not between 0 and 170 degrees, or the depth not over 0.

    Examples
    --------
    >>> field = field_of_angles((90.0, 60.0), z_mm=100.0, width_px=2000)
    >>> round(field.width_mm, 6), round(field.height_mm, 3), round(field.px_per_mm, 6)
    (200.0, 115.47, 10.0)
    """
    if not all(0 < a < 170 for a in fov_deg) or not z_mm > 0:
        raise CalibrationError(
            f"angles of view of {fov_deg[0]:g} x {fov_deg[1]:g} degrees at {z_mm:g} mm: expected angles "
            "between 0 and 170 and a positive depth"
        )
    width, height = (2 * z_mm * float(np.tan(np.deg2rad(a) / 2)) for a in fov_deg)
    return Field(z_mm, width, height, width_px / width)


def filling_target(
    near: Field,
    far: Field,
    *,
    pitch_mm: float | None = None,
    diameter_mm: float | None = None,
    polarity: Literal["white-on-black", "black-on-white"] = "white-on-black",
    coded: bool = True,
) -> DotTarget:
    """Return the target that fills the picture at both planes, so that its dots are as wide as their gaps.

    Parameters
    ----------
    near, far : Field
    pitch_mm : float, optional, mm
        Where not given, the widest in steps of half a millimetre that shows 24 columns at the near plane.
    diameter_mm : float, optional, mm
        Half the pitch where not given.
    polarity : "white-on-black" or "black-on-white", optional
    coded : bool, optional
    """
    if pitch_mm is None:
        pitch_mm = max(0.5, np.floor(2 * near.width_mm / FEWEST_COLUMNS_SEEN) / 2)
    # Even counts keep the middle of the target between dots at both planes.
    columns, rows = (
        2 * int(np.ceil((size * (1 + 2 * SPARE) / pitch_mm + 1) / 2))
        for size in (far.width_mm, far.height_mm)
    )
    return DotTarget(
        columns=columns,
        rows=rows,
        pitch_mm=float(pitch_mm),
        diameter_mm=float(diameter_mm or pitch_mm / 2),
        polarity=polarity,
        coded=coded,
    )
