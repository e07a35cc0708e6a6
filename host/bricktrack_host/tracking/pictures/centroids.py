"""From a window of luma to one light: where it is, how well that is known, and what shape it has.

An LED in these pictures is a disc of some ten to forty pixels' radius whose inside is flat or saturated: all
that is known of its place is in its rim. So the centroid is that of the lit *area*, each pixel counted by the
share of it that the light covers. The share is the grey value in linear light between the local background
and the LED's own plateau, so that a rim smeared by the lens or by motion counts half where half the light
fell: motion blur then leaves the centroid at mid-exposure. Shares below `light_kernel.SHARE_LOW` are
background, those above `SHARE_HIGH` plateau: an uneven wall behind the LED and the fall of brightness towards
a dome's limb do not pull. Nothing depends on an absolute grey level, hence not on exposure.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from bricktrack_common.arrays import FloatArray
from bricktrack_host.tracking.pictures import light_kernel as k

Plane = NDArray[np.uint8]


@cache
def linear_light_of_luma() -> FloatArray:
    """Return the table from limited-range luma code to linear light (Rec. 709), shape (256,), read-only."""
    signal = np.clip((np.arange(256) - 16.0) / 219.0, 0.0, 255.0 / 219.0)
    light: FloatArray = np.where(signal < 0.081, signal / 4.5, ((signal + 0.099) / 1.099) ** (1 / 0.45))
    light.setflags(write=False)
    return light


@dataclass(frozen=True, slots=True, eq=False)
class Spot:
    """One light measured in a window.

    Attributes
    ----------
    uv_px : ndarray, shape (2,), px, image frame
    cov_px2 : ndarray, shape (2, 2), px^2
    area_px2 : float
        Lit area: the sum of the shares.
    eccentricity : float
        Of the ellipse of the same second moments: 0 for a disc.
    fill : float
        Area over that of the ellipse of the same second moments: 1 for an ellipse, less for rings, crescents
        and two lights run together.
    plateau, background : float
        Linear light, 0..1.
    bbox : tuple of int
        Column, row, width, height of the lit component in the image.
    touches_window : bool
        The light goes on beyond the window.
    """

    uv_px: FloatArray
    cov_px2: FloatArray
    area_px2: float
    eccentricity: float
    fill: float
    plateau: float
    background: float
    bbox: tuple[int, int, int, int]
    touches_window: bool


def flat_bytes(plane: Plane) -> tuple[Plane, int]:
    """Return a plane's bytes, flat, and their number from row to row; a copy only of unusual views."""
    if plane.strides[1] != 1 or plane.strides[0] < plane.shape[1]:
        plane = np.ascontiguousarray(plane)
    stride = plane.strides[0]
    n_bytes = (plane.shape[0] - 1) * stride + plane.shape[1]
    return as_strided(plane, shape=(n_bytes,), strides=(1,), writeable=False), stride


def light_levels(patch: Plane) -> tuple[float, float] | None:
    """Return background and plateau of a window in linear light, or `None` where nothing shines.

    The two classes are separated by their means (Ridler and Calvard), from the histogram; the levels are the
    medians of the classes, which neither a reflection nor the rim moves.
    """
    luma, stride = flat_bytes(patch)
    rows, columns = patch.shape
    background, plateau = k.window_levels(luma, stride, 0, 0, columns, rows, linear_light_of_luma())
    return (background, plateau) if plateau > background else None


def measure_spot(
    patch: Plane, *, origin_px: tuple[int, int], near_px: tuple[float, float] | None = None
) -> Spot | None:
    """Return the light in a window that lies nearest to ``near_px``, or `None` where there is none.

    Parameters
    ----------
    patch : ndarray of uint8, shape (rows, columns)
        Luma, limited range: a view into the picture.
    origin_px : (int, int), px
        Column and row, in the image, of ``patch[0, 0]``.
    near_px : (float, float), px, optional
        Where the light is expected; default the middle of the window.

    Notes
    -----
    Covariance: each rim pixel's share errs by the noise over the contrast, independently, and lies at about
    the radius; so var = 2 M sum(var_share) / area^2, M the matrix of second moments. `FLOOR_SD_PX` is added.
    """
    rows, columns = patch.shape
    (u0, v0), (u, v) = origin_px, near_px or (origin_px[0] + columns / 2, origin_px[1] + rows / 2)
    luma, stride = flat_bytes(patch)
    light = np.full(k.N_FIELDS, np.nan)
    k.measure_window(
        luma, stride, rows, columns, 0, 0, columns, rows, float(u - u0), float(v - v0),
        linear_light_of_luma(), False, light,
    )  # fmt: skip
    if np.isnan(light[k.AREA]):
        return None
    x, y, w, h = (int(i) for i in light[k.BOX_U : k.BOX_HEIGHT + 1])
    return Spot(
        uv_px=light[[k.U, k.V]] + origin_px,
        cov_px2=light[[[k.COV_UU, k.COV_UV], [k.COV_UV, k.COV_VV]]],
        area_px2=float(light[k.AREA]),
        eccentricity=float(light[k.ECCENTRICITY]),
        fill=float(light[k.FILL]),
        plateau=float(light[k.PLATEAU]),
        background=float(light[k.BACKGROUND]),
        bbox=(u0 + x, v0 + y, w, h),
        touches_window=bool(light[k.TOUCHES]),
    )
