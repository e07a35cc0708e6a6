"""Is a picture of a target good enough to calibrate from? Coverage, sharpness, exposure, tilt, in words."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import FloatArray
from bricktrack_host.calibration.dots.board_pose import BoardPose, board_pose
from bricktrack_host.calibration.dots.dot_detection import GreyImage
from bricktrack_host.calibration.dots.neighbours import Neighbours, median_spacing
from bricktrack_host.calibration.dots.picture_region import ConvexRegion
from bricktrack_host.calibration.dots.plane_pictures import PlanePicture

MIN_COVERED = 0.8
"""Whole dots that fill the picture surround some 85 % of it: up to a pitch is lost all round."""
MAX_BLUR_OF_RADIUS = 0.25
"""Blur of a rim, standard deviation, in radii of the dot: beyond, the dot has no plateau."""
UNEVEN_BLUR = 1.6
"""Blur on one side of the picture by that on the other."""
SATURATED = 0.98
FAINT, DIM = 0.25, 0.4
"""Least contrast of a dot, and usual light of the dots, shares of full light."""
UNEVEN_LIGHT = 3.0
MAX_TILT_DEG = 0.3
"""At 60 mm from the axis 0.3 degrees are 0.3 mm of depth."""
MAX_TURN_DEG = 2.0

_SIDES = (("left", 0, -1), ("right", 0, 1), ("top", 1, -1), ("bottom", 1, 1))
_COMPASS = ("right", "bottom right", "bottom", "bottom left", "left", "top left", "top", "top right")
Colour = tuple[int, int, int]
_PLACED, _LARGE, _NO_PLACE, _REGION = (80, 220, 80), (60, 200, 255), (60, 60, 255), (255, 180, 60)


@dataclass(frozen=True, slots=True)
class PictureCheck:
    """What is good and what is not about a picture.

    Attributes
    ----------
    n_dots, n_placed : int
        Found, and with a place on the target.
    covered : float
        Share of the picture among the dots placed.
    blur_px, radius_px : float, px
        Of the usual dot's rim, standard deviation; of the usual dot.
    light, contrast : float
        Of the usual dot, shares of full light.
    saturated : float
        Share of dots at full light.
    pose : BoardPose
    warnings : tuple of str
        What to do better.
    """

    n_dots: int
    n_placed: int
    covered: float
    blur_px: float
    radius_px: float
    light: float
    contrast: float
    saturated: float
    pose: BoardPose
    warnings: tuple[str, ...]


def check_picture(picture: PlanePicture, *, white_grey: float = 255.0) -> PictureCheck:
    """Judge a picture of a target.

    Parameters
    ----------
    picture : PlanePicture
    white_grey : float, grey levels of 255
        What full light gives: 235 for a camera's luma.

    Raises
    ------
    CalibrationError
        If the dots span no area or no pose of the board fits.
    """
    dots, placed = picture.dots, picture.placed
    pose = board_pose(placed, z_mm=picture.z_mm, size_px=picture.size_px)
    covered = _share_covered(placed.uv_px, picture.size_px)
    light = dots.light_grey / white_grey
    contrast = (dots.light_grey - dots.dark_grey) / white_grey
    radius = float(np.sqrt(np.median(dots.area_px2) / np.pi))
    blur = float(np.nanmedian(dots.blur_px))
    saturated = float(np.mean(light >= SATURATED))
    warnings = (
        *_coverage_warnings(placed.uv_px, picture.size_px, covered),
        *_sharpness_warnings(dots.uv_px, dots.blur_px, blur, radius, picture.size_px),
        *_light_warnings(light, contrast, saturated),
        *_pose_warnings(pose),
    )
    return PictureCheck(
        n_dots=len(dots),
        n_placed=len(placed),
        covered=covered,
        blur_px=blur,
        radius_px=radius,
        light=float(np.median(light)),
        contrast=float(np.median(contrast)),
        saturated=saturated,
        pose=pose,
        warnings=warnings,
    )


def _share_covered(uv_px: FloatArray, size_px: tuple[int, int]) -> float:
    region = ConvexRegion.around(uv_px)
    u, v = np.meshgrid(*((np.arange(n) + 0.5) / n * size for n, size in zip((96, 54), size_px, strict=True)))
    return float(np.mean(region.contains(np.stack([u, v], axis=-1) - 0.5)))


def _coverage_warnings(uv_px: FloatArray, size_px: tuple[int, int], covered: float) -> list[str]:
    if covered >= MIN_COVERED:
        return []
    step = median_spacing(uv_px)
    bare = []
    for name, axis, sign in _SIDES:
        ends = uv_px[:, axis].max() if sign > 0 else uv_px[:, axis].min()
        gap = size_px[axis] - 1 - ends if sign > 0 else ends
        if gap > 1.5 * step:
            bare.append(f"{gap:.0f} px at the {name}")
    where = f" ({', '.join(bare)} without dots)" if bare else ""
    return [
        f"dots surround {100 * covered:.0f} % of the picture{where}: rays beyond are extrapolated. Take a "
        "larger "
        "target, or add pictures with it shifted"
    ]


def _sharpness_warnings(
    uv_px: FloatArray, blur_px: FloatArray, blur: float, radius: float, size_px: tuple[int, int]
) -> list[str]:
    if blur > MAX_BLUR_OF_RADIUS * radius:
        return [
            f"out of focus: rims are blurred by {blur:.1f} px (standard deviation), dots are "
            f"{2 * radius:.0f} px across; focus, or print larger dots"
        ]
    for name, axis, sign in _SIDES:
        side = sign * (uv_px[:, axis] - size_px[axis] / 2) > size_px[axis] / 4
        other = sign * (uv_px[:, axis] - size_px[axis] / 2) < -size_px[axis] / 4
        if min(np.isfinite(blur_px[side]).sum(), np.isfinite(blur_px[other]).sum()) < 10:
            continue
        here, there = float(np.nanmedian(blur_px[side])), float(np.nanmedian(blur_px[other]))
        if here > UNEVEN_BLUR * there and here > 0.15 * radius:
            return [
                f"less sharp at the {name}: {here:.1f} px of blur against {there:.1f} px opposite; is the "
                "board tilted, or the lens?"
            ]
    return []


def _light_warnings(light: FloatArray, contrast: FloatArray, saturated: float) -> list[str]:
    words = []
    if saturated > 0.02:
        words.append(
            f"{100 * saturated:.0f} % of the dots are at full light: rims seem wider than they are. Expose "
            "for less"
        )
    if np.median(light) < DIM:
        words.append(
            f"dim: dots reach {100 * np.median(light):.0f} % of full light; 50 to 90 % is best. Expose for "
            "more"
        )
    elif np.percentile(contrast, 2) < FAINT:
        words.append(
            f"faint: some dots stand out by {100 * np.percentile(contrast, 2):.0f} % of full light only; "
            "light the "
            "target evenly and without glare"
        )
    low, high = np.percentile(light, [2, 98])
    if high > UNEVEN_LIGHT * low:
        words.append(f"uneven light: {high / low:.1f} times as much in one place as in another")
    return words


def _pose_warnings(pose: BoardPose) -> list[str]:
    words = []
    if pose.tilt_deg - 2 * pose.tilt_sd_deg > MAX_TILT_DEG:
        towards = _COMPASS[round(pose.recedes_deg / 45) % 8]
        words.append(
            f"the board is tilted by {pose.tilt_deg:.1f} degrees: its {towards} is farther away. Set it "
            "square"
        )
    turn = (pose.turn_deg + 45) % 90 - 45
    if abs(turn) > MAX_TURN_DEG:
        words.append(
            f"the board is turned by {turn:.1f} degrees: the camera's axes will follow the board's edges"
        )
    return words


def drawn_over(grey: GreyImage, picture: PlanePicture) -> NDArray[np.uint8]:
    """Return a picture in colour (BGR) with what was found drawn over it.

    Green circles are dots with a place, orange ones large dots, red ones dots without; the line encloses the
    covered region, and arrows show the target's x (red) and y (green) where its origin is in view.
    """
    eight = (grey // 257).astype(np.uint8) if grey.dtype == np.uint16 else grey.astype(np.uint8)
    canvas = np.asarray(cv2.cvtColor(eight, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    placed, dots = picture.placed, picture.dots
    size = np.broadcast_to(np.asarray(placed.size, dtype=np.float64), len(placed))
    nearest = Neighbours(placed.uv_px).nearest(dots.uv_px, 1)[0][:, 0]
    radii = 1.25 * np.sqrt(dots.area_px2 / np.pi)
    for uv, radius in zip(dots.uv_px[nearest > 1], radii[nearest > 1], strict=True):
        _ring(canvas, uv, float(radius), _NO_PLACE)
    for uv, area, s in zip(placed.uv_px, placed.area_px2, size, strict=True):
        _ring(canvas, uv, 1.25 * float(np.sqrt(area / np.pi)), _LARGE if s > 1 else _PLACED)
    corners = np.rint(ConvexRegion.around(placed.uv_px).vertices_px).astype(np.int32)
    cv2.polylines(canvas, [corners], True, _REGION, 2, cv2.LINE_AA)
    near_origin = Neighbours(placed.xy_mm).nearest(np.zeros((1, 2)), min(12, len(placed)))
    if near_origin[0][0, 0] < 2 * median_spacing(placed.xy_mm):
        k = near_origin[1][0]
        A, *_ = np.linalg.lstsq(np.column_stack([np.ones(len(k)), placed.xy_mm[k]]), placed.uv_px[k])
        for axis, colour in ((1, (40, 40, 255)), (2, (40, 255, 40))):
            along = A[axis] * 3 * median_spacing(placed.xy_mm)
            start, end = (tuple(int(x) for x in np.rint(p)) for p in (A[0], A[0] + along))
            cv2.arrowedLine(canvas, start, end, colour, 3, cv2.LINE_AA, tipLength=0.2)
    return canvas


def _ring(canvas: NDArray[np.uint8], uv: FloatArray, radius: float, colour: Colour) -> None:
    centre = (int(np.rint(16 * uv[0])), int(np.rint(16 * uv[1])))
    cv2.circle(canvas, centre, int(np.rint(16 * radius)), colour, 2, cv2.LINE_AA, shift=4)
