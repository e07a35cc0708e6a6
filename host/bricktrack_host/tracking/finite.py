"""Where a vector or matrix is a number throughout: NaN means "not measured" all over the host."""

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray


def all_finite(values: FloatArray, n_axes: int = 1) -> BoolArray:
    """Return where the last ``n_axes`` axes of an array hold finite numbers only.

    Examples
    --------
    >>> all_finite(np.array([[1.0, 2.0], [np.nan, 3.0]])).tolist()
    [True, False]
    """
    axes = tuple(range(-n_axes, 0))
    return np.asarray(np.isfinite(values).all(axis=axes), dtype=np.bool_)
