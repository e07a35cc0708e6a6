"""The lights in all pictures of a run.

Each picture is searched decimated, which is cheap and blind to no motion, and every find of an LED's size is
measured at full resolution; no picture is kept.
"""

from collections.abc import Callable, Iterable
from contextlib import closing
from typing import Literal

import numpy as np

from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import TrackingError
from bricktrack_host.tracking.pictures.look_ahead import look_ahead
from bricktrack_host.tracking.pictures.segment import Blobs, PaperLimits, Picture, find_blobs, paper_filter


def find_run_lights(
    pictures: Iterable[tuple[int, Picture]],
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    n_frames: int,
    method: Literal["default", "paper"] = "default",
    progress: Callable[[int], None] | None = None,
) -> list[Blobs | None]:
    """Find what could be an LED in each picture of a run.

    Parameters
    ----------
    pictures : iterable of (int, Picture)
        Index of the frame and its picture, in time order; taken in a thread of their own, two ahead, and not
        kept.
    ray_model : RayModel
    brick_model : BrickModel
    n_frames : int
    method : "default" or "paper"
        Of `segment`.
    progress : callable, optional
        Called with the number of frames done.

    Returns
    -------
    lights : list of length n_frames
        `None` where no picture came.

    Raises
    ------
    TrackingError
        If the method is unknown, a picture's index is not below ``n_frames`` or out of order, or its size is
        not that of the calibration.
    """
    find = light_finder(ray_model, brick_model, method)
    lights: list[Blobs | None] = [None] * n_frames
    last = -1
    with closing(look_ahead(pictures)) as ahead:
        for done, (i, picture) in enumerate(ahead, start=1):
            if not last < i < n_frames:
                raise TrackingError(
                    f"picture of frame {i} after frame {last}, with {n_frames} time stamps; expected rising "
                    "indices below their number"
                )
            last = i
            lights[i] = find(i, picture)
            if progress is not None:
                progress(done)
    return lights


def light_finder(
    ray_model: RayModel, brick_model: BrickModel, method: Literal["default", "paper"] = "default"
) -> Callable[[int, Picture], Blobs]:
    """Return what finds the lights of LED size in the picture of a frame, given its index; for any thread.

    Raises
    ------
    TrackingError
        If the method is unknown; from what is returned, if a picture's size is not that of the calibration.
    """
    if method not in ("default", "paper"):
        raise TrackingError(f"segmentation method is {method!r}; expected 'default' or 'paper'")
    radius_px, mode = usual_radius_px(ray_model, brick_model), ray_model.sensor_mode
    limits = PaperLimits.for_radius(radius_px)

    def find(i: int, picture: Picture) -> Blobs:
        if picture.luma.shape != (mode.height, mode.width):
            raise TrackingError(
                f"frame {i} has {picture.luma.shape[1]} x {picture.luma.shape[0]} pixels; the calibration is "
                f"of mode {mode.name}, {mode.width} x {mode.height}. Use the calibration of the run's mode."
            )
        if method == "paper":
            return paper_filter(picture, limits=limits)
        return find_blobs(picture, radius_px=radius_px)

    return find


def usual_radius_px(ray_model: RayModel, brick_model: BrickModel) -> float:
    """Return the radius of an LED midway between the calibrated planes, at the picture's middle, px."""
    mode = ray_model.sensor_mode
    z = 0.5 * (ray_model.plane_a_mm + ray_model.plane_b_mm)
    middle = np.array([0.5 * (mode.width - 1), 0.5 * (mode.height - 1)])
    xy = ray_model.points_on_plane(middle, z)
    J = ray_model.project(np.array([xy[0], xy[1], z])).J_px_per_mm[:, :2]
    return float(np.median(brick_model.led_radii_mm) * np.sqrt(abs(np.linalg.det(J))))
