"""The planes of a picture as picamera2 hands it over."""

import numpy as np
from numpy.typing import NDArray

from bricktrack_common.errors import HardwareError
from bricktrack_device.interfaces import Still


def split_i420(array: NDArray[np.uint8], size: tuple[int, int]) -> Still:
    """Return the planes of a "YUV420" array, without the padding at the ends of its rows.

    Parameters
    ----------
    array : ndarray of uint8, shape (3/2 height, stride)
        As from `Picamera2.capture_array`: luma, and below it both chroma planes with half the stride.
    size : (int, int), px
        Width and height.

    Raises
    ------
    HardwareError
        If it is of another shape.
    """
    width, height = size
    if array.ndim != 2 or array.shape[0] != height * 3 // 2 or array.shape[1] < width or array.shape[1] % 2:
        raise HardwareError(
            f"camera: a still of shape {array.shape}; expected ({height * 3 // 2}, {width} or more), YUV420"
        )
    chroma = np.ascontiguousarray(array[height:]).reshape(2, height // 2, array.shape[1] // 2)
    return Still(
        luma=array[:height, :width].copy(),
        chroma_u=chroma[0, :, : width // 2].copy(),
        chroma_v=chroma[1, :, : width // 2].copy(),
    )
