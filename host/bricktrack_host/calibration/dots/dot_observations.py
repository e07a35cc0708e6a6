"""The dots of one target picture with their places on the target: what the ray models are fitted to."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, rows_of
from bricktrack_common.errors import CalibrationError

MAX_TURN_BETWEEN_PLANES_DEG = 20.0
"""More is a different pose of the board, not the play of a rig."""


@dataclass(frozen=True, slots=True, eq=False)
class DotObservations:
    """Dots whose place on the target is known.

    Attributes
    ----------
    uv_px : ndarray, shape (n, 2), px, image frame
        Centroids of the dots' image areas, or images of their centres once corrected.
    xy_mm : ndarray, shape (n, 2), mm
        Place on the plane: x along the columns, y along the rows; camera axes (x along +u, y along +v) once
        `in_picture_axes` has turned a coded target's.
    cov_px2 : ndarray, shape (n, 2, 2), px^2
    area_px2 : ndarray, shape (n,), px^2
    column_row : ndarray of int64, shape (n, 2)
        Place in the grid, counted from the leftmost column and topmost row seen; on a coded target from its
        own first ones.
    size : float or ndarray, shape (n,)
        Diameters in units of the target's (small) dots'; 1 where all are alike.
    """

    uv_px: FloatArray
    xy_mm: FloatArray
    cov_px2: FloatArray
    area_px2: FloatArray
    column_row: IntArray
    size: float | FloatArray = 1.0

    def __len__(self) -> int:
        return len(self.uv_px)

    def select(self, keep: BoolArray) -> "DotObservations":
        """Return the dots where ``keep`` is true."""
        return rows_of(self, keep)

    def moved_to(self, uv_px: FloatArray) -> "DotObservations":
        """Return the same dots with other image points, shape (n, 2)."""
        return replace(self, uv_px=uv_px)


def board_turn_deg(dots: DotObservations) -> float:
    """Return by how much the target's x axis is turned from +u towards +v, degrees, from -180 to 180.

    Raises
    ------
    CalibrationError
        If the dots lie in one line.
    """
    xy = dots.xy_mm - dots.xy_mm.mean(axis=0)
    if np.linalg.matrix_rank(xy, tol=1e-6 * float(np.abs(xy).max())) < 2:
        raise CalibrationError(f"the {len(dots)} dots lie in one line; expected an area")
    A = np.linalg.lstsq(xy, dots.uv_px - dots.uv_px.mean(axis=0), rcond=None)[0].T
    return float(np.rad2deg(np.arctan2(A[1, 0] - A[0, 1], A[0, 0] + A[1, 1])))


def in_picture_axes(planes: Sequence[DotObservations]) -> tuple[DotObservations, ...]:
    """Turn the targets' axes of all planes by the same quarter turns, x to within 45 degrees of +u.

    What remains is the rig's: the board's edges, not the sensor's rows, define the camera's axes.

    Raises
    ------
    CalibrationError
        If the board was turned between the planes.
    """
    turns = np.deg2rad([board_turn_deg(p) for p in planes])
    mean = np.arctan2(np.sin(turns).sum(), np.cos(turns).sum())
    off = np.rad2deg(np.abs((turns - mean + np.pi) % (2 * np.pi) - np.pi))
    if off.max() > MAX_TURN_BETWEEN_PLANES_DEG:
        listed = ", ".join(f"{t:.1f}" for t in np.rad2deg(turns))
        raise CalibrationError(
            f"the target is turned by {listed} degrees in the pictures; expected the same turn in all: shift "
            "it along the axis only"
        )
    quarter = round(float(mean) / (np.pi / 2)) % 4
    R = np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), quarter)
    return tuple(replace(p, xy_mm=p.xy_mm @ R.T) for p in planes)
