"""How the command line ends: an error is one red line, an interruption one line, a bug its traceback."""

import errno
from math import isfinite
from pathlib import Path
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
            refuse_strange_values(command)

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


def refuse_strange_values(command: Any) -> None:
    """Have a command, or those below a group, refuse numbers and paths that pass every limit of an option.

    They are "nan" and "inf", and names longer than the file system takes, which fail wherever they are used.
    """
    children = getattr(command, "commands", None)
    if children is not None:
        for child in children.values():
            refuse_strange_values(child)
        return
    invoke = command.invoke

    def checked(context: Any) -> Any:
        for parameter in command.params:
            value = context.params.get(parameter.name)
            for one in value if isinstance(value, (list, tuple)) else (value,):
                if why := _why_strange(one):
                    raise typer.BadParameter(why, ctx=context, param=parameter)
        return invoke(context)

    command.invoke = checked


def _why_strange(value: object) -> str:
    if isinstance(value, float) and not isfinite(value):
        return f"{value} is no finite number"
    if isinstance(value, Path):
        try:
            value.lstat()
        except OSError as e:
            if e.errno == errno.ENAMETOOLONG:
                return f"{value.name[:40]}...: longer than a name can be"
    return ""
