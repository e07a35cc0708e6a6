"""A camera's picture as a page shows it: no wider than there is room for, and packed."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

_WIDTH_PX = 960  # more than a page shows of it
_JPEG_QUALITY = 90


@dataclass(frozen=True, slots=True)
class PagePicture:
    """A picture, shrunk for a page.

    Attributes
    ----------
    jpeg : bytes
    width_px, height_px : int
        Of the camera's picture.
    """

    jpeg: bytes
    width_px: int
    height_px: int


def page_picture(image: NDArray[np.uint8]) -> PagePicture:
    """Return a picture, shape (rows, columns) grey or (rows, columns, 3) RGB, for a page."""
    rows, columns = image.shape[:2]
    scale = min(1.0, _WIDTH_PX / columns)
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    if small.ndim == 3:
        small = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return PagePicture(jpeg.tobytes(), columns, rows)
