"""Convex regions of the picture: where calibration dots surrounded a pixel, and where none did."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import BoolArray, FloatArray, as_float_array
from bricktrack_common.errors import CalibrationError


@dataclass(frozen=True, slots=True, eq=False)
class ConvexRegion:
    """A convex polygon of the picture.

    Attributes
    ----------
    vertices_px : ndarray, shape (n, 2), px, in turning order
    """

    vertices_px: FloatArray

    @classmethod
    def around(cls, uv_px: FloatArray) -> "ConvexRegion":
        """Return the convex hull of points, shape (n, 2).

        Raises
        ------
        CalibrationError
            If the points have no area.
        """
        from scipy.spatial import (  # which takes half a second to load: only to calibrate
            ConvexHull,
            QhullError,
        )

        try:
            hull = ConvexHull(uv_px)
        except (QhullError, ValueError) as e:
            raise CalibrationError(
                f"the {len(uv_px)} dots span no area of the picture: too few or in one line"
            ) from e
        return cls(np.asarray(uv_px[hull.vertices], dtype=np.float64))

    def contains(self, uv_px: ArrayLike) -> BoolArray:
        """Tell for pixels, shape (..., 2), whether they lie in the polygon or on its rim; NaN does not."""
        uv = as_float_array("uv_px", uv_px, (..., 2))
        a = self.vertices_px
        edge = np.roll(a, -1, axis=0) - a
        cross = edge[:, 0] * (uv[..., None, 1] - a[:, 1]) - edge[:, 1] * (uv[..., None, 0] - a[:, 0])
        turn = np.sign(self.signed_area_px2)
        length = np.hypot(edge[:, 0], edge[:, 1])
        return np.asarray(np.all(turn * cross >= -1e-9 * length, axis=-1))

    @property
    def signed_area_px2(self) -> float:
        """Area by the shoelace formula; its sign is the sense of turning."""
        a, b = self.vertices_px, np.roll(self.vertices_px, -1, axis=0)
        return float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2)
