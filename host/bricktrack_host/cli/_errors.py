"""How the command line ends: an error is one red line, an interruption one line, a bug its traceback."""

from math import isfinite
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
        for command in self.commands.values():
            take_finite_numbers_only(command)

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


def take_finite_numbers_only(command: Any) -> None:
    """Have a command, or those below a group, refuse "nan" and "inf", which pass every limit of an option."""
    children = getattr(command, "commands", None)
    if children is not None:
        for child in children.values():
            take_finite_numbers_only(child)
        return
    invoke = command.invoke

    def checked(context: Any) -> Any:
        for parameter in command.params:
            value = context.params.get(parameter.name)
            for number in value if isinstance(value, (list, tuple)) else (value,):
                if isinstance(number, float) and not isfinite(number):
                    raise typer.BadParameter(f"{number} is no finite number", ctx=context, param=parameter)
        return invoke(context)

    command.invoke = checked
