"""Median of a sliding window along time, compiled: the window is kept sorted as it moves."""

import numpy as np

from bricktrack_common.arrays import FloatArray, as_float_array
from bricktrack_host.compiled import compiled


def running_median(values: FloatArray, window: int) -> FloatArray:
    """Return the median of each column over ``window`` rows about each row.

    Parameters
    ----------
    values : ndarray, shape (n, columns)
        No NaN.
    window : int
        Odd. Beyond the ends the first and last row are repeated.

    Notes
    -----
    The same as ``scipy.ndimage.median_filter(values, (window, 1), mode="nearest")``, ten times faster.

    Examples
    --------
    >>> running_median(np.array([[1.0], [9.0], [2.0], [3.0]]), 3)[:, 0].tolist()
    [1.0, 2.0, 3.0, 3.0]
    """
    columns = np.ascontiguousarray(as_float_array("values", values, (None, None)).T)
    return np.ascontiguousarray(_running_median(columns, window).T)


@compiled
def _running_median(values: FloatArray, window: int) -> FloatArray:
    n_columns, n = values.shape
    out = np.empty_like(values)
    half = window // 2
    ordered = np.empty(window)
    for c in range(n_columns):
        row = values[c]
        for i in range(window):
            ordered[i] = row[min(max(i - half, 0), n - 1)]
        ordered.sort()
        out[c, 0] = ordered[half]
        for k in range(1, n):
            gone, new = row[max(k - half - 1, 0)], row[min(k + half, n - 1)]
            at = np.searchsorted(ordered, gone)
            while at + 1 < window and ordered[at + 1] < new:
                ordered[at] = ordered[at + 1]
                at += 1
            while at > 0 and ordered[at - 1] > new:
                ordered[at] = ordered[at - 1]
                at -= 1
            ordered[at] = new
            out[c, k] = ordered[half]
    return out
