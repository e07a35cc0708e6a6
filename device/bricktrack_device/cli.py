"""The command line of the daemon: run it, check the unit, or write what a host needs for simulated runs."""

import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bricktrack_common.errors import BricktrackError

# Imports stay inside the commands: each sampler's process imports this module again, and must stay small.
if TYPE_CHECKING:
    from bricktrack_device.config import DeviceConfig

app = typer.Typer(
    name="bricktrackd",
    help="The acquisition daemon of a brick unit.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

ConfigOption = Annotated[
    Path | None, typer.Option("--config", "-c", help="TOML file; see systemd/bricktrackd.toml.")
]
BackendOption = Annotated[str | None, typer.Option(help='Where the sensors are; "sim" simulates them.')]
StorageOption = Annotated[Path | None, typer.Option(help="Folder that runs are kept in.")]
PortOption = Annotated[int | None, typer.Option(help="TCP port to serve on; 0 takes a free one.")]
UnitOption = Annotated[str | None, typer.Option(help="Name of this unit.")]

_RUN_EPILOG = """Examples:

  bricktrackd run --config /etc/bricktrack/bricktrackd.toml

  bricktrackd run --backend sim --storage /tmp/unit-1 --unit unit-1 --port 41733
"""
_CHECK_EPILOG = """Examples:

  bricktrackd check --config /etc/bricktrack/bricktrackd.toml

  bricktrackd check --backend sim --storage /tmp/unit-1 --json
"""


@app.command(epilog=_RUN_EPILOG)
def run(
    config: ConfigOption = None,
    backend: BackendOption = None,
    storage: StorageOption = None,
    port: PortOption = None,
    unit: UnitOption = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log every detail.")] = False,
) -> None:
    """Serve this unit until SIGTERM or Ctrl-C; a recording under way is then saved and marked."""
    from bricktrack_device.backends import open_rig
    from bricktrack_device.daemon import Daemon

    logging.basicConfig(
        stream=sys.stderr,
        level=logging.DEBUG if verbose else logging.INFO,
        format="%(asctime)s %(levelname)s %(name)s: %(message)s",
    )
    settings = _load(config, backend=backend, storage=storage, port=port, unit=unit)
    Daemon(settings, open_rig(settings)).run()


@app.command(epilog=_CHECK_EPILOG)
def check(
    config: ConfigOption = None,
    backend: BackendOption = None,
    storage: StorageOption = None,
    port: PortOption = None,
    unit: UnitOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for programs.")] = False,
) -> None:
    """Try every part of this unit; exit with 1 if one fails. Not while the daemon runs.

    Takes some ten seconds: the camera streams, the trigger's line is listened to, the card is written to.
    """
    from bricktrack_device.backends import open_rig
    from bricktrack_device.checks import run_checks
    from bricktrack_device.health.report import as_report, print_table

    settings = _load(config, backend=backend, storage=storage, port=port, unit=unit)
    rig = open_rig(settings)
    try:
        results = run_checks(settings, rig)
    finally:
        rig.close()
    report = as_report(settings.unit.name, results, simulated=rig.simulated)
    if as_json:
        _print_json(report)
    else:
        print_table(report)
    raise typer.Exit(0 if report.ok else 1)


@app.command("sim-kit", epilog="Example:\n\n  bricktrackd sim-kit ./kit --config sim.toml\n")
def sim_kit(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to write into; made if missing.")],
    config: ConfigOption = None,
) -> None:
    """Write what a host needs to process simulated runs: layout, calibration pictures and the like."""
    from bricktrack_device.config import load_config
    from bricktrack_device.sim.sim_kit import write_sim_kit

    for path in write_sim_kit(folder, load_config(config, {"backend": "sim"}).sim):
        typer.echo(path)


def _load(
    config: Path | None, *, backend: str | None, storage: Path | None, port: int | None, unit: str | None
) -> "DeviceConfig":
    from bricktrack_device.config import load_config

    return load_config(
        config,
        {
            "backend": backend,
            "storage.folder": None if storage is None else str(storage),
            "server.port": port,
            "unit.name": unit,
        },
    )


def _print_json(report: object) -> None:
    import msgspec

    sys.stdout.write(msgspec.json.format(msgspec.json.encode(report), indent=2).decode() + "\n")


def main() -> None:
    """Run the command line; an error raised on purpose is one line and exit status 1."""
    try:
        app()
    except BricktrackError as e:
        typer.echo(f"bricktrackd: {e}", err=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
