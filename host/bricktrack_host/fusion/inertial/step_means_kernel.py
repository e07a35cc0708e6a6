"""Means of sampled quantities over steps of time, compiled."""

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_host.compiled import compiled


@compiled
def step_means(t_s: FloatArray, values: FloatArray, points_s: FloatArray, counts: BoolArray) -> FloatArray:
    """Return the means of quantities over the points of each step, shape (n, k).

    Parameters
    ----------
    t_s, values : ndarray, shape (m,), (m, k)
        Rising instants, with what is between them linear, and held beyond the first and the last.
    points_s, counts : ndarray, shape (n, p), and (n, p) of bool
        Instants of each step, near each other, and which of them count; the others count as zero.
    """
    n, k, last, i = len(points_s), values.shape[1], len(t_s) - 2, 0
    out = np.zeros((n, k))
    weight = 1.0 / points_s.shape[1]
    for step in range(n):
        for point in range(points_s.shape[1]):
            if not counts[step, point]:
                continue
            t = points_s[step, point]
            while i < last and t_s[i + 1] < t:
                i += 1
            while i > 0 and t_s[i] > t:
                i -= 1
            share = min(max((t - t_s[i]) / (t_s[i + 1] - t_s[i]), 0.0), 1.0)
            for j in range(k):
                out[step, j] += weight * (values[i, j] + share * (values[i + 1, j] - values[i, j]))
    return out
