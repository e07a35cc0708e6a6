"""``fleet.toml``: which units there are, where they are reached, and what belongs to each."""

import re
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import urlsplit

import msgspec

from bricktrack_common.errors import ConfigError
from bricktrack_common.run_manifest import RUN_ID_PATTERN
from bricktrack_common.typed_data import load_toml
from bricktrack_common.wire_messages import HelloReply

CameraMount = Literal["static", "imu", "table"]


class UnitConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One ``[[unit]]`` of the fleet.

    Attributes
    ----------
    name : str
        As in the unit's own configuration; run ids begin with it.
    address : str
        ``tcp://host:port``.
    calibration, layout : str, path, relative to the fleet file
        The camera's calibration and the brick's LED layout; ``""`` if not given.
    camera : "static", "imu" or "table"
        What the camera moves with: nothing, a component with its own IMU, or the shaking table.
    """

    name: Annotated[str, msgspec.Meta(pattern=RUN_ID_PATTERN)]
    address: str
    calibration: str = ""
    layout: str = ""
    camera: CameraMount = "static"

    @property
    def calibration_path(self) -> Path | None:
        """The calibration file, if one is named."""
        return Path(self.calibration) if self.calibration else None

    @property
    def layout_path(self) -> Path | None:
        """The layout file, if one is named."""
        return Path(self.layout) if self.layout else None


class Fleet(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The units of a laboratory and the folder that their runs go to."""

    unit: Annotated[list[UnitConfig], msgspec.Meta(min_length=1)]
    runs_folder: str = "runs"

    @property
    def runs_path(self) -> Path:
        """The folder that runs are pulled to."""
        return Path(self.runs_folder)

    def select(self, names: list[str] | None) -> list[UnitConfig]:
        """Return the units of these names in the fleet's order, or all of them.

        Raises
        ------
        ConfigError
            If there is no unit of a name.
        """
        if not names:
            return list(self.unit)
        known = [u.name for u in self.unit]
        for name in names:
            if name not in known:
                raise ConfigError(f"no unit {name!r} in the fleet; there are {', '.join(known)}")
        return [u for u in self.unit if u.name in names]


def load_fleet(path: Path) -> Fleet:
    """Return a fleet file, checked, with its paths made absolute: they are relative to the file.

    Raises
    ------
    ConfigError
        If it cannot be read, has an unknown, missing or wrong key, or a name or address twice.
    """
    fleet = load_toml(path, Fleet)
    base = path.resolve().parent
    names: set[str] = set()
    addresses: set[str] = set()
    units: list[UnitConfig] = []
    for i, unit in enumerate(fleet.unit):
        where = f"{path}: unit[{i}]"
        check_address(unit.address, where=f"{where}.address")
        if unit.name in names:
            raise ConfigError(f"{where}.name: {unit.name!r} stands twice")
        if unit.address in addresses:
            raise ConfigError(f"{where}.address: {unit.address!r} stands twice")
        names.add(unit.name)
        addresses.add(unit.address)
        units.append(
            msgspec.structs.replace(
                unit,
                calibration=str(base / unit.calibration) if unit.calibration else "",
                layout=str(base / unit.layout) if unit.layout else "",
            )
        )
    return Fleet(unit=units, runs_folder=str(base / fleet.runs_folder))


def unit_at(address: str) -> UnitConfig:
    """Return a unit that no fleet file names, from the address alone."""
    check_address(address, where="--address")
    return UnitConfig(name=_name_of_address(address), address=address)


def check_name(hello: HelloReply, unit: UnitConfig) -> None:
    """Make sure that a unit is the one the fleet file means.

    Raises
    ------
    ConfigError
        If it calls itself otherwise: its runs would be processed with another unit's calibration.
    """
    if unit.name not in (hello.unit, _name_of_address(unit.address)):
        raise ConfigError(
            f"the unit at {unit.address} calls itself {hello.unit!r}; the fleet file calls it {unit.name!r}. "
            "Put the addresses right in fleet.toml"
        )


def _name_of_address(address: str) -> str:
    return "at-" + re.sub(r"[^A-Za-z0-9.-]+", "-", urlsplit(address).netloc).strip("-")


def check_address(address: str, *, where: str) -> None:
    """Make sure that an address is ``tcp://host:port``; raise `ConfigError` otherwise."""
    try:
        parts = urlsplit(address)
        good = parts.scheme == "tcp" and parts.hostname and parts.port and not parts.path and not parts.query
        good = bool(good) and parts.username is None and not parts.fragment
    except ValueError:
        good = False
    if not good:
        raise ConfigError(
            f"{where}: {address!r} is not an address; expected tcp://host:port, as tcp://10.0.0.21:41733"
        )
