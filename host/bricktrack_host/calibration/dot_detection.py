"""Find the dots of a calibration target in a picture: sub-pixel centres with covariance, areas, flags.

The centre of a dot is the first moment of its light above the local background, each pixel's light divided
by what a fully lit pixel would show there (the plateau of this dot and its neighbours), so that uneven
light does not pull the centre. It is the centroid of the *image* of the disc;
`calibration.disc_bias` takes it to the image of the disc's centre once a lens model is at hand.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.errors import CalibrationError, ShapeError
from bricktrack_host.calibration.cut_dots import complete_cut_dot
from bricktrack_host.calibration.neighbours import Neighbours, median_spacing

GreyImage = NDArray[np.uint8]
Polarity = Literal["auto", "white-on-black", "black-on-white"]

MIN_AREA_PX2 = 20.0
"""A dot under 5 px across has no plateau, and noise looks like it."""
MIN_FILL_OF_ELLIPSE = 0.85
"""Least ratio of a dot's area to that of its moment ellipse's; a disc has 1, a square 0.95, a cross 0.6."""
MAX_AXIS_RATIO = 2.0
"""Longest to shortest axis: a target tilted by 60 degrees."""
MIN_CONTRAST_GREY = 12.0
"""Least step from background to plateau, grey levels."""
MIN_NOISE_GREY = 0.29
"""What rounding to whole grey levels makes alone."""
MIN_RELATIVE_CONTRAST = 0.15
"""A dot must show this share of the picture's strongest contrasts."""


