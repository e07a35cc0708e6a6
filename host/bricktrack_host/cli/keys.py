"""``bricktrack keys``: who this host is, and which units it knows."""

import re
import socket
import sys
from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.table import Table

from bricktrack_common.errors import BricktrackError, ConfigError
from bricktrack_common.key_files import (
    PUBLIC_SUFFIX,
    KeyPair,
    fingerprint,
    read_secret_key,
    write_public_key,
)
from bricktrack_host.cli._console import err, out, say_error
from bricktrack_host.cli._errors import EXIT_ERROR
from bricktrack_host.cli._units import FleetOption, JsonOption, TimeoutOption, fleet_path
from bricktrack_host.transfer.contact import Dialer
from bricktrack_host.transfer.fleet_config import Fleet, UnitConfig, load_fleet
from bricktrack_host.transfer.keys import (
    DEFAULT_KEY,
    REMOTE_COMMAND,
    RemoteUnit,
    create_host_key,
    next_host_key,
    set_server_key,
    ssh_target,
    take_next_key,
)

app = typer.Typer(no_args_is_help=True, help="Make, show, install and change the keys of host and units.")

FileOption = Annotated[
    Path | None,
    typer.Option(
        "--file",
        help=f"This host's secret key. \\[default: the fleet file's \\[host] secret_key, else {DEFAULT_KEY}]",
        show_default=False,
    ),
]
UnitsArgument = Annotated[
    list[str] | None,
    typer.Argument(metavar="UNIT", help="Units of the fleet, or patterns as 'c-*'; all without one."),
]
SshOption = Annotated[
    str, typer.Option("--ssh", help="User at each unit's address, or user@host for a single unit.")
]
RemoteOption = Annotated[str, typer.Option("--remote", help="How bricktrackd is called on the units.")]
RemoteFolderOption = Annotated[
    str, typer.Option("--remote-folder", help="The units' folder of keys.", show_default="the usual one")
]


@app.command()
def create(file: FileOption = None, fleet: FleetOption = None) -> None:
    """Make this host's key pair; never over one that is there.

    For example:

        bricktrack keys create
    """
    path = _key_path(file, _fleet_if_any(fleet))
    pair = create_host_key(path, name=_host_name())
    out.print(pair.public, markup=False)
    err.print(f"Written to {path}; fingerprint {fingerprint(pair.public)}", markup=False, soft_wrap=True)
    err.print(f'Name it in fleet.toml, under [host]: secret_key = "{path}"', markup=False, soft_wrap=True)


