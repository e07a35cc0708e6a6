"""The command line of the daemon: run it, check the unit, or write what a host needs for simulated runs."""

import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from bricktrack_common.errors import BricktrackError
from bricktrack_device.network import keys_cli

# Imports stay inside the commands: each sampler's process imports this module again, and must stay small.
if TYPE_CHECKING:
    from bricktrack_device.config import DeviceConfig
    from bricktrack_device.interfaces import Rig
    from bricktrack_device.timing.result_file import Result


class _Group(TyperGroup):
    """A group whose help shows no type for flags, nor does that of the commands below it."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        _untype_flags(self)


def _untype_flags(command: Any) -> None:
    listed = command.get_params

    def get_params(context: Any) -> list[Any]:
        parameters: list[Any] = listed(context)
        for parameter in parameters:
            if getattr(parameter, "is_flag", False):
                parameter.metavar = ""
        return parameters

    command.get_params = get_params
    for child in getattr(command, "commands", {}).values():
        _untype_flags(child)


app = typer.Typer(
    name="bricktrackd",
    cls=_Group,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

ConfigOption = Annotated[
    Path | None, typer.Option("--config", "-c", help="TOML file; see systemd/bricktrackd.toml.")
]
BackendOption = Annotated[str | None, typer.Option(help='Where the sensors are; "sim" simulates them.')]
StorageOption = Annotated[Path | None, typer.Option(help="Folder that runs are kept in.")]
PortOption = Annotated[int | None, typer.Option(help="TCP port to serve on; 0 takes a free one.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]
OutputOption = Annotated[
    Path | None, typer.Option("--output", "-o", help="Also write the result here, JSON.")
]
UnitOption = Annotated[str | None, typer.Option(help="Name of this unit.")]

_RUN_EPILOG = """Examples:

  bricktrackd run --config /etc/bricktrack/bricktrackd.toml

  bricktrackd run --backend sim --storage /tmp/unit-1 --unit unit-1 --port 41733
"""
_CHECK_EPILOG = """Examples:

  bricktrackd check --config /etc/bricktrack/bricktrackd.toml

  bricktrackd check --backend sim --storage /tmp/unit-1 --json
"""

_IMU_TEST_EPILOG = """Examples:

  bricktrackd imu-test --config /etc/bricktrack/bricktrackd.toml --compare

  bricktrackd imu-test --backend sim --slots 500 --json
"""

_TIMING_TEST_EPILOG = """Examples:

  bricktrackd timing-test --config /etc/bricktrack/bricktrackd.toml --output timing.json

  bricktrackd timing-test --backend sim --switches 20
"""

_START_TEST_EPILOG = """Examples:

  bricktrackd start-test --config /etc/bricktrack/bricktrackd.toml --runs 50

  bricktrackd start-test --backend sim --runs 5
