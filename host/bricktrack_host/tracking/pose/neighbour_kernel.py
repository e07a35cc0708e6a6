"""Compiled: where the frames about each frame of a run show it."""

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.compiled import compiled
from bricktrack_host.tracking.pose.small_algebra import rotation
from bricktrack_host.tracking.pose.turn_kernel import put_rotation_vector, turn_matrix


@compiled
def fill_between(
    stamps_ns: IntArray,
    valid: IntArray,
    R: FloatArray,
    t_mm: FloatArray,
    most_filled: int,
    out_R: FloatArray,
    out_t_mm: FloatArray,
) -> None:
    """Fill in the poses of frames by the cubic through two neighbours on either side, where these are near.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (n,)
    valid : ndarray of int64
        The frames that have poses, in order.
    R, t_mm, out_R, out_t_mm : ndarray, shapes (n, 3, 3) and (n, 3)
    most_filled : int
        Frames without a pose, one after the other, that neighbours bridge.
    """
    near, s, weight = np.empty(4, dtype=np.int64), np.empty(4), np.empty(4)
    M, turn, sums = np.empty((3, 3)), np.empty(3), np.empty(3)
    before = 0  # valid frames before this one
    for i in range(len(R)):
        while before < len(valid) and valid[before] < i:
            before += 1
        after = before + 1 if before < len(valid) and valid[before] == i else before
        if before < 2 or after + 2 > len(valid):
            continue
        near[0], near[1], near[2], near[3] = (
            valid[before - 2],
            valid[before - 1],
            valid[after],
            valid[after + 1],
        )
        if near[2] - near[1] > most_filled + 1 or near[3] - near[0] > most_filled + 5:
            continue
        for k in range(4):
            s[k] = (stamps_ns[near[k]] - stamps_ns[i]) * 1e-9
        sums[:] = 0.0
        out_t_mm[i] = 0.0
        for k in range(4):
            weight[k] = 1.0  # Lagrange's, at zero
            for other in range(4):
                if other != k:
                    weight[k] *= -s[other] / (s[k] - s[other])
            turn_matrix(R[near[1]], R[near[k]], M)
            put_rotation_vector(M, turn)
            for c in range(3):
                sums[c] += weight[k] * turn[c]
                out_t_mm[i, c] += weight[k] * t_mm[near[k], c]
        rotation(sums[0], sums[1], sums[2], M)
        first = R[near[1]]
        for r in range(3):
            for c in range(3):
                out_R[i, r, c] = first[r, 0] * M[0, c] + first[r, 1] * M[1, c] + first[r, 2] * M[2, c]