@app.command()
def show(
    file: FileOption = None,
    fleet: FleetOption = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Also write it to a file NAME.key, for the units."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Print this host's public key, for 'bricktrackd keys allow' on the units.

    For example:

        bricktrack keys show

        bricktrack keys show --output lab.key
    """
    path = _key_path(file, _fleet_if_any(fleet))
    public = _own_key(path).public
    if output is not None:
        if output.suffix != PUBLIC_SUFFIX:
            raise ConfigError(
                f"{output}: a public key's file ends in {PUBLIC_SUFFIX}, or units do not see it"
            )
        write_public_key(output, public, what=f"host {_host_name()}")
    if as_json:
        _print_json({"file": str(path), "public": public, "fingerprint": fingerprint(public)})
        return
    out.print(public, markup=False)
    err.print(f"{path}; fingerprint {fingerprint(public)}", markup=False)


@app.command("list")
def list_keys(file: FileOption = None, fleet: FleetOption = None, as_json: JsonOption = False) -> None:
    """List the units of the fleet with the fingerprints of their keys.

    For example:

        bricktrack keys list

        bricktrack keys list --json
    """
    chosen = load_fleet(fleet_path(fleet))
    path = _key_path(file, chosen)
    own = read_secret_key(path).public if path.exists() else None
    if as_json:
        _print_json(
            {
                "host": {"file": str(path), "public": own, "fingerprint": fingerprint(own) if own else None},
                "units": [
                    {
                        "name": u.name,
                        "address": u.address,
                        "server_key": u.server_key or None,
                        "fingerprint": fingerprint(u.server_key) if u.server_key else None,
                    }
                    for u in chosen.unit
                ],
            }
        )
        return
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("unit", "address", "fingerprint of its key"):
        table.add_column(name, overflow="fold")
    for unit in chosen.unit:
        shown = fingerprint(unit.server_key) if unit.server_key else "[yellow]no key[/]"
        table.add_row(unit.name, unit.address, shown)
    out.print(table)
    words = f"this host: {fingerprint(own)}" if own else _no_key(path)
    out.print(words, markup=False, soft_wrap=True)


@app.command()
def install(
    ssh: SshOption,
    units: UnitsArgument = None,
    file: FileOption = None,
    fleet: FleetOption = None,
    remote: RemoteOption = REMOTE_COMMAND,
    remote_folder: RemoteFolderOption = "",
) -> None:
    """Give units this host's key by SSH, and put theirs into the fleet file.

    Units without a key make one. Running it again changes nothing more, and takes over a unit's new key.

    For example:

        bricktrack keys install --ssh pi

        bricktrack keys install brick-01 --ssh pi@10.0.0.21
    """
    path = fleet_path(fleet)
    chosen = load_fleet(path)
    if not chosen.host.secret_key:
        raise ConfigError(
            f"{path}: names no key of this host. Make one with 'bricktrack keys create' and name it under "
            f'[host]: secret_key = "{DEFAULT_KEY}"'
        )
    own = _own_key(_key_path(file, chosen))
    selected = _selected(chosen, units, ssh)
    failed = 0
    for unit in selected:  # one after another, with no bar: SSH may ask for passwords
        try:
            key = _remote(ssh, unit, remote, remote_folder).install(_key_name(own), own.public)
            if key != unit.server_key:
                set_server_key(path, unit.name, key)
        except BricktrackError as e:
            say_error(f"{unit.name}: {e}")
            failed += 1
            continue
        state = "as before" if key == unit.server_key else "new" if not unit.server_key else "changed"
        out.print(f"{unit.name}: {fingerprint(key)} ({state})", markup=False)
    _finish(failed, len(selected), "the others have their keys; run it again for those")


@app.command()
def rotate(
    ssh: SshOption,
    file: FileOption = None,
    fleet: FleetOption = None,
    remote: RemoteOption = REMOTE_COMMAND,
    remote_folder: RemoteFolderOption = "",
    timeout: TimeoutOption = 5.0,
) -> None:
    """Change this host's key without being locked out.

    A new key is put beside the old one on every unit of the fleet and tried. Only when all units accept it
    does it take the old one's place here; then the old one is forbidden on the units. Until then the old one
    counts, and running it again goes on where it stopped.

    For example:

        bricktrack keys rotate --ssh pi
    """
    chosen = load_fleet(fleet_path(fleet))
    path = _key_path(file, chosen)
    old, new = _own_key(path), next_host_key(path, name=_host_name())
    keyed = [u for u in _selected(chosen, None, ssh) if u.server_key]
    if not keyed:
        raise ConfigError("no unit of the fleet has a key; 'bricktrack keys install' gives it one")
    failed = 0
    dialer = Dialer(timeout_s=timeout, own_keys=new)
    for unit in keyed:
        try:
            _remote(ssh, unit, remote, remote_folder).install(_key_name(new), new.public)
            with dialer.reach(unit):
                out.print(f"{unit.name}: accepts the new key", markup=False)
        except BricktrackError as e:
            say_error(f"{unit.name}: {e}")
            failed += 1
    _finish(failed, len(keyed), "the old key still counts; run it again when they can be reached")
    kept = take_next_key(path)
    out.print(f"new key {fingerprint(new.public)} in {path}; the old one is kept in {kept}", markup=False)
    for unit in keyed:
        try:
            _remote(ssh, unit, remote, remote_folder).forbid(old.public)
        except BricktrackError as e:
            say_error(f"{unit.name}: the old key is still allowed: {e}")
            failed += 1
    if failed:
        err.print(f"Forbid it there: bricktrackd keys forbid '{old.public}'", markup=False)
        raise typer.Exit(EXIT_ERROR)


def _finish(failed: int, n: int, words: str) -> None:
    if failed:
        say_error(f"{failed} of {n} units failed; {words}")
        raise typer.Exit(EXIT_ERROR)


def _selected(fleet: Fleet, names: list[str] | None, ssh: str) -> list[UnitConfig]:
    units = fleet.select(names)
    if "@" in ssh and len(units) != 1:
        raise ConfigError(
            f"--ssh {ssh} names one machine for {len(units)} units; give the user alone, or name one UNIT"
        )
    return units


def _remote(ssh: str, unit: UnitConfig, command: str, folder: str) -> RemoteUnit:
    return RemoteUnit(ssh_target(ssh, unit), command, folder)


def _key_path(file: Path | None, fleet: Fleet | None) -> Path:
    named = fleet.host.secret_key_path if fleet is not None else None
    return (file or named or DEFAULT_KEY).expanduser()


def _own_key(path: Path) -> KeyPair:
    if not path.exists():
        raise ConfigError(_no_key(path))
    return read_secret_key(path)


def _no_key(path: Path) -> str:
    return f"{path}: this host has no key yet. Make it with 'bricktrack keys create'"


def _fleet_if_any(fleet_file: Path | None) -> Fleet | None:
    path = fleet_path(fleet_file)
    return load_fleet(path) if fleet_file is not None or path.exists() else None


def _key_name(pair: KeyPair) -> str:
    """Return what this key is called on the units: two keys of one host have two names."""
    return f"{_host_name()}-{fingerprint(pair.public)[:9]}"


def _host_name() -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "-", socket.gethostname()).strip("-")[:40] or "host"


def _print_json(data: object) -> None:
    sys.stdout.write(msgspec.json.format(msgspec.json.encode(data), indent=2).decode() + "\n")
