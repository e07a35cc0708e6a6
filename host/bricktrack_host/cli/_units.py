"""Which units a command is for, and how they are reached: those of the fleet file, or of given addresses."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from bricktrack_common.errors import ConfigError
from bricktrack_common.key_files import read_secret_key
from bricktrack_host.transfer.contact import Dialer
from bricktrack_host.transfer.discovery import NetworkFinder
from bricktrack_host.transfer.fleet_config import Fleet, UnitConfig, load_fleet, unit_at

DEFAULT_FLEET = Path("fleet.toml")

FleetOption = Annotated[
    Path | None,
    typer.Option(
        "--fleet",
        "-f",
        help="Fleet file. \\[default: $BRICKTRACK_FLEET, else ./fleet.toml]",
        show_default=False,
    ),
]
UnitOption = Annotated[
    list[str] | None,
    typer.Option(
        "--unit",
        "-u",
        help="Only this unit of the fleet, or those of a pattern as 'c-*'; may be given again.",
        show_default=False,
    ),
]
AddressOption = Annotated[
    list[str] | None,
    typer.Option(
        "--address",
        "-a",
        help="A unit without a fleet file, as tcp://10.0.0.21:41733; may be given again.",
        show_default=False,
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object for scripts.")]
TimeoutOption = Annotated[
    float, typer.Option("--timeout", min=0.1, max=600, help="Seconds that a unit may be silent.")
]


@dataclass(frozen=True, slots=True)
class ChosenUnits:
    """The units that the options name, how to reach them, and the fleet file's contents if one was used."""

    units: list[UnitConfig]
    dialer: Dialer
    fleet: Fleet | None


def fleet_path(fleet_file: Path | None) -> Path:
    """Return the fleet file that is meant: the one given, the environment's, or the one at hand."""
    return fleet_file or Path(os.environ.get("BRICKTRACK_FLEET") or DEFAULT_FLEET)


def choose_units(
    fleet_file: Path | None, names: list[str] | None, addresses: list[str] | None, *, timeout_s: float
) -> ChosenUnits:
    """Return what the options of a command mean.

    Raises
    ------
    ConfigError
        If both addresses and names are given, or neither and there is no fleet file.
    """
    if addresses:
        if names or fleet_file:
            raise ConfigError("--address stands for itself: give it without --unit and --fleet")
        return ChosenUnits([unit_at(a) for a in dict.fromkeys(addresses)], Dialer(timeout_s=timeout_s), None)
    path = fleet_path(fleet_file)
    if fleet_file is None and not path.exists():
        raise ConfigError(
            f"no fleet file {path}. Name the unit with --address tcp://host:port, or write a fleet.toml "
            "and give it with --fleet"
        )
    fleet = load_fleet(path)
    units = fleet.select(names)
    secret = fleet.host.secret_key_path if any(u.server_key for u in units) else None
    own_keys = None if secret is None else read_secret_key(secret)
    dialer = Dialer(timeout_s=timeout_s, own_keys=own_keys, finder=NetworkFinder())
    return ChosenUnits(units, dialer, fleet)