@dataclass(frozen=True, slots=True, eq=False)
class Dots:
    """The dots of one picture, in no order.

    Attributes
    ----------
    uv_px : ndarray, shape (n, 2), px, image frame
        Centroid of the dot's image area.
    cov_px2 : ndarray, shape (n, 2, 2), px^2
        Of the centroid, from the noise seen in the picture.
    area_px2 : ndarray, shape (n,), px^2
        Zeroth moment of the normalised light.
    touches_border : ndarray of bool, shape (n,)
        The picture's border cuts the dot or its blurred rim: the moments are not those of the disc.
    is_completed : ndarray of bool, shape (n,)
        A cut dot's centre was found from its visible rim after all (`bricktrack_host.calibration.cut_dots`).
    polarity : "white-on-black" or "black-on-white"
    """

    uv_px: FloatArray
    cov_px2: FloatArray
    area_px2: FloatArray
    touches_border: BoolArray
    is_completed: BoolArray
    polarity: Polarity

    def __len__(self) -> int:
        return len(self.uv_px)

    def select(self, keep: BoolArray) -> "Dots":
        """Return the dots where ``keep`` is true."""
        return Dots(
            self.uv_px[keep],
            self.cov_px2[keep],
            self.area_px2[keep],
            self.touches_border[keep],
            self.is_completed[keep],
            self.polarity,
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Regions:
    """Compact foreground regions: label image, and for each region its label, box and half-level area."""

    labels: NDArray[np.int32]
    label: NDArray[np.int64]
    box: NDArray[np.int64]  # left, top, width, height
    area_px2: FloatArray


def detect_dots(grey: GreyImage, *, polarity: Polarity = "auto", keep_cut_dots: bool = False) -> Dots:
    """Find round dots and measure their centres.

    Parameters
    ----------
    grey : ndarray of uint8, shape (rows, columns)
    polarity : str, optional
        Which is the lighter; "auto" takes the one that yields clearly more dots.
    keep_cut_dots : bool, optional
        Return all dots at the border too, flagged by ``touches_border``; otherwise only those whose
        centre could be completed.

    Returns
    -------
    Dots

    Raises
    ------
    ShapeError
        If ``grey`` is not a two-dimensional array of uint8.
    CalibrationError
        If no dot is found, or as many light as dark ones.
    """
    if grey.ndim != 2 or grey.dtype != np.uint8:
        raise ShapeError(
            f"grey has shape {grey.shape} and type {grey.dtype}; expected (rows, columns) of uint8"
        )
    candidates: list[tuple[Polarity, NDArray[np.uint8], _Regions]] = []
    if polarity in ("auto", "white-on-black"):
        candidates.append(("white-on-black", grey, _round_regions(grey)))
    if polarity in ("auto", "black-on-white"):
        inverse = np.asarray(255 - grey, dtype=np.uint8)
        candidates.append(("black-on-white", inverse, _round_regions(inverse)))
    candidates.sort(key=lambda c: len(c[2].label), reverse=True)
    n_best = len(candidates[0][2].label)
    if n_best == 0:
        raise CalibrationError(
            f"no dots found: no round region of at least {MIN_AREA_PX2:g} px^2 with a contrast of "
            f"{MIN_CONTRAST_GREY:g} grey levels; check focus, exposure and that the target is in view"
        )
    if len(candidates) == 2:
        n_other = len(candidates[1][2].label)
        if n_best < 2 * n_other:
            raise CalibrationError(
                f"{n_best} {candidates[0][0]} and {n_other} {candidates[1][0]} round regions found: "
                "cannot tell which are the dots; give the polarity"
            )
    chosen, light, regions = candidates[0]
    dots = _measure(light, regions, chosen)
    return dots if keep_cut_dots else dots.select(~dots.touches_border | dots.is_completed)


def _round_regions(light: NDArray[np.uint8]) -> _Regions:
    """Return the compact, round regions brighter than halfway between local dark and local bright."""
    smooth = np.asarray(cv2.GaussianBlur(light, (0, 0), 1.0), dtype=np.uint8)
    threshold, has_contrast = _local_threshold(smooth)
    mask = ((smooth > threshold) & has_contrast).astype(np.uint8)
    n, found, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4, ltype=cv2.CV_32S)
    labels = np.asarray(found, dtype=np.int32)
    box = stats[:, :4].astype(np.int64)
    area = stats[:, cv2.CC_STAT_AREA].astype(np.float64)
    rows, columns = light.shape
    fits = (area >= MIN_AREA_PX2) & (box[:, 2] < columns / 4) & (box[:, 3] < rows / 4)
    fits[0] = False
    at_edge = (
        (box[:, 0] == 0)
        | (box[:, 1] == 0)
        | (box[:, 0] + box[:, 2] == columns)
        | (box[:, 1] + box[:, 3] == rows)
    )
    # Moments of the half-level regions, all at once: sums over the picture grouped by label.
    v, u = np.nonzero(fits[labels])
    group = labels[v, u]
    count = np.bincount(group, minlength=n).clip(1)

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(group, weights=values, minlength=n) / count)

    u_local = u - box[group, 0].astype(np.float64)
    v_local = v - box[group, 1].astype(np.float64)
    u_mean, v_mean = mean(u_local), mean(v_local)
    uu = mean(u_local * u_local) - u_mean**2 + 1 / 12  # a pixel is a square, not a point
    vv = mean(v_local * v_local) - v_mean**2 + 1 / 12
    uv = mean(u_local * v_local) - u_mean * v_mean
    half_trace, root = (uu + vv) / 2, np.hypot((uu - vv) / 2, uv)
    major, minor = half_trace + root, np.maximum(half_trace - root, 1e-9)
    fill = area / (4 * np.pi * np.sqrt(major * minor))
    is_round = (np.sqrt(major / minor) < MAX_AXIS_RATIO) & (fill > MIN_FILL_OF_ELLIPSE)
    keep = np.flatnonzero(fits & (is_round | at_edge))
    if not np.any(is_round & fits):
        keep = keep[:0]
    elif len(keep):
        # Specks of dust are round too: dots of one target differ by less than this across the picture.
        typical = (
            np.median(area[np.flatnonzero(fits & is_round & ~at_edge)])
            if np.any(fits & is_round & ~at_edge)
            else np.median(area[keep])
        )
        keep = keep[(area[keep] < 3 * typical) & ((area[keep] > typical / 3) | at_edge[keep])]
    return _Regions(labels, keep.astype(np.int64), box[keep], area[keep])


