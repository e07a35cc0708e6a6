"""Compiled: the normal equations of a run's steady poses: what lights say, and differences between frames."""

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.compiled import compiled
from bricktrack_host.tracking.pose.spline_kernel import poses_as_vectors

_DIFFERENCE = (1 / 6, -4 / 6, 1.0, -4 / 6, 1 / 6)  # of a frame to the cubic through its four neighbours
_DIFFERENCE_SIGMAS = 2.5  # beyond which pulls grow no more
N_BANDS = 30  # a frame's six numbers meet those of four frames before it


@compiled
def banded_equations(
    A: FloatArray,
    g: FloatArray,
    R: FloatArray,
    t_mm: FloatArray,
    ends: IntArray,
    least: FloatArray,
    most: FloatArray,
    banded: FloatArray,
    right: FloatArray,
) -> None:
    """Write the equations of all frames' steps, as `scipy.linalg.solveh_banded` takes them (lower part).

    Parameters
    ----------
    A, g : ndarray, shapes (n, 6, 6) and (n, 6)
        What lights say of each frame.
    R, t_mm : ndarray, shapes (n, 3, 3) and (n, 3)
    ends : ndarray of int64
        Behind each part's last frame; frames of a part, five at least, follow each other.
    least, most : ndarray, shape (2,), rad and mm
        Limits of what the differences of most frames of a part are taken to be.
    banded : ndarray, shape (30, n, 6)
        Written; zeros before.
    right : ndarray, shape (n, 6)
        Written.
    """
    for i in range(len(A)):
        for row in range(6):
            right[i, row] = g[i, row]
            for column in range(row + 1):
                banded[row - column, i, column] = A[i, row, column]
            banded[0, i, row] += 1e-9
    begin = 0
    for end in ends:
        x = poses_as_vectors(R[begin:end], t_mm[begin:end])
        off, size = np.zeros((len(x) - 4, 6)), np.zeros((2, len(x) - 4))
        for i in range(len(off)):
            for c in range(6):
                for k in range(5):
                    off[i, c] += _DIFFERENCE[k] * x[i + k, c]
                size[c // 3, i] += off[i, c] ** 2
        size = np.sqrt(size)
        for kind in range(2):
            usual = min(max(np.median(size[kind]), least[kind]), most[kind])
            for i in range(len(off)):
                weight = min(1.0, _DIFFERENCE_SIGMAS * usual / max(size[kind, i], 1e-12)) / usual**2
                for a in range(5):
                    for c in range(3 * kind, 3 * kind + 3):
                        right[begin + i + a, c] -= _DIFFERENCE[a] * weight * off[i, c]
                        for b in range(a + 1):
                            more = _DIFFERENCE[a] * _DIFFERENCE[b] * weight
                            banded[6 * (a - b), begin + i + b, c] += more
        begin = end
