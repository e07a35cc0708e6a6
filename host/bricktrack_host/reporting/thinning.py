"""Lines and dots with more samples than a page has pixels, thinned so that their picture stays the same."""

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray

N_COLUMNS = 1200
"""Pixels that a page gives the time axis, and a little more."""


def thinned(t_s: FloatArray, y: FloatArray, *, n_columns: int = N_COLUMNS) -> IntArray:
    """Return which samples draw the same line as all of them, at so many pixels across.

    First, least, greatest and last sample of every column of pixels: what lies between them falls on the
    same pixels, or the ones beside them (Jugel et al., "M4", 2014). Columns with NaN are kept whole, so that
    gaps stay gaps.

    Parameters
    ----------
    t_s : ndarray, shape (n,), rising
    y : ndarray, shape (n,)
    n_columns : int

    Returns
    -------
    index : ndarray of int64, shape (m,), rising

    Examples
    --------
    >>> t = np.arange(9.0)
    >>> thinned(t, np.array([0.0, 1, 9, 1, 2, 0, -3, 4, 5]), n_columns=1).tolist()
    [0, 2, 6, 8]
    """
    n = len(t_s)
    if n <= 4 * n_columns or not t_s[-1] > t_s[0]:
        return np.arange(n, dtype=np.int64)
    column = pixel_columns(t_s, n_columns)
    is_first = _begins(column)
    starts = np.flatnonzero(is_first)
    of_column = np.cumsum(is_first) - 1
    keep = is_first | np.append(is_first[1:], True)
    for extreme in (np.minimum, np.maximum):  # NaN if one is among them
        extremes = extreme.reduceat(y, starts)
        at = np.flatnonzero(y == extremes[of_column])
        keep[at[_begins(of_column[at])]] = True
    keep |= np.isnan(extremes)[of_column]
    return np.asarray(np.flatnonzero(keep), dtype=np.int64)


def _begins(column: IntArray) -> BoolArray:
    """Return which samples are the first of their column."""
    return np.asarray(np.diff(column, prepend=-1) != 0)


def pixel_columns(t_s: FloatArray, n_columns: int) -> IntArray:
    """Return the column of pixels that each sample falls in."""
    share = (t_s - t_s[0]) / (t_s[-1] - t_s[0])
    return np.asarray(np.minimum(share * n_columns, n_columns - 1), dtype=np.int64)


def thinned_band(
    t_s: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a band that covers in every column of pixels what the whole one covers."""
    if len(t_s) <= 4 * N_COLUMNS or not t_s[-1] > t_s[0]:
        return t_s, low, high
    column = pixel_columns(t_s, N_COLUMNS)
    starts = np.flatnonzero(np.concatenate([[True], column[1:] != column[:-1]]))
    ends = np.append(starts[1:], len(t_s)) - 1
    return (
        np.stack([t_s[starts], t_s[ends]], axis=1).ravel(),
        np.repeat(np.fmin.reduceat(low, starts), 2),
        np.repeat(np.fmax.reduceat(high, starts), 2),
    )


def thinned_dots(places: IntArray, cell: int) -> IntArray:
    """Return the dots without those that lie where one before them does, of very many.

    Parameters
    ----------
    places : ndarray of int64, shape (n, 2)
        In units of the page.
    cell : int
        Side of the squares of which each holds one dot, in the same units: far below a dot's width.

    Returns
    -------
    places : ndarray of int64, shape (m, 2)
        In the order given.
    """
    if len(places) <= 4 * N_COLUMNS:
        return places
    column, row = (places // cell).T
    _, first = np.unique(column * (np.ptp(row) + 1) + row - row.min(), return_index=True)
    return np.asarray(places[np.sort(first)], dtype=np.int64)
