"""How the command line ends: an error is one red line, an interruption one line, a bug its traceback."""

from typing import Any

import typer
from typer.core import TyperGroup

from bricktrack_common.errors import BricktrackError
from bricktrack_host.cli._console import err, say_error
from bricktrack_host.cli._help import tidy_help

EXIT_ERROR = 1
EXIT_INTERRUPTED = 130


class BricktrackGroup(TyperGroup):
    """The top group; it wraps every command below it, those of mounted apps too."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        tidy_help(self)

    def invoke(self, ctx: Any) -> Any:
        """Run a command; exit with 1 after a `BricktrackError`, with 130 after Ctrl-C."""
        try:
            return super().invoke(ctx)
        except BricktrackError as e:
            say_error(str(e))
            raise typer.Exit(EXIT_ERROR) from e
        except KeyboardInterrupt as e:
            err.print(str(e) or "Interrupted.", style="yellow", markup=False)
            raise typer.Exit(EXIT_INTERRUPTED) from e
