"""``bricktrack find``: the units that announce themselves in this network."""

from typing import Annotated

import typer
from rich.table import Table

from bricktrack_common.key_files import fingerprint
from bricktrack_common.wire_messages import PROTOCOL_VERSION
from bricktrack_host.cli._console import err, out, plain, print_json, say_error
from bricktrack_host.cli._errors import EXIT_ERROR
from bricktrack_host.cli._units import FleetOption, JsonOption, fleet_path
from bricktrack_host.transfer.discovery import SEARCH_S, FoundUnit, NetworkFinder
from bricktrack_host.transfer.fleet_config import Fleet, load_fleet


def find(
    seconds: Annotated[
        float, typer.Option("--seconds", min=0.5, max=60, help="How long to wait for answers.")
    ] = SEARCH_S,
    fleet: FleetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the units that announce themselves in this network, and what the fleet file says of each.

    A unit that is bound to its own loopback address announces nothing.

    Exits with 1 if none is found.

    For example:

        bricktrack find

        bricktrack find --fleet fleet.toml --json
    """
    path = fleet_path(fleet)
    known = load_fleet(path) if fleet is not None or path.exists() else None
    finder = NetworkFinder(search_s=seconds)
    try:
        with err.status(f"looking for units for {seconds:g} s"):
            found = finder.find_all()
    finally:
        finder.close()
    if as_json:
        rows = [
            {
                "name": one.announcement.unit,
                "addresses": list(one.addresses),
                "protocol": list(one.announcement.protocol),
                "key_fingerprint": one.announcement.key_fingerprint,
                "fleet": _fleet_words(one, known),
            }
            for one in found
        ]
        print_json({"units": rows})
    elif found:
        _print(found, known)
    if not found:
        say_error(
            "no unit announces itself here. Are the units on, in this network, and is zeroconf installed on "
            "them? Networks between buildings often drop mDNS: give those units an address in fleet.toml"
        )
        raise typer.Exit(EXIT_ERROR)


def _print(found: list[FoundUnit], known: Fleet | None) -> None:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("unit", "address", "key", "protocol", "fleet file"):
        table.add_column(name, no_wrap=name == "unit")
    for one in found:
        major, minor = one.announcement.protocol
        version = f"{major}.{minor}"
        if major != PROTOCOL_VERSION:
            version = f"[red]{version}; this host speaks {PROTOCOL_VERSION}[/]"
        table.add_row(
            plain(one.announcement.unit),
            plain(" ".join(one.addresses)),
            one.announcement.key_fingerprint or "none",
            version,
            plain(_fleet_words(one, known)),
        )
    out.print(table)


def _fleet_words(one: FoundUnit, known: Fleet | None) -> str:
    """Return how an announcement goes with the fleet file, in words."""
    if known is None:
        return ""
    unit = next((u for u in known.unit if u.name == one.announcement.unit), None)
    if unit is None:
        return "not in it"
    if unit.server_key and fingerprint(unit.server_key) != one.announcement.key_fingerprint:
        return f"another key: {fingerprint(unit.server_key)}"
    if unit.address and unit.address not in one.addresses:
        return f"moved from {unit.address}"
    return "as it says" if unit.address else "found by name"
