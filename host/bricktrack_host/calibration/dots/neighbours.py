"""Nearest neighbours among the points of a plane: SciPy's tree behind one typed shape of answer."""

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray


class Neighbours:
    """Points, shape (n, 2), to be asked for the nearest."""

    def __init__(self, points: FloatArray) -> None:
        from scipy.spatial import cKDTree  # which takes long to load: processing needs none of it

        self._tree = cKDTree(points)

    def nearest(self, asked: FloatArray, k: int) -> tuple[FloatArray, IntArray]:
        """Return the distances and indices, both of shape (m, k), of the k points nearest to (m, 2)."""
        distance, index = self._tree.query(asked, k=np.arange(1, k + 1))
        return np.asarray(distance, dtype=np.float64), np.asarray(index, dtype=np.int64)


def median_spacing(points: FloatArray) -> float:
    """Return the median distance of points, shape (n, 2), to their nearest neighbour."""
    distance, _ = Neighbours(points).nearest(points, 2)
    return float(np.median(distance[:, 1]))