"""


app.add_typer(keys_cli.app)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"bricktrackd {version('bricktrack')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True),
    ] = False,
) -> None:
    """The acquisition daemon of a brick unit."""  # noqa: D401 - what the help begins with


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
    as_json: JsonOption = False,
) -> None:
    """Try every part of this unit; exit with 1 if one fails. Not while the daemon runs.

    Takes some ten seconds: the camera streams, the trigger's line is listened to, the card is written to.
    """
    from bricktrack_device.backends import open_rig
    from bricktrack_device.checks import run_checks
    from bricktrack_device.health.report import as_report, print_table

    settings = _as_configured(_load(config, backend=backend, storage=storage, port=port, unit=unit))
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


@app.command("imu-test", epilog=_IMU_TEST_EPILOG)
def imu_test(
    slots: Annotated[int, typer.Option(min=100, max=1_000_000, help="How many slots to take.")] = 10_000,
    compare: Annotated[
        bool, typer.Option("--compare", help="Also measure two sleeping loops on the same bus, in turn.")
    ] = False,
    imu: Annotated[str | None, typer.Option(help="Which sensor; the first one by default.")] = None,
    config: ConfigOption = None,
    backend: BackendOption = None,
    as_json: JsonOption = False,
    output: OutputOption = None,
) -> None:
    """Measure how well the inertial sampler keeps its grid of time. Not while the daemon runs.

    Prints drift, lateness, lost slots, bus times and the rate of unique samples; --compare sets beside them
    the naive loop time.sleep(0.01) and the source paper's adaptive sleep, as ratios from the same minutes.
    """
    from bricktrack_device.timing.imu_test import print_report, run_imu_test

    with _measuring(config, backend, what="sampling") as (settings, rig, progress):
        result = run_imu_test(settings, rig, name=imu, n_slots=slots, compare=compare, progress=progress)
    _give(result, print_report, as_json=as_json, output=output)


@app.command("timing-test", epilog=_TIMING_TEST_EPILOG)
def timing_test(
    switches: Annotated[int, typer.Option(min=8, max=10_000, help="How often to switch the LEDs.")] = 60,
    config: ConfigOption = None,
    backend: BackendOption = None,
    as_json: JsonOption = False,
    output: OutputOption = None,
) -> None:
    """Switch the LEDs at known instants and find these in the recorded rows. Not while the daemon runs.

    The LEDs must hang on pins (leds.pins) and be at rest in the picture. Prints by how much the recorded time
    of a row's mid-exposure differs from the GPIO's: mean, spread, drift, and along the rows.
    """
    from bricktrack_device.timing.timing_test import print_report, run_timing_test

    with _measuring(config, backend, what="switching") as (settings, rig, progress):
        result = run_timing_test(settings, rig, n_switches=switches, progress=progress)
    _give(result, print_report, as_json=as_json, output=output)


@app.command("start-test", epilog=_START_TEST_EPILOG)
def start_test(
    runs: Annotated[int, typer.Option(min=2, max=1000, help="How often to start the camera.")] = 20,
    config: ConfigOption = None,
    backend: BackendOption = None,
    as_json: JsonOption = False,
    output: OutputOption = None,
) -> None:
    """Measure how long a cold camera takes to its first frame. Not while the daemon runs.

    By the first frame's own stamp, and by the source paper's way, from counts of frames, with Sheppard's
    correction for what counting adds to the spread.
    """
    from bricktrack_device.timing.start_test import print_report, run_start_test

    with _measuring(config, backend, what="starting") as (settings, rig, progress):
        result = run_start_test(settings, rig, n_runs=runs, progress=progress)
    _give(result, print_report, as_json=as_json, output=output)


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


def _as_configured(settings: "DeviceConfig") -> "DeviceConfig":
    """Return the configuration with what hosts have set in it, as the daemon works by it."""
    from bricktrack_device.remote_settings import RemoteSettings

    return RemoteSettings(settings, settings.storage_folder).load()


@contextmanager
def _measuring(
    config: Path | None, backend: str | None, *, what: str
) -> "Iterator[tuple[DeviceConfig, Rig, Callable[[float], None]]]":
    """Open the unit's hardware for a measurement, with a progress bar where somebody watches."""
    from rich.console import Console
    from rich.progress import Progress

    from bricktrack_device.backends import open_rig

    settings = _as_configured(_load(config, backend=backend, storage=None, port=None, unit=None))
    rig = open_rig(settings)
    try:
        with Progress(console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(what, total=1.0)
            yield settings, rig, lambda share: bar.update(task, completed=share)
    finally:
        rig.close()


def _give(
    result: "Result", print_report: "Callable[[Result], None]", *, as_json: bool, output: Path | None
) -> None:
    """Print a measurement's result, and write it where it was asked for."""
    from bricktrack_device.timing.result_file import to_json, write_result

    if output is not None:
        write_result(result, output)
    if as_json:
        sys.stdout.write(to_json(result))
    else:
        print_report(result)


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
