"""The covariance of a smoothed motion at instants between the filter's nodes, compiled."""

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.compiled import compiled


@compiled
def covariance_between(
    covariance: FloatArray, node: IntArray, share: FloatArray, H: FloatArray
) -> FloatArray:
    """Return H C H^T, shape (n, 6, 6), with the covariance C of states between two nodes.

    Parameters
    ----------
    covariance : ndarray, shape (K, c, c)
        Of the states at the nodes.
    node, share : ndarray, shape (n,)
        The node before each instant, and how far it is on the way to the next: C is linear between them.
    H : ndarray, shape (n, 6, c)
    """
    n, c = len(node), H.shape[2]
    out, half = np.empty((n, 6, 6)), np.empty((6, c))
    between = np.empty((c, c))
    for i in range(n):
        k, a = node[i], share[i]
        for r in range(c):
            for s in range(c):
                between[r, s] = covariance[k, r, s]
                if a != 0.0:
                    between[r, s] += a * (covariance[k + 1, r, s] - covariance[k, r, s])
        for p in range(6):
            for s in range(c):
                half[p, s] = 0.0
            for r in range(c):
                h = H[i, p, r]
                if h != 0.0:
                    for s in range(c):
                        half[p, s] += h * between[r, s]
            for q in range(p + 1):
                total = 0.0
                for s in range(c):
                    total += half[p, s] * H[i, q, s]
                out[i, p, q] = out[i, q, p] = total
    return out
