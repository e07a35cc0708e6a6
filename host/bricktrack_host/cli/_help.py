"""Help texts that read well on a terminal of 80 columns, whatever the width of the source they stand in."""

import re
from copy import copy
from textwrap import wrap
from typing import Any

_EXAMPLE = re.compile(r" *bricktrack \S")
_WIDTH = 76
"""Columns of an example: 80, less the margins that typer keeps."""
_KEPT = "\0"
"""Stands for a space at which no line is to end."""


def tidy_help(command: Any) -> None:
    """Make the help of a command, and of all commands below it, fit the terminal.

    Parameters
    ----------
    command : typer.core.TyperGroup or typer.core.TyperCommand
    """
    if command.help:
        command.help = flowing(command.help)

    def format_help(context: Any, formatter: Any) -> None:
        shown = copy(command)  # what is parsed stays as it is
        shown.get_params = lambda _context: [_as_shown(p, context) for p in command.get_params(context)]
        type(command).format_help(shown, context, formatter)

    command.format_help = format_help
    for child in getattr(command, "commands", {}).values():
        tidy_help(child)


def flowing(text: str) -> str:
    r"""Return a help text with one line for each paragraph, which the terminal wraps where it must.

    An example instead is cut here, where a shell goes on after a backslash, so that it can be copied.

    Examples
    --------
    >>> flowing("Say how\nit is.")
    'Say how it is.'
    """
    return "\n\n".join(
        _example(part) if _EXAMPLE.match(part) else " ".join(part.split())
        for part in re.split(r"\n\s*\n", text.strip())
    )


def _example(text: str) -> str:
    together = re.sub(r" (?!-)", _KEPT, " ".join(text.split()))  # an option and its value
    lines = wrap(
        together,
        _WIDTH - 2,  # the space and the backslash
        subsequent_indent="    ",
        break_long_words=False,
        break_on_hyphens=False,
    )
    return " \\\n".join(lines).replace(_KEPT, " ")


def _as_shown(parameter: Any, context: Any) -> Any:
    """Return a parameter that takes few columns, so that the names of options are never cut.

    What a flag takes is not said, nor that an option may be given again; choices, limits and the opposite of
    a flag stand in the text.
    """
    if not hasattr(parameter, "display_type"):  # a typer that lays its help out otherwise
        return parameter
    shown = copy(parameter)
    type_name = _plain_type(parameter.display_type(context))
    if parameter.param_type_name == "argument":
        shown.display_type = lambda _context: type_name
        return shown
    notes = []
    if parameter.is_flag or parameter.count:
        shown.metavar = ""
        if parameter.secondary_opts:
            shown.secondary_opts = []
            shown.show_default = False
            opposite = ", ".join(parameter.secondary_opts)
            if parameter.default:
                notes.append(f"default: on; off: {opposite}")
            elif not opposite.startswith("--no-"):
                notes.append(f"the opposite: {opposite}")
    elif parameter.metavar is None:
        choices = type_name.strip("<>").split("|")
        shown.metavar = type_name if len(choices) == 1 else "<word>"
        if len(choices) > 1:
            notes.append("one of: " + ", ".join(choices))
    if not parameter.count and (limits := _limits(parameter.min, parameter.max)):
        shown.min = shown.max = None
        notes.append(limits)
    shown.help = " ".join([parameter.help or "", *(f"\\[{note}]" for note in notes)])
    return shown


def _limits(least: float | None, most: float | None) -> str:
    if least is not None and most is not None:
        return f"{least:g} to {most:g}"
    if least is not None:
        return f"at least {least:g}"
    return "" if most is None else f"at most {most:g}"


def _plain_type(shown: str) -> str:
    """Return what typer calls a type in the words of a shell.

    Examples
    --------
    >>> [_plain_type(shown) for shown in ("<list[Path]>", "<float range>", "<csv|mat>")]
    ['<path>', '<float>', '<csv|mat>']
    """
    inner = re.sub(r"<list\[(.*)\]>", r"<\1>", shown.replace(" range>", ">"))
    return inner.replace("<Path>", "<path>").replace("<str>", "<text>")
