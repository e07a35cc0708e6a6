"""``bricktrackd keys``: the unit's own key, and the hosts that may speak to it."""

import sys
from pathlib import Path
from typing import Annotated

import typer

# Imports stay inside the commands, as in `bricktrack_device.cli`.

DEFAULT_FOLDER = Path("/etc/bricktrack/keys")

app = typer.Typer(
    name="keys", help="The unit's own key, and the hosts that may speak to it.", no_args_is_help=True
)

FolderOption = Annotated[Path, typer.Option("--folder", help="The folder of keys, as in \\[server] keys.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]


@app.command(epilog="Example:\n\n  sudo bricktrackd keys create\n")
def create(
    folder: FolderOption = DEFAULT_FOLDER,
    replace: Annotated[
        bool, typer.Option("--replace", help="Make a new key; the old one is kept as unit.key_secret.old.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Make the unit's key, if it has none, and print the public one, for fleet.toml on the hosts.

    As root, the files are given to the user bricktrack, whom the daemon runs as. A replaced key counts once
    the daemon is restarted; hosts must then have the new one.
    """
    from bricktrack_device.network.key_folder import create_unit_key, unit_public_key

    is_new = create_unit_key(folder, replace=replace)
    _print_key(unit_public_key(folder), as_json=as_json, is_new=is_new)
    if is_new:
        typer.echo(f'Name the folder in the configuration: [server] keys = "{folder}"', err=True)


@app.command(epilog="Example:\n\n  sudo bricktrackd keys show\n")
def show(folder: FolderOption = DEFAULT_FOLDER, as_json: JsonOption = False) -> None:
    """Print the unit's public key."""
    from bricktrack_device.network.key_folder import unit_public_key

    _print_key(unit_public_key(folder), as_json=as_json, is_new=False)


@app.command(epilog="Example:\n\n  sudo bricktrackd keys allow lab 'HOST-PUBLIC-KEY'\n")
def allow(
    name: Annotated[str, typer.Argument(help="What to call the host: letters, digits, _ and -.")],
    public_key: Annotated[str, typer.Argument(help="Its public key, 40 characters, quoted.")],
    folder: FolderOption = DEFAULT_FOLDER,
) -> None:
    """Let a host speak to this unit; counts at once. A host may have two keys while it changes them."""
    from bricktrack_common.key_files import fingerprint
    from bricktrack_device.network.key_folder import allow_client

    known_as = allow_client(folder, name, public_key)
    typer.echo(f"{known_as} ({fingerprint(public_key)}) may speak to this unit")


@app.command(epilog="Example:\n\n  sudo bricktrackd keys forbid lab\n")
def forbid(
    host: Annotated[str, typer.Argument(help="A host's name, or one of its public keys, quoted.")],
    folder: FolderOption = DEFAULT_FOLDER,
) -> None:
    """Let a host speak to this unit no more; counts from its next connection on."""
    from bricktrack_device.network.key_folder import forbid_client

    for name in forbid_client(folder, host):
        typer.echo(f"{name} may not speak to this unit any more")


@app.command("list", epilog="Example:\n\n  sudo bricktrackd keys list --json\n")
def list_clients(folder: FolderOption = DEFAULT_FOLDER, as_json: JsonOption = False) -> None:
    """List the hosts that may speak to this unit."""
    from bricktrack_common.key_files import fingerprint, read_public_key
    from bricktrack_device.network.key_folder import client_files

    clients = {p.stem: read_public_key(p) for p in client_files(folder)}
    if as_json:
        _print_json({"clients": [{"name": n, "public": k} for n, k in clients.items()]})
        return
    if not clients:
        typer.echo(f"No host may speak to this unit: there is no key in {folder / 'clients'}")
    for name, public in clients.items():
        typer.echo(f"{fingerprint(public)}  {public}  {name}")


def _print_key(public: str, *, as_json: bool, is_new: bool) -> None:
    from bricktrack_common.key_files import fingerprint

    if as_json:
        _print_json({"public": public, "fingerprint": fingerprint(public), "created": is_new})
        return
    typer.echo(public)
    typer.echo(f"fingerprint {fingerprint(public)}", err=True)


def _print_json(data: object) -> None:
    import msgspec

    sys.stdout.write(msgspec.json.format(msgspec.json.encode(data), indent=2).decode() + "\n")
