"""The command ``bricktrack``: its options and the commands it is made of."""

import importlib.metadata
import sys
from typing import Annotated

import typer

from bricktrack_host.cli import (
    align,
    calibrate,
    calibrate_leds,
    combine,
    compare,
    configure,
    dashboard,
    dataset,
    delete,
    demo,
    evaluate,
    export,
    find,
    fleet,
    import_cmd,
    keys,
    overlay,
    process,
    report,
    status,
    still,
    target,
    test_day,
    view,
)
from bricktrack_host.cli._console import out, set_up_logging
from bricktrack_host.cli._errors import EXIT_INTERRUPTED, BricktrackGroup
from bricktrack_host.cli._processing import process_pulled
from bricktrack_host.cli.pull import make_pull_command

app = typer.Typer(
    name="bricktrack",
    cls=BricktrackGroup,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

_UNITS = "Units"
_CAMERAS = "Cameras"
_RUNS = "Runs and results"
_JUDGE = "Try and judge"


def _print_version(wanted: bool) -> None:
    if wanted:
        out.print(f"bricktrack {importlib.metadata.version('bricktrack')}")
        raise typer.Exit


@app.callback()
def _options(
    verbose: Annotated[
        int,
        typer.Option("--verbose", "-v", count=True, help="Say more; twice: everything.", show_default=False),
    ] = 0,
    version: Annotated[
        bool,
        typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True),
    ] = False,
) -> None:
    """Six-degree-of-freedom motion of cracked bricks on a shaking table, from a camera and an IMU in each."""
    set_up_logging(verbose)


app.command("find", rich_help_panel=_UNITS)(find.find)
app.command("status", rich_help_panel=_UNITS)(status.status)
app.command("arm", rich_help_panel=_UNITS)(fleet.arm)
app.command("disarm", rich_help_panel=_UNITS)(fleet.disarm)
app.command("dashboard", rich_help_panel=_UNITS)(dashboard.dashboard)
app.command("still", rich_help_panel=_UNITS)(still.still)
app.command("configure", rich_help_panel=_UNITS)(configure.configure)
app.command("delete", rich_help_panel=_UNITS)(delete.delete)
app.add_typer(keys.app, name="keys", rich_help_panel=_UNITS)
app.command("pull", rich_help_panel=_UNITS)(make_pull_command(process_pulled))
app.command("import", rich_help_panel=_RUNS)(import_cmd.import_recording)
app.command("target", rich_help_panel=_CAMERAS)(target.target)
calibrate.app.command("leds")(calibrate_leds.leds)
app.add_typer(calibrate.app, name="calibrate", rich_help_panel=_CAMERAS)
app.command("process", rich_help_panel=_RUNS)(process.process)
app.command("report", rich_help_panel=_RUNS)(report.report)
app.command("align", rich_help_panel=_RUNS)(align.align)
app.command("evaluate", rich_help_panel=_JUDGE)(evaluate.evaluate)
app.command("combine", rich_help_panel=_RUNS)(combine.combine)
app.add_typer(dataset.app, name="dataset", rich_help_panel=_RUNS)
app.command("compare", rich_help_panel=_RUNS)(compare.compare)
app.command("export", rich_help_panel=_RUNS)(export.export)
app.command("view", rich_help_panel=_RUNS)(view.view)
app.command("overlay", rich_help_panel=_RUNS)(overlay.overlay)
app.add_typer(test_day.app, name="test", rich_help_panel=_UNITS)
app.command("demo", rich_help_panel=_JUDGE)(demo.demo)


def main() -> None:
    """Run the command line; see `bricktrack_host.cli._errors` for how it ends."""
    try:
        app(prog_name="bricktrack")
    except KeyboardInterrupt:  # before a command begins: typer takes its time to read them all
        sys.exit(EXIT_INTERRUPTED)
