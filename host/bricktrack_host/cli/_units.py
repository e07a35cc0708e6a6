"""Which units a command is for: those of the fleet file, or one given by its address."""

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from bricktrack_common.errors import BricktrackError, ConfigError
from bricktrack_host.transfer.fleet_config import Fleet, UnitConfig, check_name, load_fleet, unit_at
from bricktrack_host.transfer.pull import MAX_WORKERS
from bricktrack_host.transfer.unit_client import UnitClient

T = TypeVar("T")

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
    typer.Option("--unit", "-u", help="Only this unit of the fleet; may be given again.", show_default=False),
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
TimeoutOption = Annotated[
    float, typer.Option("--timeout", min=0.1, max=600, help="Seconds that a unit may be silent.")
]


def choose_units(
    fleet_file: Path | None, names: list[str] | None, addresses: list[str] | None
) -> tuple[list[UnitConfig], Fleet | None]:
    """Return the units that the options name, and the fleet file's contents where one was used.

    Raises
    ------
    ConfigError
        If both addresses and names are given, or neither and there is no fleet file.
    """
    if addresses:
        if names or fleet_file:
            raise ConfigError("--address stands for itself: give it without --unit and --fleet")
        return [unit_at(a) for a in dict.fromkeys(addresses)], None
    path = fleet_file or Path(os.environ.get("BRICKTRACK_FLEET") or DEFAULT_FLEET)
    if fleet_file is None and not path.exists():
        raise ConfigError(
            f"no fleet file {path}. Name the unit with --address tcp://host:port, or write a fleet.toml "
            "and give it with --fleet"
        )
    fleet = load_fleet(path)
    return fleet.select(names), fleet


def ask_units(
    units: list[UnitConfig], question: Callable[[UnitClient], T], *, timeout_s: float
) -> list[T | BricktrackError]:
    """Ask all units at once; return each one's answer, or the error it gave, in the order of ``units``."""
    stop = threading.Event()

    def ask(unit: UnitConfig) -> T | BricktrackError:
        try:
            with UnitClient(unit.address, timeout_s=timeout_s, stop=stop) as client:
                check_name(client.hello(), unit)
                return question(client)
        except BricktrackError as e:
            return e

    with ThreadPoolExecutor(min(MAX_WORKERS, len(units)), "ask") as pool:
        answers = pool.map(ask, units)
        try:
            return list(answers)
        except BaseException:
            stop.set()  # Ctrl-C does not wait for a unit that is slow to answer
            raise
