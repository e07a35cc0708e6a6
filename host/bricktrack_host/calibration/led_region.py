"""Where in the picture the LEDs of a layout are seen: the part that a calibration must cover."""

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dots.picture_region import ConvexRegion

TRAVEL_MM = 5.0
"""How far the brick is shown off the axis, along x and y: more than an array's clearances allow."""


def led_pixels(model: RayModel, brick: BrickModel, *, travel_mm: float = TRAVEL_MM) -> FloatArray:
    """Return where LEDs fall, shape (n, 2), px, with the layout square before the camera, on its axis.

    The layout's middle is put on the axis at the near plane, halfway and at the far plane, and moved along x
    and y by ``travel_mm``; pixels outside the picture are left out.

    Raises
    ------
    CalibrationError
        If no LED is in the picture: the layout does not belong to this camera.
    """
    leds = brick.led_positions_mm
    low, high = leds.min(axis=0), leds.max(axis=0)
    centred = leds - [*((low + high) / 2)[:2], low[2]]
    steps = travel_mm * np.array([[0, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]])
    depths = np.linspace(model.plane_a_mm, model.plane_b_mm, 3)
    places = np.array([[dx, dy, z] for dx, dy in steps for z in depths])
    uv = model.project((places[:, None] + centred).reshape(-1, 3)).uv_px
    mode = model.sensor_mode
    inside = np.all((uv >= 0) & (uv <= [mode.width - 1, mode.height - 1]), axis=1)  # NaN is outside
    if np.count_nonzero(inside) < 3:
        raise CalibrationError(
            "the layout's LEDs are not in the picture between the calibrated planes; is it this camera's?"
        )
    return np.asarray(uv[inside])


def led_region(model: RayModel, brick: BrickModel, *, travel_mm: float = TRAVEL_MM) -> ConvexRegion:
    """Return the convex hull of `led_pixels`."""
    return ConvexRegion.around(led_pixels(model, brick, travel_mm=travel_mm))