def _local_threshold(smooth: NDArray[np.uint8]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return, per pixel, the middle between the local dark and bright level, and where they differ."""
    tile = 8
    rows, columns = smooth.shape
    padded = cv2.copyMakeBorder(smooth, 0, -rows % tile, 0, -columns % tile, cv2.BORDER_REPLICATE)
    tiles = padded.reshape(padded.shape[0] // tile, tile, padded.shape[1] // tile, tile)
    low, high = tiles.min(axis=(1, 3)), tiles.max(axis=(1, 3))
    # A sixth of the picture's height holds several dots of any target worth fitting.
    reach = max(3, (rows // 6 // tile) | 1)
    kernel = np.ones((reach, reach), np.uint8)
    low = cv2.erode(low, kernel, borderType=cv2.BORDER_REPLICATE)
    high = cv2.dilate(high, kernel, borderType=cv2.BORDER_REPLICATE)
    size = (padded.shape[1], padded.shape[0])
    low_map = cv2.resize(cv2.blur(low.astype(np.float32), (reach, reach)), size)[:rows, :columns]
    high_map = cv2.resize(cv2.blur(high.astype(np.float32), (reach, reach)), size)[:rows, :columns]
    contrast = high_map - low_map
    strongest = float(np.percentile(contrast, 95))
    needed = max(MIN_CONTRAST_GREY, MIN_RELATIVE_CONTRAST * strongest)
    return (low_map + high_map) / 2, contrast >= needed


@dataclass(frozen=True, slots=True, eq=False)
class _Patch:
    """The surroundings of one dot: pixels of its window, and which belong to what."""

    origin_px: tuple[int, int]  # column and row of the window's first pixel
    light: FloatArray
    disc: BoolArray  # the dot with its blurred rim
    background_grey: float  # NaN where other dots leave none
    plateau_grey: float
    noise_grey: float


@dataclass(frozen=True, slots=True, eq=False)
class _Moments:
    """Light-weighted moments of one dot about a given point (0th to 2nd), and the blur of its rim."""

    shift_px: FloatArray
    cov_px2: FloatArray
    area_px2: float
    blur_px: float
    spread_px2: FloatArray


def _measure(light: NDArray[np.uint8], regions: _Regions, polarity: Polarity) -> Dots:
    """Return the light-weighted centroids of the regions."""
    n = len(regions.label)
    rows, columns = light.shape
    left, top, width, height = regions.box.T
    middle = np.stack([left + (width - 1) / 2, top + (height - 1) / 2], axis=1)
    to_border = np.minimum.reduce([left, top, columns - left - width, rows - top - height])
    radius = float(np.sqrt(np.median(regions.area_px2) / np.pi))
    gap = (median_spacing(middle) if n > 1 else 4 * radius) - 2 * radius
    widest = max(2, int(0.35 * gap))

    # The rim reaches as far as the blur; how far that is, some of the dots tell.
    whole = np.flatnonzero(to_border > 0)
    some = [int(i) for i in whole[:: max(1, len(whole) // 50)]]
    blur = np.nanmedian(
        [_moments(_patch(light, regions, i, widest), middle[i]).blur_px for i in some] or [1.0]
    )
    reach = int(np.clip(np.ceil(2.5 * blur), 2, widest))

    patches = [_patch(light, regions, i, reach) for i in range(n)]
    levels = np.array([[p.background_grey, p.plateau_grey] for p in patches])
    known = np.isfinite(levels[:, 0])
    if not known.any():
        raise CalibrationError(
            "no dot has free background around it: the dots touch each other; use smaller dots or focus"
        )
    nearest_known = np.flatnonzero(known)[Neighbours(middle[known]).nearest(middle, 1)[1][:, 0]]
    levels[:, 0] = levels[nearest_known, 0]
    # The light of a cut dot is no guide to its neighbours': its plateau may be nothing but rim.
    slopes = _level_slopes(middle, levels, trusted=to_border > 0)
    moments = [_moments(p, m, lv, sl) for p, m, lv, sl in zip(patches, middle, levels, slopes, strict=True)]
    uv = middle + np.array([m.shift_px for m in moments])
    area = np.array([m.area_px2 for m in moments])
    good = (area > MIN_AREA_PX2) & np.all(np.isfinite(uv), axis=1)
    good &= (levels[:, 1] - levels[:, 0]) >= MIN_CONTRAST_GREY
    # With the rim cut at two sigma the centroid moves by some thousandths of a pixel only.
    touches = to_border < np.ceil(2 * blur)
    cov = np.array([m.cov_px2 for m in moments])
    completed = np.zeros(n, dtype=np.bool_)
    whole = np.flatnonzero(good & ~touches)
    if len(whole) >= 3:
        guides = whole[Neighbours(middle[whole]).nearest(middle, 3)[1]]
        for i in np.flatnonzero(good & touches):
            near = guides[i]
            spread = np.mean([moments[k].spread_px2 for k in near], axis=0)
            away = middle[i] - middle[near[0]]
            dot = complete_cut_dot(
                *_normalised(
                    patches[i], middle[i], levels[near[0]] + slopes[near[0]] @ away, slopes[near[0]]
                ),
                box_px=(left[i], top[i], left[i] + width[i] - 1, top[i] + height[i] - 1),
                shape_px2=4 * (spread - blur**2 * np.eye(2)),
                blur_px=float(blur),
                noise=max(patches[near[0]].noise_grey, MIN_NOISE_GREY) / float(np.ptp(levels[near[0]])),
                size_px=(columns, rows),
            )
            if dot is not None:
                uv[i], cov[i], area[i], completed[i] = dot.uv_px, dot.cov_px2, area[near].mean(), True
    return Dots(uv[good], cov[good], area[good], touches[good], completed[good], polarity)


def _patch(light: NDArray[np.uint8], regions: _Regions, i: int, reach: int) -> _Patch:
    """Cut out a region with its rim of ``reach`` pixels and the background beyond."""
    rows, columns = light.shape
    left, top, width, height = (int(x) for x in regions.box[i])
    margin = reach + max(2, reach // 2)
    window = (
        slice(max(top - margin, 0), min(top + height + margin, rows)),
        slice(max(left - margin, 0), min(left + width + margin, columns)),
    )
    own = (regions.labels[window] == regions.label[i]).astype(np.uint8)
    others = ((regions.labels[window] > 0) & (own == 0)).astype(np.uint8)
    disc = cv2.dilate(own, _ellipse(reach)) > 0
    around = (cv2.dilate(own, _ellipse(margin)) > 0) & ~disc & (cv2.dilate(others, _ellipse(reach)) == 0)
    radius = float(np.sqrt(regions.area_px2[i] / np.pi))
    core = cv2.erode(own, _ellipse(min(reach, max(1, int(radius / 2)))), borderValue=0) > 0
    if not core.any():
        core = own > 0
    patch = light[window].astype(np.float64)
    free = np.count_nonzero(around) >= 8
    return _Patch(
        origin_px=(window[1].start, window[0].start),
        light=patch,
        disc=np.asarray(disc),
        background_grey=float(patch[around].mean()) if free else np.nan,
        plateau_grey=float(patch[core].mean()),
        noise_grey=float(patch[around].std()) if free else float(patch[core].std()),
    )


@lru_cache(maxsize=128)
def _ellipse(radius: int) -> NDArray[np.uint8]:
    """Return a disc as structuring element."""
    size = 2 * radius + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), dtype=np.uint8)


def _moments(
    patch: _Patch, about_px: FloatArray, levels: FloatArray | None = None, slopes: FloatArray | None = None
) -> _Moments:
    """Return the moments of the light between background (0) and plateau (1), about a point.

    ``levels`` are background and plateau there, ``slopes`` their gradients (level, axis) in grey/px; the
    patch's own and none where not given.
    """
    if levels is None or slopes is None:
        levels, slopes = np.array([patch.background_grey, patch.plateau_grey]), np.zeros((2, 2))
    uv, weight = _normalised(patch, about_px, levels, slopes)
    d_uv = uv - about_px[:, None]
    step = float(np.ptp(levels))
    total = float(weight.sum())
    if not total > 0:
        return _Moments(np.full(2, np.nan), np.full((2, 2), np.nan), 0.0, np.nan, np.full((2, 2), np.nan))
    shift = d_uv @ weight / total
    d_uv -= shift[:, None]
    lever = d_uv * (max(patch.noise_grey, MIN_NOISE_GREY) / step)
    # Across an edge blurred by a Gaussian, weight (1 - weight) integrates to sigma / sqrt(pi).
    blur = float((weight * (1 - weight)).sum()) * np.sqrt(np.pi) / (2 * np.sqrt(np.pi * total))
    return _Moments(shift, lever @ lever.T / total**2, total, blur, (weight * d_uv) @ d_uv.T / total)


def _normalised(
    patch: _Patch, about_px: FloatArray, levels: FloatArray, slopes: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the pixels of the dot and its rim, (2, n), and their light from background 0 to plateau 1.

    ``levels`` are background and plateau at ``about_px``, ``slopes`` their gradients (level, axis), grey/px.
    """
    v, u = np.nonzero(patch.disc)
    uv = np.stack([u + patch.origin_px[0], v + patch.origin_px[1]]).astype(np.float64)
    d_uv = uv - about_px[:, None]
    dark = levels[0] + slopes[0] @ d_uv
    step = np.maximum(levels[1] + slopes[1] @ d_uv - dark, MIN_CONTRAST_GREY / 2)
    return uv, (patch.light[patch.disc] - dark) / step


def _level_slopes(centre: FloatArray, levels: FloatArray, *, trusted: BoolArray) -> FloatArray:
    """Return the slopes (n, level, axis), grey/px, of background and plateau, from each dot's neighbours."""
    slopes = np.zeros((len(centre), levels.shape[1], 2))
    k = min(9, int(np.count_nonzero(trusted)))
    if k < 5:
        return slopes
    sources = np.flatnonzero(trusted)
    near = sources[Neighbours(centre[sources]).nearest(centre, k)[1]]
    d_uv = centre[near] - centre[near].mean(axis=1, keepdims=True)
    d_level = levels[near] - np.median(levels[near], axis=1, keepdims=True)
    d_level -= d_level.mean(axis=1, keepdims=True)
    normal = np.einsum("nki,nkj->nij", d_uv, d_uv)
    right = np.einsum("nki,nkl->nil", d_uv, d_level)
    scale = np.trace(normal, axis1=1, axis2=2)
    solvable = np.linalg.det(normal) > 1e-3 * scale**2
    slopes[solvable] = np.swapaxes(np.linalg.solve(normal[solvable], right[solvable]), 1, 2)
    return slopes
