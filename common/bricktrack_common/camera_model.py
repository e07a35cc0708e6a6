"""Pixels to rays and back: what every camera model offers, and the sensor mode it belongs to.

A model is a map from pixels to points on planes z = const of the camera frame: the plane's points that a
pixel sees. Models that have a projection centre and models that have none (two-plane incident-ray tracking)
serve through the same few functions.
"""

from dataclasses import dataclass
from typing import Annotated, Literal, Protocol

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import FloatArray


class SensorMode(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the sensor is read: a calibration belongs to one of these and to no other.

    Attributes
    ----------
    name : str
        For people, as ``imx219-1080p-crop``.
    width, height : int, px
        Size of the delivered picture.
    crop_x, crop_y, crop_width, crop_height : int, sensor px
        The part of the sensor that is read.
    binning : int
        Sensor rows and columns summed into one.
    line_time_ns : float, ns
        Time between the starts of read-out of two successive sensor rows (after binning).
    row_order : "down" or "up"
        Whether the picture's first row is read first or last.
    """

    name: str
    width: Annotated[int, msgspec.Meta(ge=16)]
    height: Annotated[int, msgspec.Meta(ge=16)]
    crop_x: Annotated[int, msgspec.Meta(ge=0)] = 0
    crop_y: Annotated[int, msgspec.Meta(ge=0)] = 0
    crop_width: Annotated[int, msgspec.Meta(ge=16)]
    crop_height: Annotated[int, msgspec.Meta(ge=16)]
    binning: Annotated[int, msgspec.Meta(ge=1)] = 1
    line_time_ns: Annotated[float, msgspec.Meta(ge=0)]
    row_order: Literal["down", "up"] = "down"

    def row_delay_ns(self, v_px: ArrayLike) -> FloatArray:
        """Return how long after the first row's read-out the picture row ``v_px`` is read, ns.

        Counts sensor rows: a picture scaled from fewer or more sensor rows keeps their time.

        Examples
        --------
        >>> mode = SensorMode(name="m", width=1920, height=1080, crop_width=1920, crop_height=1080,
        ...                   line_time_ns=18903.5)
        >>> float(mode.row_delay_ns(539.5))
        10198438.25
        """
        v = np.asarray(v_px, dtype=np.float64)
        sensor_rows = self.crop_height / self.binning
        row = (v + 0.5) * (sensor_rows / self.height) - 0.5
        if self.row_order == "up":
            row = (sensor_rows - 1) - row
        return np.asarray(row * self.line_time_ns)

    def matches(self, other: "SensorMode") -> bool:
        """Tell whether the two modes see the same field: same picture, crop, binning and row order."""
        return all(
            getattr(self, f) == getattr(other, f)
            for f in (
                "width",
                "height",
                "crop_x",
                "crop_y",
                "crop_width",
                "crop_height",
                "binning",
                "row_order",
            )
        )


IMX219_1080P = SensorMode(
    name="imx219-1920x1080-crop",
    width=1920,
    height=1080,
    crop_x=680,
    crop_y=692,
    crop_width=1920,
    crop_height=1080,
    line_time_ns=18903.5,
)
"""The centre crop of an IMX219 at 10 bits: 3448 pixel clocks at 182.4 MHz a row (kernel imx219.c)."""


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """Where points fall in the picture, and how that moves with them.

    Attributes
    ----------
    uv_px : ndarray, shape (..., 2), px
        NaN where the model cannot see the point.
    J_px_per_mm : ndarray, shape (..., 2, 3), px/mm
        Derivative of ``uv_px`` by the point in the camera frame.
    """

    uv_px: FloatArray
    J_px_per_mm: FloatArray


class RayModel(Protocol):
    """What segmentation, pose and fusion need of a calibrated camera."""

    @property
    def sensor_mode(self) -> SensorMode:
        """The mode that the model was calibrated in."""
        ...

    @property
    def plane_a_mm(self) -> float:
        """Depth z = a of the first reference plane, camera frame."""
        ...

    @property
    def plane_b_mm(self) -> float:
        """Depth z = b of the second reference plane, camera frame."""
        ...

    def points_on_plane(self, uv_px: ArrayLike, z_mm: float) -> FloatArray:
        """Return the points (x, y), shape (..., 2), mm, that pixels (..., 2) see on the plane z."""
        ...

    def project(self, points_camera_mm: ArrayLike) -> Projection:
        """Return the pixels of points, shape (..., 3), mm, camera frame, with their Jacobian."""
        ...

    def is_covered(self, uv_px: ArrayLike) -> "np.typing.NDArray[np.bool_]":
        """Tell for pixels (..., 2) whether calibration dots surrounded them; outside it extrapolates."""
        ...
