"""One measurement's result as a self-contained JSON file: figures, settings, and where it was measured."""

import os
from importlib import metadata
from pathlib import Path
from typing import Any

import msgspec

from bricktrack_common.clocks import read_clock_triplet
from bricktrack_common.errors import StorageError
from bricktrack_device.interfaces import Rig


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """What a timing tool measured.

    Attributes
    ----------
    tool : str
        Its command.
    unit : str
    simulated : bool
        Whether the figures are a simulated unit's: they say nothing about a Raspberry Pi then.
    realtime_ns : int
        When, by a clock that may never have been set.
    software : str
    hardware : dict
    settings : dict
    figures : dict
        Summary values; the names carry the units. What could not be measured is null.
    values : dict
        Columns of what was measured one by one.
    """

    tool: str
    version: int = 1
    unit: str
    simulated: bool
    realtime_ns: int
    software: str
    hardware: dict[str, str]
    settings: dict[str, Any]
    figures: dict[str, Any]
    values: dict[str, list[Any]]


def make_result(
    tool: str,
    unit: str,
    rig: Rig,
    *,
    settings: dict[str, Any],
    figures: dict[str, Any],
    values: dict[str, list[Any]],
) -> Result:
    """Return a result with when and where it was measured."""
    return Result(
        tool=tool,
        unit=unit,
        simulated=rig.simulated,
        realtime_ns=read_clock_triplet().realtime_ns,
        software=f"bricktrack {metadata.version('bricktrack')}",
        hardware=rig.describe() | {"cores": str(os.cpu_count())},
        settings=settings,
        figures=figures,
        values=values,
    )


def to_json(result: Result) -> str:
    """Return a result as JSON text; values that are not finite become null."""
    return msgspec.json.format(msgspec.json.encode(result), indent=2).decode() + "\n"


def write_result(result: Result, path: Path) -> None:
    """Write a result to a new or existing file.

    Raises
    ------
    StorageError
        If it cannot be written.
    """
    try:
        path.write_text(to_json(result), encoding="utf-8")
    except OSError as e:
        raise StorageError(f"{path}: {e.strerror}; choose another --output") from e
