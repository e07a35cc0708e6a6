"""The dots of one target picture with their places on the target: what the ray models are fitted to."""

from dataclasses import dataclass

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class DotObservations:
    """Dots whose place on the target is known.

    Attributes
    ----------
    uv_px : ndarray, shape (n, 2), px, image frame
        Centroids of the dots' image areas, or images of their centres once corrected.
    xy_mm : ndarray, shape (n, 2), mm, camera axes
        Place on the plane: x along the columns (+u), y along the rows (+v).
    cov_px2 : ndarray, shape (n, 2, 2), px^2
    area_px2 : ndarray, shape (n,), px^2
    column_row : ndarray of int64, shape (n, 2)
        Place in the grid, counted from the leftmost column and topmost row seen.
    """

    uv_px: FloatArray
    xy_mm: FloatArray
    cov_px2: FloatArray
    area_px2: FloatArray
    column_row: IntArray

    def __len__(self) -> int:
        return len(self.uv_px)

    def select(self, keep: BoolArray) -> "DotObservations":
        """Return the dots where ``keep`` is true."""
        return DotObservations(
            self.uv_px[keep],
            self.xy_mm[keep],
            self.cov_px2[keep],
            self.area_px2[keep],
            self.column_row[keep],
        )

    def moved_to(self, uv_px: FloatArray) -> "DotObservations":
        """Return the same dots with other image points, shape (n, 2)."""
        return DotObservations(uv_px, self.xy_mm, self.cov_px2, self.area_px2, self.column_row)
