"""The dot target as it is printed: which dots stand where, which of them are large, and its file.

A plain grid looks the same from every dot. On a *coded* target every fourth dot, in a fixed irregular order,
is larger: any few dozen dots tell which part of the target they are and how it is turned, so that no single
mark has to be in view.
"""

from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.errors import CalibrationError
from bricktrack_common.typed_data import load_toml

LARGE_RATIO = 1.4
"""Diameter of a large dot to that of the others: twice the area, which blur and slant do not confuse."""
MAX_SHARE_OF_PITCH = 0.8
"""Largest share of the pitch that a dot's diameter may take: gaps must stay for the background."""

_Positive = Annotated[float, msgspec.Meta(gt=0)]
_Count = Annotated[int, msgspec.Meta(ge=2, le=400)]


class DotTarget(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A square grid of dots.

    Attributes
    ----------
    columns, rows : int
        Of the whole target.
    pitch_mm : float, mm
        Distance of neighbouring dots.
    diameter_mm : float, mm
        Of the dots; of the small ones where it is coded.
    polarity : "white-on-black" or "black-on-white"
    coded : bool
        Whether large dots tell the place.
    """

    columns: _Count
    rows: _Count
    pitch_mm: _Positive
    diameter_mm: _Positive
    polarity: Literal["white-on-black", "black-on-white"] = "white-on-black"
    coded: bool = True

    @property
    def largest_diameter_mm(self) -> float:
        """Diameter of the largest dots."""
        return self.diameter_mm * (LARGE_RATIO if self.coded else 1.0)

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height from the outermost dots' centres, with one pitch of background around them."""
        return (self.columns + 1) * self.pitch_mm, (self.rows + 1) * self.pitch_mm

    def large_dots(self) -> BoolArray:
        """Return which dots are large, shape (rows, columns)."""
        if not self.coded:
            return np.zeros((self.rows, self.columns), dtype=np.bool_)
        i = np.arange(self.columns) - self.columns // 2
        j = np.arange(self.rows) - self.rows // 2
        return code_is_large(i[None, :], j[:, None])

    def centres_mm(self) -> FloatArray:
        """Return the dots' centres, shape (rows, columns, 2): x to the right, y down, 0 in the middle."""
        x = (np.arange(self.columns) - (self.columns - 1) / 2) * self.pitch_mm
        y = (np.arange(self.rows) - (self.rows - 1) / 2) * self.pitch_mm
        return np.stack(np.meshgrid(x, y), axis=-1)

    def diameters_mm(self) -> FloatArray:
        """Return the dots' diameters, shape (rows, columns)."""
        return self.diameter_mm * np.where(self.large_dots(), LARGE_RATIO, 1.0)


def check_target(target: DotTarget) -> None:
    """Refuse a target whose dots leave no background between them.

    Raises
    ------
    CalibrationError
    """
    most = MAX_SHARE_OF_PITCH * target.pitch_mm
    if target.largest_diameter_mm > most:
        factor = LARGE_RATIO if target.coded else 1.0
        raise CalibrationError(
            f"dots of {target.largest_diameter_mm:g} mm at a pitch of {target.pitch_mm:g} mm leave too "
            f"little between them; expected a diameter of at most {most / factor:g} mm"
            + (f" (large dots are {LARGE_RATIO:g} times that)" if target.coded else "")
        )


def code_is_large(i: IntArray, j: IntArray) -> BoolArray:
    """Tell which dots of the endless code plane are large.

    Parameters
    ----------
    i, j : ndarray of int, broadcast against each other
        Columns to the right and rows below the code's origin.

    Notes
    -----
    A multiply-and-shift hash of both numbers, a quarter of which counts. A target is a window of this plane
    about its origin, so that a larger target continues a smaller one.

    Examples
    --------
    >>> "".join("O" if large else "." for large in code_is_large(np.arange(24), np.zeros(24, dtype=int)))
    '..O......O.............O'
    """
    mask = np.uint64(0xFFFFFFFF)
    x = np.asarray(i, dtype=np.int64).astype(np.uint64) & mask
    y = np.asarray(j, dtype=np.int64).astype(np.uint64) & mask
    h = ((x * np.uint64(0x9E3779B1)) & mask) ^ ((y * np.uint64(0x85EBCA77) + np.uint64(0x165667B1)) & mask)
    for shift, factor in ((15, 0x2C1B3C6D), (12, 0x297A2D39)):
        h = ((h ^ (h >> np.uint64(shift))) * np.uint64(factor)) & mask
    h = h ^ (h >> np.uint64(15))
    return np.asarray((h & np.uint64(3)) == 0)


class _TargetFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    target: DotTarget


def load_target(path: Path) -> DotTarget:
    """Read a target file: TOML with a ``[target]`` table.

    Raises
    ------
    ConfigError
        If the file is missing or holds anything else.
    CalibrationError
        If the dots leave no background between them.
    """
    target = load_toml(path, _TargetFile).target
    check_target(target)
    return target


def target_toml(target: DotTarget) -> str:
    """Return a target as the text of its file."""
    return (
        "[target]\n"
        f"columns = {target.columns}\nrows = {target.rows}\n"
        f"pitch_mm = {target.pitch_mm!r}\ndiameter_mm = {target.diameter_mm!r}\n"
        f'polarity = "{target.polarity}"\ncoded = {str(target.coded).lower()}\n'
    )
