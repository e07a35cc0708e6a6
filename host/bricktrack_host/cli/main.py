"""The command ``bricktrack``: its options and the commands it is made of."""

import importlib.metadata
from typing import Annotated

import typer

from bricktrack_host.cli import (
    align,
    calibrate,
    calibrate_leds,
    combine,
    configure,
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
    status,
    still,
    target,
)
from bricktrack_host.cli._console import out, set_up_logging
from bricktrack_host.cli._errors import BricktrackGroup
from bricktrack_host.cli.pull import make_pull_command

app = typer.Typer(
    name="bricktrack",
    cls=BricktrackGroup,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


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


app.command("find")(find.find)
app.command("status")(status.status)
app.command("arm")(fleet.arm)
app.command("disarm")(fleet.disarm)
app.command("still")(still.still)
app.command("configure")(configure.configure)
app.command("delete")(delete.delete)
app.add_typer(keys.app, name="keys")
app.command("pull")(make_pull_command(process.process_pulled))
app.command("import")(import_cmd.import_recording)
app.command("target")(target.target)
calibrate.app.command("leds")(calibrate_leds.leds)
app.add_typer(calibrate.app, name="calibrate")
app.command("process")(process.process)
app.command("report")(process.report)
app.command("align")(align.align)
app.command("evaluate")(evaluate.evaluate)
app.command("combine")(combine.combine)
app.command("export")(export.export)
app.command("overlay")(overlay.overlay)
app.command("demo")(demo.demo)


def main() -> None:
    """Run the command line; see `bricktrack_host.cli._errors` for how it ends."""
    app(prog_name="bricktrack")
