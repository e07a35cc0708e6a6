"""What all pages share: the template's environment, key figures, tables of origin, and whole writing."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import jinja2

from bricktrack_common.errors import StorageError
from bricktrack_host.durable_files import partial_path


@dataclass(frozen=True, slots=True)
class Key:
    """A figure in the box at the top of a page."""

    name: str
    value: str
    note: str = ""


@dataclass(frozen=True, slots=True)
class OriginTable:
    """Names and values at the end of a page; ``mono`` for hashes."""

    title: str
    rows: list[tuple[str, str]]
    mono: bool


@cache
def page_environment() -> jinja2.Environment:
    """Return the environment of the pages' templates: escaped, strict about names, read once."""
    return jinja2.Environment(
        loader=jinja2.PackageLoader("bricktrack_host.reporting"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def write_page(path: Path, html: str) -> None:
    """Write a page; an older one stays until the new one is whole.

    Raises
    ------
    StorageError
        If it cannot be written.
    """
    partial = partial_path(path)
    try:
        partial.write_text(html, encoding="utf-8")
        partial.replace(path)
    except OSError as e:
        raise StorageError(f"{path}: the report cannot be written: {e.strerror or e}") from e
