"""From picture files of a target at known depths to each plane's dots, in one set of millimetres."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from bricktrack_common.camera_model import SensorMode
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dots.dot_detection import Dots, GreyImage, Polarity, detect_dots
from bricktrack_host.calibration.dots.dot_grid import GridOrigin, assign_coded_grid, assign_grid
from bricktrack_host.calibration.dots.dot_observations import DotObservations, in_picture_axes
from bricktrack_host.calibration.dots.merged_boards import MergedBoards, merge_boards
from bricktrack_host.calibration.target.printed_target import DotTarget


@dataclass(frozen=True, slots=True, eq=False)
class PlanePicture:
    """A picture and what was found in it.

    Attributes
    ----------
    z_mm : float, mm
    path : Path
    sha256 : str
        Of the file.
    size_px : (int, int), px
        Width and height.
    dots : Dots
        All that look like dots.
    placed : DotObservations
        Those that have a place on the target.
    """

    z_mm: float
    path: Path
    sha256: str
    size_px: tuple[int, int]
    dots: Dots
    placed: DotObservations


def read_grey(path: Path) -> tuple[GreyImage, str]:
    """Return a picture's grey levels, 8 or 16 bits, and the SHA-256 of its file.

    Raises
    ------
    CalibrationError
        If the file cannot be read or is not a picture.
    """
    try:
        data = path.read_bytes()
    except OSError as e:
        raise CalibrationError(f"{path}: {e.strerror or e}") from e
    grey = (
        cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
        if data
        else None
    )
    if grey is None:
        raise CalibrationError(f"{path}: not a picture that can be read; expected PNG, JPEG or TIFF")
    digest = hashlib.sha256(data).hexdigest()
    if grey.dtype == np.uint16:
        return np.asarray(grey, dtype=np.uint16), digest
    if grey.dtype != np.uint8:
        raise CalibrationError(f"{path}: {grey.dtype} grey levels; expected 8 or 16 bits")
    return np.asarray(grey, dtype=np.uint8), digest


def place_dots(
    grey: GreyImage,
    target: DotTarget,
    *,
    origin: GridOrigin | None = None,
    polarity: Polarity | None = None,
) -> tuple[Dots, DotObservations]:
    """Find a target's dots in a picture, and each one's place on the target.

    Parameters
    ----------
    grey : ndarray of uint8 or uint16, shape (rows, columns)
    target : DotTarget
    origin : GridOrigin, optional
        Of a plain target; a coded one tells its own.
    polarity : "auto", "white-on-black" or "black-on-white", optional
        The target's where not given.

    Raises
    ------
    CalibrationError
        If no dots are found or their places leave a doubt.
    """
    dots = detect_dots(grey, polarity=polarity or target.polarity)
    if target.coded:
        return dots, assign_coded_grid(dots, target)
    return dots, assign_grid(
        dots, pitch_mm=target.pitch_mm, columns=target.columns, rows=target.rows, origin=origin
    )


def observe_pictures(
    pictures: Sequence[tuple[float, Path]],
    target: DotTarget,
    *,
    origin: GridOrigin | None = None,
    polarity: Polarity | None = None,
    mode: SensorMode | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> tuple[PlanePicture, ...]:
    """Measure pictures of a target; the first of each depth in the same axes, x to within 45 degrees of +u.

    Parameters
    ----------
    pictures : sequence of (float, Path)
        Depth, mm, and file.
    target : DotTarget
    origin : GridOrigin, optional
        Of a plain target.
    polarity : "auto", "white-on-black" or "black-on-white", optional
        The target's where not given.
    mode : SensorMode, optional
        Pictures of another size are refused.
    progress : callable, optional
        Told how many pictures are done, of how many.

    Raises
    ------
    CalibrationError
        Naming the file that cannot be read, shows no target, or leaves a doubt.
    """
    found = []
    for i, (z_mm, path) in enumerate(pictures):
        grey, sha256 = read_grey(path)
        height, width = grey.shape
        if mode is not None and (mode.width, mode.height) != (width, height):
            raise CalibrationError(
                f"{path}: {width} x {height} px; sensor mode {mode.name!r} delivers {mode.width} x "
                f"{mode.height}. Say which mode it is with --sensor-mode"
            )
        try:
            dots, placed = place_dots(grey, target, origin=origin, polarity=polarity)
        except CalibrationError as e:
            raise CalibrationError(f"{path}: {e}") from e
        found.append(PlanePicture(z_mm, path, sha256, (width, height), dots, placed))
        progress(i + 1, len(pictures))
    if target.coded:
        # Further pictures of a depth may be turned at will: merging finds how.
        first = {f.z_mm: i for i, f in reversed(list(enumerate(found)))}
        turned = in_picture_axes([found[i].placed for i in first.values()])
        for i, placed in zip(first.values(), turned, strict=True):
            found[i] = replace(found[i], placed=placed)
    return tuple(found)


def merged_planes(pictures: Sequence[PlanePicture]) -> list[tuple[float, MergedBoards]]:
    """Return one set of dots for each depth, nearest first; several pictures of a depth are merged.

    Raises
    ------
    CalibrationError
        If pictures of one depth do not overlap, or disagree.
    """
    merged = []
    for z_mm in sorted({p.z_mm for p in pictures}):
        try:
            merged.append((z_mm, merge_boards([p.placed for p in pictures if p.z_mm == z_mm])))
        except CalibrationError as e:
            raise CalibrationError(f"the pictures at {z_mm:g} mm: {e}") from e
    return merged


def n_left_out(picture: PlanePicture, used: Sequence[tuple[float, DotObservations]]) -> int:
    """Return how many of a picture's placed dots a fit has not used.

    Parameters
    ----------
    picture : PlanePicture
    used : sequence of (float, DotObservations)
        The dots of each plane that the fit used; moved by less than half a pixel (the discs' correction).
    """
    kept = dict(used)[picture.z_mm]
    same_place = np.all(kept.column_row[None] == picture.placed.column_row[:, None], axis=2)
    near = np.hypot(*np.moveaxis(kept.uv_px[None] - picture.placed.uv_px[:, None], -1, 0)) < 0.5
    return int(np.count_nonzero(~np.any(same_place & near, axis=1)))
