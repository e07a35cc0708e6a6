"""Where a vector or matrix is a number throughout: NaN means "not measured" all over the host."""

import math

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray


def all_finite(values: FloatArray, n_axes: int = 1) -> BoolArray:
    """Return where the last ``n_axes`` axes of an array hold finite numbers only.

    Examples
    --------
    >>> all_finite(np.array([[1.0, 2.0], [np.nan, 3.0]])).tolist()
    [True, False]
    """
    lead = values.shape[: values.ndim - n_axes]
    finite = np.isfinite(values).reshape(*lead, math.prod(values.shape[values.ndim - n_axes :]))
    if finite.shape[-1] > 16:
        return np.asarray(finite.all(axis=-1), dtype=np.bool_)
    out = np.ones(lead, dtype=np.bool_)
    for k in range(finite.shape[-1]):  # numpy sums along short axes ten times slower than across them
        out &= finite[..., k]
    return out
