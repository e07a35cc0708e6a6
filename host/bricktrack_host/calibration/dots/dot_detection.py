"""Find the dots of a calibration target in a picture: sub-pixel centres with covariance, areas, flags.

The centre of a dot is the first moment of its light above the local background, each pixel's light divided
by what a fully lit pixel would show there (the plateau of this dot and its neighbours), so that uneven
light does not pull the centre. It is the centroid of the *image* of the disc;
`calibration.dots.disc_bias` takes it to the image of the disc's centre once a lens model is at hand.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import BoolArray, FloatArray, rows_of
from bricktrack_common.errors import CalibrationError, ShapeError
from bricktrack_host.calibration.dots.cut_dots import CompletedDot, complete_cut_dot
from bricktrack_host.calibration.dots.dot_regions import (
    MIN_AREA_PX2,
    MIN_CONTRAST_GREY,
    Light,
    Regions,
    round_regions,
)
from bricktrack_host.calibration.dots.dot_sizes import LARGE_AREA_RATIO, area_ratios, have_odd_shapes
from bricktrack_host.calibration.dots.neighbours import Neighbours, median_spacing

GreyImage = NDArray[np.uint8] | NDArray[np.uint16]
"""8 bits, or 16 bits full scale: the mean of several pictures."""
Polarity = Literal["auto", "white-on-black", "black-on-white"]

MIN_NOISE_GREY = 0.29
"""What rounding to whole grey levels makes alone."""


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
        A cut dot's centre was found from its visible rim after all (see `.cut_dots`).
    polarity : "white-on-black" or "black-on-white"
    blur_px : ndarray, shape (n,), px
        Standard deviation of the rim's blur; NaN where the border cuts the dot.
    light_grey, dark_grey : ndarray, shape (n,), grey levels of 255
        The lighter and the darker of the dot's plateau and its surroundings.
    """

    uv_px: FloatArray
    cov_px2: FloatArray
    area_px2: FloatArray
    touches_border: BoolArray
    is_completed: BoolArray
    polarity: Polarity
    blur_px: FloatArray
    light_grey: FloatArray
    dark_grey: FloatArray

    def __len__(self) -> int:
        return len(self.uv_px)

    def select(self, keep: BoolArray) -> "Dots":
        """Return the dots where ``keep`` is true."""
        return rows_of(self, keep)


def detect_dots(grey: GreyImage, *, polarity: Polarity = "auto", keep_cut_dots: bool = False) -> Dots:
    """Find round dots and measure their centres.

    Parameters
    ----------
    grey : ndarray of uint8 or uint16, shape (rows, columns)
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
        If ``grey`` is not a two-dimensional array of uint8 or uint16.
    CalibrationError
        If no dot is found, or as many light as dark ones.
    """
    if grey.ndim != 2 or grey.dtype not in (np.uint8, np.uint16):
        raise ShapeError(
            f"grey has shape {grey.shape} and type {grey.dtype}; expected (rows, columns) of uint8 or uint16"
        )
    light = grey.astype(np.float32)
    if grey.dtype == np.uint16:
        light *= np.float32(255 / 65535)
    candidates: list[tuple[Polarity, Light, Regions]] = []
    if polarity in ("auto", "white-on-black"):
        candidates.append(("white-on-black", light, round_regions(light)))
    if polarity in ("auto", "black-on-white"):
        inverse = np.float32(255) - light
        candidates.append(("black-on-white", inverse, round_regions(inverse)))
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


def _measure(light: Light, regions: Regions, polarity: Polarity) -> Dots:
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
    blurs = np.array([m.blur_px for m in moments])
    blurs[touches] = np.nan
    whole = np.flatnonzero(good & ~touches)
    if len(whole) >= 3:
        ratio = area_ratios(uv[whole], area[whole])
        # Shapes of the small dots: what a large one would be at its place.
        shrink = np.where(ratio > np.sqrt(LARGE_AREA_RATIO), LARGE_AREA_RATIO, 1.0)
        spread = np.array([moments[k].spread_px2 for k in whole])
        # Blur adds its square to a disc's second moments, whatever its size.
        shape = 4 * (spread - blur**2 * np.eye(2)) / shrink[:, None, None]
        odd = have_odd_shapes(uv[whole], shape)
        good[whole[odd]] = False
        whole, shape, shrink = whole[~odd], shape[~odd], shrink[~odd]
        sizes = (1.0, LARGE_AREA_RATIO) if np.any(shrink > 1) else (1.0,)
        near = Neighbours(middle[whole]).nearest(middle, 3)[1]
        for i in np.flatnonzero(good & touches):
            k = whole[near[i, 0]]
            uv_light = _normalised(
                patches[i], middle[i], levels[k] + slopes[k] @ (middle[i] - middle[k]), slopes[k]
            )
            fits = [
                complete_cut_dot(
                    *uv_light,
                    box_px=(left[i], top[i], left[i] + width[i] - 1, top[i] + height[i] - 1),
                    shape_px2=size * shape[near[i]].mean(axis=0),
                    blur_px=float(blur),
                    noise=max(patches[k].noise_grey, MIN_NOISE_GREY) / float(np.ptp(levels[k])),
                    size_px=(columns, rows),
                )
                for size in sizes
            ]
            found: list[CompletedDot] = [dot for dot in fits if dot is not None]
            if found:
                dot = min(found, key=lambda f: f.rms)
                uv[i], cov[i], completed[i] = dot.uv_px, dot.cov_px2, True
                area[i] = np.pi * np.sqrt(np.linalg.det(dot.shape_px2))
    ends = levels if polarity == "white-on-black" else 255 - levels[:, ::-1]
    return Dots(
        uv[good],
        cov[good],
        area[good],
        touches[good],
        completed[good],
        polarity,
        blurs[good],
        ends[good, 1],
        ends[good, 0],
    )


def _patch(light: Light, regions: Regions, i: int, reach: int) -> _Patch:
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
