"""The one checked door for data from outside: TOML, JSON and msgpack into typed values.

`msgspec` does the checking; this module turns its words into ours, with the file and the key.
"""

import re
import tomllib
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import msgspec

from bricktrack_common.errors import BricktrackError, ConfigError, RunFormatError

T = TypeVar("T")
_CONVERTING = Lock()
"""msgspec prepares a type when it is first used, and crashes where several threads do that at once."""

_OUR_WORDS = (
    (re.compile(r"Object missing required field `(\w+)`"), r"required field '\1' is missing"),
    (re.compile(r"Object contains unknown field `(\w+)`"), r"unknown field '\1'; is it misspelt?"),
    (
        re.compile(r"Expected `str` matching regex '\^\[A-Za-z0-9\]\[A-Za-z0-9_\.-\]\{0,99\}\$'"),
        "expected letters, digits, '-', '_' and '.', a letter or digit first",
    ),
)


def convert(data: object, kind: type[T], *, where: str, error: type[BricktrackError]) -> T:
    """Return plain ``data`` (dicts, lists, numbers) as the typed value ``kind``.

    Parameters
    ----------
    data : object
        What a TOML, JSON or msgpack decoder returned.
    kind : type
        A `msgspec.Struct`, or anything else that `msgspec` can check.
    where : str
        The file or message, to be named in the error.
    error : type
        The error to raise, so that a wire message fails as a `ProtocolError` and a file as its own.
    """
    try:
        with _CONVERTING:
            return msgspec.convert(data, kind, strict=True)
    except msgspec.ValidationError as e:
        text = str(e)
        problem, _, key = text.partition(" - at `")
        key = key.rstrip("`").removeprefix("$.").removeprefix("$")
        for msgspecs, ours in _OUR_WORDS:
            problem = msgspecs.sub(ours, problem)
        raise error(f"{where}: {key + ': ' if key else ''}{problem}") from e


def load_toml(path: Path, kind: type[T]) -> T:
    """Return a TOML file as the typed value ``kind``.

    Raises
    ------
    ConfigError
        If the file is missing, is not TOML, or has an unknown, missing or wrong key; the message
        names the file and the key path.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")  # editors of Windows begin with a mark
    except OSError as e:
        raise ConfigError(f"{path}: {e.strerror or e}") from e
    except UnicodeDecodeError as e:
        raise ConfigError(f"{path}: not UTF-8 text ({e.reason} at byte {e.start})") from e
    try:
        data: dict[str, Any] = tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        raise ConfigError(f"{path}: not valid TOML: {e}") from e
    return convert(data, kind, where=str(path), error=ConfigError)


def load_json(path: Path, kind: type[T], *, error: type[BricktrackError] = RunFormatError) -> T:
    """Return a JSON file as the typed value ``kind``; raise ``error`` with file and key otherwise."""
    try:
        data = msgspec.json.decode(path.read_bytes())
    except OSError as e:
        raise error(f"{path}: {e.strerror or e}") from e
    except (msgspec.DecodeError, UnicodeDecodeError) as e:
        raise error(f"{path}: not valid JSON: {e}") from e
    return convert(data, kind, where=str(path), error=error)


def dump_json(value: object) -> bytes:
    """Return a typed value as indented JSON text with a final newline."""
    return msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n"
