"""The two consoles: results go to standard output, everything else to standard error."""

import logging
import sys

import msgspec
from rich.console import Console
from rich.logging import RichHandler

out = Console(highlight=False)
err = Console(stderr=True, highlight=False)


def set_up_logging(verbosity: int) -> None:
    """Show warnings; with one ``-v`` state changes, with two everything."""
    level = {0: logging.WARNING, 1: logging.INFO}.get(verbosity, logging.DEBUG)
    handler = RichHandler(console=err, show_path=False, show_time=verbosity > 0, markup=False)
    logging.basicConfig(level=level, format="%(message)s", handlers=[handler], force=True)


def say_error(text: str) -> None:
    """Print an error as one red line, however long it is."""
    line = " ".join(text.split())
    err.print(f"Error: {line}", style="bold red", markup=False, soft_wrap=True)
    sys.stderr.flush()


def print_json(value: object, *, indent: bool = True) -> None:
    """Print a value for scripts: indented, or on one line where more will follow."""
    text = msgspec.json.encode(value)
    sys.stdout.write((msgspec.json.format(text, indent=2) if indent else text).decode() + "\n")
    sys.stdout.flush()


def plain(text: str) -> str:
    """Return text from a unit so that it cannot be taken for markup."""
    return text.replace("[", r"\[")
