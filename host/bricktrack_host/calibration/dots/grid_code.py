"""Which part of a coded target a grid of dots is, and how it is turned: by which of its dots are large.

All places and quarter turns are tried. A dot's size is misread now and then (glare, dirt), so that the place
is believed that contradicts the fewest dots, if they are few and every other place contradicts clearly more.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import correlate

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dots.neighbours import Neighbours
from bricktrack_host.calibration.target.printed_target import DotTarget

MIN_READ = 30
"""Fewer dots of known size than this are not asked."""
MAX_MISREAD = 0.08
MIN_MARGIN = 5
"""By so many more dots the next best place must be contradicted: where one in twenty is misread, the odds
are 20^5 to 1."""
MAX_MISREAD_NEARBY = 4
"""So many contradicting dots among thirteen neighbours: that part of the grid slipped."""

_QUARTER = np.array([[0, -1], [1, 0]])


@dataclass(frozen=True, slots=True, eq=False)
class CodePlace:
    """Where dots are on the target.

    Attributes
    ----------
    column_row : ndarray of int64, shape (n, 2)
        From the target's own first column and row.
    contradicts : ndarray of bool, shape (n,)
        The dot's size is not that of its place, or its place is not on the target: not to be trusted.
    """

    column_row: IntArray
    contradicts: BoolArray


def find_code(ij: IntArray, size_class: IntArray, uv_px: FloatArray, target: DotTarget) -> CodePlace:
    """Find the place of a grid on a coded target.

    Parameters
    ----------
    ij : ndarray of int64, shape (n, 2)
        Columns and rows, counted from anywhere, in a right-handed turn of the target's.
    size_class : ndarray of int64, shape (n,)
        1 large, 0 small, -1 not known.
    uv_px : ndarray, shape (n, 2), px
        Where the dots are, to be named in errors.
    target : DotTarget

    Raises
    ------
    CalibrationError
        If the sizes fit no place, more than one, or one only in part.
    """
    known = size_class >= 0
    n = int(np.count_nonzero(known))
    if n < MIN_READ:
        raise CalibrationError(
            f"{n} dots of known size found; a coded target needs at least {MIN_READ} to tell its place: "
            "bring more of it into view, or check focus and light"
        )
    large = target.large_dots()
    found = [_best_places(ij[known] @ q.T, size_class[known], large) for q in _quarter_turns()]
    quarter = int(np.argmin([errors[0] for errors, _ in found]))
    errors, shift = found[quarter]
    least = errors[0]
    second = min(errors[1], *(e[0] for k, (e, _) in enumerate(found) if k != quarter))
    if least > MAX_MISREAD * n:
        mirrored = [
            _best_places((ij[known] * np.array([-1, 1])) @ q.T, size_class[known], large)
            for q in _quarter_turns()
        ]
        if min(e[0] for e, _ in mirrored) <= MAX_MISREAD * n:
            raise CalibrationError("the picture is mirrored: the target fits only in a mirror; flip it back")
        raise CalibrationError(
            f"the dots' sizes fit no place on the coded target of {target.columns} x {target.rows}: at the "
            f"best one {least} of {n} contradict. Is it this target, and coded?"
        )
    if second - least < MIN_MARGIN:
        raise CalibrationError(
            f"which part of the target is seen is ambiguous: {n} dots contradict one place {least} times and "
            f"another {second} times; bring more of the target into view"
        )
    column_row = ij @ _quarter_turns()[quarter].T + shift
    inside = np.all((column_row >= 0) & (column_row < [target.columns, target.rows]), axis=1)
    safe = np.where(inside[:, None], column_row, 0)
    contradicts = ~inside | (known & (large[safe[:, 1], safe[:, 0]] != size_class))
    _require_no_cluster(contradicts, uv_px)
    return CodePlace(column_row, contradicts)


def _quarter_turns() -> list[IntArray]:
    return [np.linalg.matrix_power(_QUARTER, k) for k in range(4)]


def _best_places(ij: IntArray, size_class: IntArray, large: BoolArray) -> tuple[tuple[int, int], IntArray]:
    """Return the least and second least numbers of contradicting dots, and the shift (2,) of the least."""
    low = ij.min(axis=0)
    seen = np.zeros((2, *(ij.max(axis=0) - low + 1)[::-1]))
    seen[size_class, ij[:, 1] - low[1], ij[:, 0] - low[0]] = 1
    # Dots off the target agree with neither size.
    agree = sum(
        correlate(of_target.astype(np.float64), of_picture, mode="full", method="fft")
        for of_target, of_picture in ((~large, seen[0]), (large, seen[1]))
    )
    errors = len(ij) - np.rint(agree).astype(np.int64)
    flat = errors.ravel()
    best = int(np.argmin(flat))
    row, column = divmod(best, errors.shape[1])
    # In a full correlation the picture's last column lies over the target's first at index 0.
    shift = np.array([column - (seen.shape[2] - 1), row - (seen.shape[1] - 1)]) - low
    least = int(flat[best])
    flat[best] = len(ij)
    return (least, int(flat.min())), shift


def _require_no_cluster(contradicts: BoolArray, uv_px: FloatArray) -> None:
    """Refuse contradictions that lie together: a part of the grid that is not where it seems."""
    near = Neighbours(uv_px).nearest(uv_px, min(13, len(uv_px)))[1]
    together = contradicts[near].sum(axis=1)
    worst = int(np.argmax(together))
    if together[worst] >= MAX_MISREAD_NEARBY:
        u, v = uv_px[worst]
        raise CalibrationError(
            f"{together[worst]} of 13 dots near pixel ({u:.0f}, {v:.0f}) have the wrong size for their "
            "place: the grid may be miscounted there; uncover the dots around it, or take out reflections"
        )
