"""The mean of several pictures of a still scene, and whether the scene did keep still."""

from collections.abc import Sequence

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dots.dot_detection import GreyImage
from bricktrack_host.calibration.dots.dot_observations import DotObservations

MAX_SHIFT_PX = 0.1
"""By which dots may move between the first and the last picture."""


def mean_picture(pictures: Sequence[GreyImage]) -> GreyImage:
    """Return the mean of pictures as 16 bits full scale; a single picture as it is.

    Raises
    ------
    CalibrationError
        If there is none, or their sizes or types differ.
    """
    kinds = {(p.shape, p.dtype.str) for p in pictures}
    if len(kinds) != 1:
        sizes = ", ".join(sorted(f"{s[1]} x {s[0]} px ({t})" for s, t in kinds)) or "none"
        raise CalibrationError(f"pictures to be averaged: {sizes}; expected one size and type")
    if len(pictures) == 1:
        return pictures[0]
    total = np.zeros(pictures[0].shape, dtype=np.uint64)
    for picture in pictures:
        total += picture
    scale = 1 if pictures[0].dtype == np.uint16 else 257
    # Rounded to the nearest; 2^16 pictures of 16 bits would not fill 64.
    n = np.uint64(len(pictures))
    return np.asarray((total * np.uint64(scale) + n // np.uint64(2)) // n, dtype=np.uint16)


def shift_between_px(first: DotObservations, last: DotObservations) -> float:
    """Return by how much the dots that both pictures show have moved, median distance, px.

    Raises
    ------
    CalibrationError
        If they share no dot.
    """
    a, b = _by_place(first), _by_place(last)
    common, i, j = np.intersect1d(a[0], b[0], return_indices=True)
    if not len(common):
        raise CalibrationError("two pictures of one target share no dot; was it taken away in between?")
    return float(np.median(np.hypot(*(a[1][i] - b[1][j]).T)))


def _by_place(dots: DotObservations) -> tuple[IntArray, FloatArray]:
    column, row = dots.column_row.T
    return column * 100_000 + row, dots.uv_px
