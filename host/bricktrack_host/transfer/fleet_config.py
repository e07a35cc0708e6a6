"""``fleet.toml``: which units there are, where they are reached, and what belongs to each."""

import ipaddress
import math
import re
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit

import msgspec

from bricktrack_common.errors import ConfigError
from bricktrack_common.key_files import check_public_key
from bricktrack_common.run_manifest import RUN_ID_PATTERN
from bricktrack_common.typed_data import load_toml
from bricktrack_common.wire_messages import HelloReply
from bricktrack_host.transfer.assembly_config import AssemblyConfig, check_assembly
from bricktrack_host.transfer.camera_config import (
    CameraImuEntry,
    CameraMount,
    CameraTableEntry,
    check_camera,
)


class UnitConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One ``[[unit]]`` of the fleet.

    Attributes
    ----------
    name : str
        As in the unit's own configuration; run ids begin with it. With ``server_key`` it is the unit's
        identity: an address is only where it was last found.
    address : str
        ``tcp://host:port``; ``""`` for a unit that is found by its name (mDNS).
    server_key : str
        The unit's public key, 40 characters (Z85), as ``bricktrackd`` tells it; ``""`` for a unit without
        keys, which is reached on a loopback address only.
    calibration, layout : str, path, relative to the fleet file
        The camera's calibration and the brick's LED layout; ``""`` if not given.
    camera : "static", "imu" or "table"
        What the camera moves with: nothing, a component with its own IMU, or the shaking table.
    camera_imu, camera_table : CameraImuEntry, CameraTableEntry, optional
        The sensor that moves with it.
    position_mm : (float, float), mm, optional
        Where it stands in the array's plan, x to the right and y up; only drawings need it.
    """

    name: Annotated[str, msgspec.Meta(pattern=RUN_ID_PATTERN)]
    address: str = ""
    server_key: str = ""
    calibration: str = ""
    layout: str = ""
    camera: CameraMount = "static"
    camera_imu: CameraImuEntry | None = None
    camera_table: CameraTableEntry | None = None
    position_mm: tuple[float, float] | None = None

    @property
    def calibration_path(self) -> Path | None:
        """The calibration file, if one is named."""
        return Path(self.calibration) if self.calibration else None

    @property
    def layout_path(self) -> Path | None:
        """The layout file, if one is named."""
        return Path(self.layout) if self.layout else None


class HostTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[host]``: this machine's own side.

    Attributes
    ----------
    secret_key : str, path, relative to the fleet file
        The file of this host's secret key; ``""`` where no unit has keys.
    """

    secret_key: str = ""

    @property
    def secret_key_path(self) -> Path | None:
        """The key file, if one is named."""
        return Path(self.secret_key) if self.secret_key else None


class Fleet(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The units of a laboratory, what they watch, the folder that runs go to, and this host's key."""

    unit: Annotated[list[UnitConfig], msgspec.Meta(min_length=1)]
    runs_folder: str = "runs"
    host: HostTable = HostTable()
    assembly: list[AssemblyConfig] = []

    @property
    def runs_path(self) -> Path:
        """The folder that runs are pulled to."""
        return Path(self.runs_folder)

    def select(self, names: list[str] | None) -> list[UnitConfig]:
        """Return the units of these names or patterns (``c-*``) in the fleet's order, or all of them.

        Raises
        ------
        ConfigError
            If no unit is meant by one of them.
        """
        if not names:
            return list(self.unit)
        for name in names:
            if not any(fnmatchcase(u.name, name) for u in self.unit):
                raise ConfigError(f"no unit {name!r} in the fleet; there are {self._some_names()}")
        return [u for u in self.unit if any(fnmatchcase(u.name, name) for name in names)]

    def _some_names(self, n: int = 12) -> str:
        more = f" and {len(self.unit) - n} more" if len(self.unit) > n else ""
        return ", ".join(u.name for u in self.unit[:n]) + more


def load_fleet(path: Path) -> Fleet:
    """Return a fleet file, checked, with its paths made absolute: they are relative to the file.

    Raises
    ------
    ConfigError
        If it cannot be read, has an unknown, missing or wrong key, a name, address or server key twice, or
        server keys without this host's own.
    """
    if not path.exists():
        raise ConfigError(f"no fleet file {path}. Write one, or name another with --fleet")
    fleet = load_toml(path, Fleet)
    base = path.resolve().parent
    seen: dict[str, set[str]] = {"name": set(), "address": set(), "server_key": set()}
    units: list[UnitConfig] = []
    for i, unit in enumerate(fleet.unit):
        where = f"{path}: unit[{i}]"
        if unit.address:
            check_address(unit.address, where=f"{where}.address")
        if unit.position_mm is not None and not all(math.isfinite(x) for x in unit.position_mm):
            raise ConfigError(f"{where}.position_mm: expected two finite numbers, got {unit.position_mm}")
        check_camera(unit.camera, unit.camera_imu, unit.camera_table, where=where)
        for key, values in seen.items():
            value = getattr(unit, key)
            if value and value in values:
                raise ConfigError(f"{where}.{key}: {value!r} stands twice")
            values.add(value)
        units.append(
            msgspec.structs.replace(
                unit,
                calibration=_below(base, unit.calibration),
                layout=_below(base, unit.layout),
            )
        )
        if unit.server_key:
            check_public_key(unit.server_key, where=f"{where}.server_key")
        if unit.server_key and not fleet.host.secret_key:
            raise ConfigError(
                f"{where}.server_key: the unit asks who we are, and {path} names no key of this host. "
                "Make one with 'bricktrack keys create' and name it under [host] as secret_key"
            )
    names = [unit.name for unit in units]
    for i, unit in enumerate(units):
        other = unit.camera_imu.unit if unit.camera_imu is not None else ""
        if other and (other not in names or other == unit.name):
            raise ConfigError(f"{path}: unit[{i}].camera_imu.unit: {other!r} is no other unit of the fleet")
    for i, assembly in enumerate(fleet.assembly):
        check_assembly(assembly, names, where=f"{path}: assembly[{i}]")
        if [other.name for other in fleet.assembly].count(assembly.name) > 1:
            raise ConfigError(f"{path}: assembly[{i}].name: {assembly.name!r} stands twice")
    return Fleet(
        unit=units,
        assembly=fleet.assembly,
        runs_folder=_below(base, fleet.runs_folder),
        host=HostTable(secret_key=_below(base, fleet.host.secret_key)),
    )


def _below(base: Path, path: str) -> str:
    return str(base / Path(path).expanduser()) if path else ""


def unit_at(address: str) -> UnitConfig:
    """Return a unit that no fleet file names, from the address alone."""
    check_address(address, where="--address")
    return UnitConfig(name=_name_of_address(address), address=address)


def check_name(hello: HelloReply, unit: UnitConfig, address: str) -> None:
    """Make sure that the unit at an address is the one the fleet file means.

    Raises
    ------
    ConfigError
        If it calls itself otherwise: its runs would be processed with another unit's calibration.
    """
    if unit.name not in (hello.unit, _name_of_address(unit.address)):
        raise ConfigError(
            f"the unit at {address} calls itself {hello.unit!r}; the fleet file calls it {unit.name!r}. "
            "Put the addresses right in fleet.toml; 'bricktrack find' tells where each unit is"
        )


def is_loopback(address: str) -> bool:
    """Tell whether an address is this machine's own."""
    host = urlsplit(address).hostname or ""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


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
