"""The lights of pictures, and those that assignments give to LEDs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, rows_of
from bricktrack_host.tracking.pictures.segment import Blobs

MIN_INLIERS = 4
"""LEDs that an assignment gives lights, at least: those of a pose with one to spare."""


@dataclass(frozen=True, slots=True, eq=False)
class LedLights:
    """The lights that assignments give to LEDs; NaN for none.

    Attributes
    ----------
    uv_px : ndarray, shape (n, n_leds, 2), px
    cov_px2 : ndarray, shape (n, n_leds, 2, 2), px^2
    area_px2 : ndarray, shape (n, n_leds), px^2
    is_whole : ndarray of bool, shape (n, n_leds)
        False where the border or a card cuts a light, or it is two.
    """

    uv_px: FloatArray
    cov_px2: FloatArray
    area_px2: FloatArray
    is_whole: BoolArray

    def take(self, rows: IntArray) -> "LedLights":
        """Return some of the assignments."""
        return rows_of(self, rows)


@dataclass(frozen=True, slots=True, eq=False)
class RunLights:
    """The lights of many pictures, one after the other.

    Attributes
    ----------
    first : ndarray of int64, shape (n_pictures + 1,)
        Where each picture's begin.
    uv_px, cov_px2, area_px2, flags : ndarray, shapes (n, 2), (n, 2, 2), (n,) and (n,)
        See `segment.Blobs`.
    """

    first: IntArray
    uv_px: FloatArray
    cov_px2: FloatArray
    area_px2: FloatArray
    flags: IntArray

    @staticmethod
    def of(pictures: Sequence[Blobs | None]) -> "RunLights":
        """Put the lights of pictures together; `None` has none."""
        given = [b for b in pictures if b is not None]
        count = [0 if b is None else len(b) for b in pictures]
        return RunLights(
            first=np.concatenate([[0], np.cumsum(count)]).astype(np.int64),
            uv_px=np.concatenate([np.empty((0, 2)), *(b.uv_px for b in given)]),
            cov_px2=np.concatenate([np.empty((0, 2, 2)), *(b.cov_px2 for b in given)]),
            area_px2=np.concatenate([np.empty(0), *(b.area_px2 for b in given)]),
            flags=np.concatenate([np.empty(0, dtype=np.int64), *(b.flags for b in given)]),
        )

    @property
    def count(self) -> IntArray:
        """Number of lights of each picture."""
        return np.diff(self.first)

    def of_leds(self, pictures: IntArray, blob_of_led: IntArray) -> LedLights:
        """Take the lights of assignments (n, n_leds), numbered within each one's picture; -1 for none."""
        given = blob_of_led >= 0
        index = np.where(given, self.first[pictures][:, None] + blob_of_led, 0)
        uv, cov, area = (self._taken(x, index, given) for x in (self.uv_px, self.cov_px2, self.area_px2))
        return LedLights(
            uv, cov, area, given & (self._taken(self.flags.astype(np.float64), index, given) == 0)
        )

    @staticmethod
    def _taken(values: FloatArray, index: IntArray, given: BoolArray) -> FloatArray:
        out = np.full((*index.shape, *values.shape[1:]), np.nan)
        out[given] = values[index[given]]
        return out
