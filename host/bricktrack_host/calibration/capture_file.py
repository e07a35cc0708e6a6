"""The file ``capture.toml`` of a folder of target pictures: what is needed to calibrate from them."""

from datetime import datetime
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from bricktrack_common.camera_model import SensorMode
from bricktrack_common.errors import CalibrationError
from bricktrack_common.typed_data import load_toml
from bricktrack_host.calibration.target.printed_target import DotTarget, check_target

CAPTURE_FILE = "capture.toml"
VERSION = 1


class CapturedPicture(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One picture of the target.

    Attributes
    ----------
    z_mm : float, mm
        Depth of the target's plane, camera frame.
    file : str
        Name in the same folder.
    sha256 : str
    n_averaged : int
        Pictures that this is the mean of.
    taken_utc : datetime
    white_grey : float
        What full light gives, of 255: 235 for a camera's luma.
    exposure_us, analogue_gain : int, float or None
    source : str
        The unit's camera, or the files that it was made from.
    """

    z_mm: Annotated[float, msgspec.Meta(gt=0)]
    file: Annotated[str, msgspec.Meta(pattern=r"^[^/\\]+$")]
    sha256: str
    n_averaged: Annotated[int, msgspec.Meta(ge=1)]
    taken_utc: datetime
    white_grey: float = 255.0
    exposure_us: int | None = None
    analogue_gain: float | None = None
    source: str = ""


class Capture(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Pictures of one target by one camera in one mode.

    Attributes
    ----------
    unit : str
        Name of the brick unit.
    target : DotTarget
    sensor_mode : SensorMode
    picture : tuple of CapturedPicture
        Nearest plane first.
    origin_near_px : (float, float) or None, px
        A pixel near a plain target's origin.
    origin_at : "centre" or "dot"
        As `bricktrack_host.calibration.dots.dot_grid.GridOrigin` means it.
    simulated : bool
    version : int
    """

    unit: str
    target: DotTarget
    sensor_mode: SensorMode
    picture: tuple[CapturedPicture, ...]
    origin_near_px: tuple[float, float] | None = None
    origin_at: Literal["centre", "dot"] = "centre"
    simulated: bool = False
    version: Annotated[int, msgspec.Meta(ge=1)] = VERSION

    def with_picture(self, new: CapturedPicture, *, beside: bool) -> "Capture":
        """Return the same with a picture more, ``beside`` or instead of those of its depth."""
        others = [p for p in self.picture if beside or p.z_mm != new.z_mm]
        return msgspec.structs.replace(self, picture=tuple(sorted([*others, new], key=lambda p: p.z_mm)))


def load_capture(folder: Path) -> Capture:
    """Read a folder's capture file.

    Raises
    ------
    ConfigError
        If it is missing or holds anything else.
    CalibrationError
        If it is of a newer version, or its target's dots touch.
    """
    path = folder / CAPTURE_FILE
    capture = load_toml(path, Capture)
    if capture.version > VERSION:
        raise CalibrationError(
            f"{path}: version {capture.version} is newer than {VERSION}, the newest that this bricktrack "
            "reads; update bricktrack"
        )
    check_target(capture.target)
    return capture


def save_capture(folder: Path, capture: Capture) -> None:
    """Write a folder's capture file as TOML.

    Raises
    ------
    CalibrationError
        If it cannot be written.
    """
    plain = msgspec.to_builtins(capture)
    pictures, tables = plain.pop("picture"), {k: plain.pop(k) for k in ("target", "sensor_mode")}
    lines = [*_pairs(plain)]
    for name, table in tables.items():
        lines += ["", f"[{name}]", *_pairs(table)]
    for picture in pictures:
        lines += ["", "[[picture]]", *_pairs(picture)]
    path = folder / CAPTURE_FILE
    try:
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as e:
        raise CalibrationError(f"{path}: {e.strerror or e}") from e


def _pairs(table: dict[str, object]) -> list[str]:
    """Return TOML lines of plain values; what is None is left out."""
    return [f"{key} = {_value(value)}" for key, value in table.items() if value is not None]


def _value(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_value(v) for v in value) + "]"
    # JSON's strings and numbers are TOML's too, but for the ASCII control character DEL.
    return msgspec.json.encode(value).decode().replace("\x7f", "\\u007f")
