"""From a decoded picture to its lights: where to look, and which of what shines could be an LED.

Two methods. `find_blobs` (the default) searches the picture decimated, at several fractions of its brightest
light, and measures each find at full resolution (`centroids`). `paper_filter` is the source paper's: fixed
colour and grey limits, rejection by area, radius and eccentricity, plain means.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import FloatArray, IntArray, rows_of
from bricktrack_common.errors import ShapeError
from bricktrack_host.tracking.pictures import light_kernel as k
from bricktrack_host.tracking.pictures.centroids import flat_bytes, linear_light_of_luma
from bricktrack_host.tracking.pictures.search_kernel import find_lights

Plane = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """One decoded picture: views of the decoder's planes, YUV 4:2:0, BT.601, limited range.

    Attributes
    ----------
    luma : ndarray of uint8, shape (rows, columns)
    chroma_u, chroma_v : ndarray of uint8, shape (rows / 2, columns / 2)
    """

    luma: Plane
    chroma_u: Plane
    chroma_v: Plane

    def __post_init__(self) -> None:
        half = tuple((n + 1) // 2 for n in self.luma.shape)
        if self.luma.ndim != 2 or self.chroma_u.shape != half or self.chroma_v.shape != half:
            raise ShapeError(
                f"picture planes have shapes {self.luma.shape}, {self.chroma_u.shape}, "
                f"{self.chroma_v.shape}; expected (rows, columns) and twice half of that (YUV 4:2:0)"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Blobs:
    """Lights in one picture that could be LEDs.

    Attributes
    ----------
    uv_px : ndarray, shape (n, 2), px
        Centroids.
    cov_px2 : ndarray, shape (n, 2, 2), px^2
    area_px2 : ndarray, shape (n,), px^2
    eccentricity : ndarray, shape (n,)
    fill : ndarray, shape (n,)
        See `centroids.Spot`.
    flags : ndarray of int64, shape (n,), `LedFlag`
        BORDER, MERGED, PARTLY_COVERED as far as the shape alone tells.
    """

    uv_px: FloatArray
    cov_px2: FloatArray
    area_px2: FloatArray
    eccentricity: FloatArray
    fill: FloatArray
    flags: IntArray

    def __len__(self) -> int:
        return len(self.area_px2)

    def take(self, which: NDArray[np.int64] | NDArray[np.bool_]) -> "Blobs":
        """Return a selection of the blobs."""
        return rows_of(self, which)


def find_blobs(picture: Picture, *, radius_px: float | None = None) -> Blobs:
    """Search the whole picture, decimated, for lights of an LED's size, and measure them at full resolution.

    Parameters
    ----------
    picture : Picture
    radius_px : float, px, optional
        About the radius of an LED; sets the decimation (at most 8) and the sizes that are believed: a third
        of it to three times it. Default: from 6 px to an eighth of the picture's height.
    """
    rows, columns = picture.luma.shape
    smallest = 6.0 if radius_px is None else max(radius_px / 3, 2.0)
    largest = rows / 8 if radius_px is None else 3 * radius_px
    step = min(max(int(smallest * 1.2), 1), 8)
    luma, stride = flat_bytes(picture.luma)
    linear = linear_light_of_luma()
    lights, flags = find_lights(luma, stride, rows, columns, step, smallest, largest, linear)
    return Blobs(
        uv_px=lights[:, [k.U, k.V]],
        cov_px2=lights[:, [[k.COV_UU, k.COV_UV], [k.COV_UV, k.COV_VV]]],
        area_px2=lights[:, k.AREA],
        eccentricity=lights[:, k.ECCENTRICITY],
        fill=lights[:, k.FILL],
        flags=flags,
    )


def _no_blobs() -> Blobs:
    none = np.empty(0)
    return Blobs(np.empty((0, 2)), np.empty((0, 2, 2)), none, none, none, np.empty(0, dtype=np.int64))


@dataclass(frozen=True, slots=True)
class PaperLimits:
    """The limits of the paper's filter.

    Attributes
    ----------
    channel_min : float
        Each of R, G, B must reach it (and at most 255), full-range codes.
    grey_min : float
        The grey value must exceed it.
    area_px2 : (float, float)
        Smallest and largest area.
    radius_px : (float, float)
        Smallest and largest radius of the circle of the same area as the bounding box's ellipse.
    eccentricity_max : float
    """

    channel_min: float = 100.0
    grey_min: float = 200.0
    area_px2: tuple[float, float] = (100.0, 40_000.0)
    radius_px: tuple[float, float] = (6.0, 120.0)
    eccentricity_max: float = 0.85

    @staticmethod
    def for_radius(radius_px: float) -> "PaperLimits":
        """Return limits for LEDs of about this radius: half of it to twice it."""
        low, high = 0.5 * radius_px, 2.0 * radius_px
        return PaperLimits(area_px2=(np.pi * low**2, np.pi * high**2), radius_px=(low, high))


_DEFAULT_LIMITS = PaperLimits()


def paper_filter(picture: Picture, *, limits: PaperLimits = _DEFAULT_LIMITS) -> Blobs:
    """Segment a picture as the paper does.

    Each RGB channel within 100..255, grey value above 200, small specks and regions touching the border
    removed, then area, radius and eccentricity; the centroid is the plain mean of u and v of the region.

    Notes
    -----
    Full-range grey above 200 needs luma above 187 in limited range, whatever the chroma (a channel that clips
    only loses): regions are looked for there, and RGB is computed inside their bounding boxes alone.
    """
    floor = int(np.floor(limits.grey_min * 219 / 255 + 16)) - 1
    mask = cv2.threshold(picture.luma, floor, 255, cv2.THRESH_BINARY)[1]
    n, _, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8, ltype=cv2.CV_16U)
    rows, columns = picture.luma.shape
    boxes = [stats[i, :4] for i in range(1, n) if stats[i, cv2.CC_STAT_AREA] >= limits.area_px2[0]]
    regions: list[tuple[float, float, float, FloatArray, float]] = []
    for x, y, w, h in boxes:
        u0, v0 = max(int(x) - 2, 0) & ~1, max(int(y) - 2, 0) & ~1
        u1, v1 = min(int(x + w) + 2, columns), min(int(y + h) + 2, rows)
        regions += _paper_regions(_paper_mask(picture, (u0, v0, u1, v1), limits), (u0, v0), limits, picture)
    unique: list[tuple[float, float, float, FloatArray, float]] = []
    for r in regions:  # overlapping boxes may hold one region twice
        if not any(abs(r[0] - q[0]) < 0.5 and abs(r[1] - q[1]) < 0.5 for q in unique):
            unique.append(r)
    if not unique:
        return _no_blobs()
    uv = np.array([(r[0], r[1]) for r in unique])
    area = np.array([r[2] for r in unique])
    M = np.array([r[3] for r in unique])
    det = np.linalg.det(M)
    # A rim pixel is in or out: its share errs by a uniform +-1/2; the rim has about 2 sqrt(pi area) pixels.
    share_var = 2 * np.sqrt(np.pi * area) / 12
    cov = 2 * M * (share_var / area**2)[:, None, None] + k.FLOOR_SD_PX**2 * np.eye(2)
    return Blobs(
        uv_px=uv,
        cov_px2=cov,
        area_px2=area,
        eccentricity=np.array([r[4] for r in unique]),
        fill=area / (4 * np.pi * np.sqrt(np.maximum(det, 1e-12))),
        flags=np.zeros(len(unique), dtype=np.int64),
    )


def _paper_mask(picture: Picture, box: tuple[int, int, int, int], limits: PaperLimits) -> Plane:
    """Return 1 where a pixel of the box passes the colour and grey limits; the box starts at even pixels."""
    u0, v0, u1, v1 = box
    y = (picture.luma[v0:v1, u0:u1].astype(np.float32) - 16.0) * np.float32(255 / 219)
    half = (slice(v0 // 2, (v1 + 1) // 2), slice(u0 // 2, (u1 + 1) // 2))
    chroma = []
    for plane in (picture.chroma_u, picture.chroma_v):
        full = np.repeat(np.repeat(plane[half], 2, axis=0), 2, axis=1)[: v1 - v0, : u1 - u0]
        chroma.append((full.astype(np.float32) - 128.0) * np.float32(255 / 224))
    cb, cr = chroma
    red = np.clip(y + 1.402 * cr, 0, 255)
    green = np.clip(y - 0.344136 * cb - 0.714136 * cr, 0, 255)
    blue = np.clip(y + 1.772 * cb, 0, 255)
    grey = 0.299 * red + 0.587 * green + 0.114 * blue
    lowest = np.minimum(np.minimum(red, green), blue)
    passes = (lowest >= limits.channel_min) & (grey > limits.grey_min)
    return np.asarray(passes, dtype=np.uint8)


def _paper_regions(
    mask: Plane, origin_px: tuple[int, int], limits: PaperLimits, picture: Picture
) -> list[tuple[float, float, float, FloatArray, float]]:
    """Return (u, v, area, second moments, eccentricity) of the regions of a mask that keep the limits."""
    rows, columns = picture.luma.shape
    n, labels, stats, centres = cv2.connectedComponentsWithStats(mask, connectivity=8, ltype=cv2.CV_16U)
    kept = []
    for i in range(1, n):
        x, y, w, h, area = (int(s) for s in stats[i])
        u0, v0 = origin_px[0] + x, origin_px[1] + y
        if u0 <= 0 or v0 <= 0 or u0 + w >= columns or v0 + h >= rows:
            continue
        if not limits.area_px2[0] <= area <= limits.area_px2[1]:
            continue
        if not limits.radius_px[0] <= 0.25 * (w + h) <= limits.radius_px[1]:
            continue
        m = cv2.moments((labels[y : y + h, x : x + w] == i).astype(np.uint8), binaryImage=True)
        M = np.array([[m["mu20"], m["mu11"]], [m["mu11"], m["mu02"]]]) / m["m00"]
        small, large = np.linalg.eigvalsh(M)
        eccentricity = float(np.sqrt(max(1 - small / max(large, 1e-12), 0.0)))
        if eccentricity <= limits.eccentricity_max:
            u, v = origin_px[0] + centres[i, 0], origin_px[1] + centres[i, 1]
            kept.append((float(u), float(v), float(area), M, eccentricity))
    return kept
