"""Calibrations of BNO055 chips, kept by chip and mode: a fusion mode need not learn them at every start.

``<storage>/calibration/<chip id>.json`` holds, for each mode, the 22 bytes of registers 0x55..0x6A as the
chip had them when it called itself calibrated.
"""

import logging
import os
import re
from pathlib import Path
from typing import Annotated

import msgspec

from bricktrack_common.errors import RunFormatError, StorageError
from bricktrack_common.typed_data import dump_json, load_json
from bricktrack_device.config import ImuMode
from bricktrack_device.inertial.bno055 import N_CALIBRATION_BYTES

logger = logging.getLogger(__name__)

CALIBRATION_SCHEMA = "bricktrack.imu-calibration"
CALIBRATION_VERSION = 1
_CHIP_ID = re.compile(r"[0-9a-f]{32}")
_HEX = rf"^[0-9a-f]{{{2 * N_CALIBRATION_BYTES}}}$"


class _OfMode(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    registers_hex: Annotated[str, msgspec.Meta(pattern=_HEX)]
    calib_stat: Annotated[int, msgspec.Meta(ge=0, le=255)]


class _CalibrationFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    schema: str = CALIBRATION_SCHEMA
    version: int = CALIBRATION_VERSION
    chip_id: str
    modes: dict[ImuMode, _OfMode]


def load_calibration(folder: Path, chip_id: str, mode: ImuMode) -> bytes | None:
    """Return what was saved for a chip in a mode, or `None`; the log tells of a file that cannot be read."""
    path = _path_of(folder, chip_id)
    if path is None or not path.exists():
        return None
    try:
        of_mode = _load(path, chip_id).modes.get(mode)
    except RunFormatError as e:
        logger.warning("%s; the sensor starts uncalibrated", e)
        return None
    return None if of_mode is None else bytes.fromhex(of_mode.registers_hex)


def save_calibration(folder: Path, chip_id: str, mode: ImuMode, registers: bytes, *, calib_stat: int) -> Path:
    """Keep a calibration durably, beside those of other modes; return its file.

    Raises
    ------
    StorageError
        If the chip has no id to keep it by, or the card does not take it.
    """
    path = _path_of(folder, chip_id)
    if path is None:
        raise StorageError(f"chip id {chip_id!r} could not be read: its calibration cannot be kept by it")
    modes: dict[ImuMode, _OfMode] = {}
    if path.exists():
        try:
            modes = _load(path, chip_id).modes
        except RunFormatError as e:
            logger.warning("%s; it is replaced", e)
    modes = modes | {mode: _OfMode(registers_hex=registers.hex(), calib_stat=calib_stat)}
    temporary = path.with_suffix(".tmp")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            file.write(dump_json(_CalibrationFile(chip_id=chip_id, modes=modes)))
            file.flush()
            os.fsync(file.fileno())
        temporary.rename(path)
    except OSError as e:
        raise StorageError(f"{path}: the calibration cannot be written: {e.strerror or e}") from e
    return path


def _load(path: Path, chip_id: str) -> _CalibrationFile:
    kept = load_json(path, _CalibrationFile)
    if kept.schema != CALIBRATION_SCHEMA or kept.version > CALIBRATION_VERSION or kept.chip_id != chip_id:
        raise RunFormatError(
            f"{path}: {kept.schema} {kept.version} of chip {kept.chip_id}; expected {CALIBRATION_SCHEMA} up "
            f"to {CALIBRATION_VERSION} of chip {chip_id}"
        )
    return kept


def _path_of(folder: Path, chip_id: str) -> Path | None:
    return folder / f"{chip_id}.json" if _CHIP_ID.fullmatch(chip_id) else None
