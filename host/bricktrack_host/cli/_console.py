"""The two consoles: results go to standard output, everything else to standard error."""

import logging
import sys
from textwrap import fill
from typing import Any

import msgspec
from rich.console import Console
from rich.logging import RichHandler


class LineConsole(Console):
    """A console whose long lines (``soft_wrap``) are broken between words on a terminal, and nowhere else.

    What reads them from a pipe or a file gets each as one line; a terminal would break them within a word.
    """

    def print(self, *objects: Any, **options: Any) -> None:
        """Print as `rich.console.Console.print` does."""
        if options.get("soft_wrap") and self.is_terminal:
            objects = tuple(self._wrapped(o) if isinstance(o, str) else o for o in objects)
        super().print(*objects, **options)

    def _wrapped(self, text: str) -> str:
        return "\n".join(self._wrapped_line(line) for line in text.split("\n"))

    def _wrapped_line(self, line: str) -> str:
        if len(line) <= self.width:
            return line
        indent = " " * (len(line) - len(line.lstrip()))
        return fill(
            line,
            max(self.width, 20),
            subsequent_indent=indent,
            break_long_words=False,
            break_on_hyphens=False,
        )


out = LineConsole(highlight=False)
err = LineConsole(stderr=True, highlight=False)


def set_up_logging(verbosity: int) -> None:
    """Show warnings; with one ``-v`` state changes, with two everything."""
    level = {0: logging.WARNING, 1: logging.INFO}.get(verbosity, logging.DEBUG)
    handler = RichHandler(console=err, show_path=False, show_time=verbosity > 0, markup=False)
    logging.basicConfig(level=level, format="%(message)s", handlers=[handler], force=True)


def say_error(text: str) -> None:
    """Print an error in red: one line, however long it is, which a terminal breaks between words."""
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
