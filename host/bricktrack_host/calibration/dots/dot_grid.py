"""Give each dot of a target picture its column and row, and from an origin its place in millimetres.

The grid is grown (see `.grid_growth`); what remains is where on the target it lies.
A coded target tells that itself, a plain one by an origin that is nominated, or by being in view whole.
Whatever leaves a doubt is refused: a grid off by one column fits as well.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dots.dot_detection import Dots
from bricktrack_host.calibration.dots.dot_observations import DotObservations
from bricktrack_host.calibration.dots.dot_sizes import area_ratios, size_classes
from bricktrack_host.calibration.dots.grid_code import find_code
from bricktrack_host.calibration.dots.grid_growth import MIN_DOTS, grid_coordinates, grow_grid
from bricktrack_host.calibration.target.printed_target import LARGE_RATIO, DotTarget

MAX_TURN_DEG = 44.5
"""Beyond this turn of a plain board, rows and columns cannot be told apart."""
MAX_OFF_LATTICE_STEPS = 0.4
"""A given origin farther than this from the nearest candidate is as good as at the next one."""
MIN_SHARE_PLACED = 0.6


@dataclass(frozen=True, slots=True)
class GridOrigin:
    """Where x = y = 0 lies on the target.

    Attributes
    ----------
    near_px : (float, float), px
        A pixel close to it.
    at : "centre" or "dot"
        "centre": the target's centre: a dot where the count is odd, midway between two where it is even, on
        either axis. "dot": the dot nearest to the pixel, whatever its place on the target.
    """

    near_px: tuple[float, float]
    at: Literal["centre", "dot"] = "centre"


def assign_grid(
    dots: Dots, *, pitch_mm: float, columns: int, rows: int, origin: GridOrigin | None = None
) -> DotObservations:
    """Place the dots of a plain grid on the target.

    Parameters
    ----------
    dots : Dots
        Cut ones are left out unless their centre was completed.
    pitch_mm : float, mm
        Distance of neighbouring dots.
    columns, rows : int
        Size of the whole target, of which the picture may show a part.
    origin : GridOrigin, optional
        Where not given, every column and row must be in view, and x = y = 0 is the target's centre.

    Returns
    -------
    DotObservations
        x along the columns (that direction of the grid within 45 degrees of +u), y along the rows (+v).

    Raises
    ------
    CalibrationError
        If the dots are too few, form no grid, or the grid or its origin is ambiguous.
    """
    if not (pitch_mm > 0 and columns >= 2 and rows >= 2):
        raise CalibrationError(
            f"target of {columns} x {rows} dots at {pitch_mm:g} mm: expected two or more columns and rows "
            "and a positive pitch"
        )
    near = None if origin is None else np.asarray(origin.near_px, dtype=np.float64)
    chosen, ij = _grown(dots, near, columns=columns, rows=rows, max_turn_deg=MAX_TURN_DEG)
    low, high = ij.min(axis=0), ij.max(axis=0)
    seen = high - low + 1
    if origin is None or near is None:
        if sorted(seen) != sorted((columns, rows)):
            raise CalibrationError(
                f"{seen[0]} columns and {seen[1]} rows of {columns} x {rows} dots found: which of them "
                "cannot be told without an origin. Nominate a pixel near it (--origin-near), bring the whole "
                "target into view, or print a coded target"
            )
        zero = (low + high) / 2
    else:
        if seen[0] > columns or seen[1] > rows:
            raise CalibrationError(
                f"the grid found has {seen[0]} columns and {seen[1]} rows, the target only {columns} x "
                f"{rows}; check the target's numbers and that no other dots are in view"
                + (", or turn the board by 90 degrees" if seen[0] <= rows and seen[1] <= columns else "")
            )
        zero = _origin_steps(chosen.uv_px, ij, near, columns=columns, rows=rows, at=origin.at)
    return DotObservations(
        uv_px=chosen.uv_px,
        xy_mm=(ij - zero) * pitch_mm,
        cov_px2=chosen.cov_px2,
        area_px2=chosen.area_px2,
        column_row=ij - low,
    )


def assign_coded_grid(dots: Dots, target: DotTarget) -> DotObservations:
    """Place the dots of a coded target, whichever part of it they are and however it is turned.

    Parameters
    ----------
    dots : Dots
        Cut ones are left out unless their centre was completed.
    target : DotTarget
        A coded one.

    Returns
    -------
    DotObservations
        In the target's own axes as it was printed, x = y = 0 in its middle; `board_turn_deg` tells how they
        lie in the picture. Columns and rows count from the target's own first.

    Raises
    ------
    CalibrationError
        If the dots are too few, form no grid, or their sizes leave a doubt about their place.
    """
    chosen, ij = _grown(dots, None, columns=target.columns, rows=target.rows, max_turn_deg=None)
    whole = ~chosen.touches_border | chosen.is_completed
    ratio = area_ratios(chosen.uv_px, chosen.area_px2)
    place = find_code(ij, np.where(whole, size_classes(ratio), -1), chosen.uv_px, target)
    keep = ~place.contradicts
    column_row = place.column_row[keep]
    count = np.array([target.columns, target.rows])
    large = target.large_dots()[column_row[:, 1], column_row[:, 0]]
    chosen = chosen.select(keep)
    return DotObservations(
        uv_px=chosen.uv_px,
        xy_mm=(column_row - (count - 1) / 2) * target.pitch_mm,
        cov_px2=chosen.cov_px2,
        area_px2=chosen.area_px2,
        column_row=column_row,
        size=np.where(large, LARGE_RATIO, 1.0),
    )


def _grown(
    dots: Dots, near: FloatArray | None, *, columns: int, rows: int, max_turn_deg: float | None
) -> tuple[Dots, IntArray]:
    """Return the dots that form one grid and their places, shape (n, 2), counted from anywhere."""
    dots = dots.select(~dots.touches_border | dots.is_completed)
    if len(dots) < MIN_DOTS:
        raise CalibrationError(
            f"{len(dots)} whole dots found, expected at least {MIN_DOTS} of the {columns} x {rows}; "
            "check that the target fills the picture, is in focus and evenly lit"
        )
    start = np.median(dots.uv_px, axis=0) if near is None else near
    place, placed = grow_grid(dots.uv_px, start, max_turn_deg=max_turn_deg)
    n_placed = int(np.count_nonzero(placed))
    if n_placed < max(MIN_DOTS, MIN_SHARE_PLACED * len(dots)):
        raise CalibrationError(
            f"only {n_placed} of {len(dots)} dots form one grid; is there more than one target, or a pattern "
            "other than a square grid?"
        )
    return dots.select(placed), place[placed]


def _origin_steps(
    uv: FloatArray,
    ij: IntArray,
    near: FloatArray,
    *,
    columns: int,
    rows: int,
    at: Literal["centre", "dot"],
) -> FloatArray:
    """Return the grid coordinates, shape (2,), of the origin."""
    coordinates, _ = grid_coordinates(uv, ij, near[None])
    asked = coordinates[0]
    where = f"origin near pixel ({near[0]:g}, {near[1]:g})"
    low, high = ij.min(axis=0), ij.max(axis=0)
    if np.any(asked < low - 0.5) or np.any(asked > high + 0.5):
        raise CalibrationError(f"{where} lies outside the dots found; give a pixel among them")
    count = np.array([columns, rows])
    offset = np.where(count % 2 == 0, 0.5, 0.0) if at == "centre" else np.zeros(2)
    zero = np.rint(asked - offset) + offset
    if np.any(np.abs(asked - zero) > MAX_OFF_LATTICE_STEPS):
        raise CalibrationError(
            f"{where} is ambiguous: it lies midway between two candidates; give a pixel nearer to the "
            + ("target's centre" if at == "centre" else "dot that is meant")
        )
    if at == "dot":
        if not np.any(np.all(ij == zero, axis=1)):
            raise CalibrationError(f"{where}: no whole dot was found there")
        return np.asarray(zero, dtype=np.float64)
    half = (count - 1) / 2
    if np.any(low < zero - half) or np.any(high > zero + half):
        seen = high - low + 1
        fits = np.clip(zero, high - half, low + half)
        k = np.argsort(np.abs(ij - fits).max(axis=1))[:4]
        u, v = uv[k].mean(axis=0)
        raise CalibrationError(
            f"{where} cannot be the centre of a target of {columns} x {rows}: the {seen[0]} x {seen[1]} dots "
            f"found would reach past its rim. The nearest centre that fits is near pixel ({u:.0f}, {v:.0f}); "
            "check the target's numbers, or nominate a dot as the origin"
        )
    return np.asarray(zero, dtype=np.float64)
