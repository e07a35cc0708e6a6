"""Streams on disk: concatenated msgpack records behind a header that says what they are.

A stream may end in the middle of a record, when power was cut: the reader returns the whole records before
it and says how many bytes were left over. It refuses a newer version by name, and never guesses.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

import msgpack

from bricktrack_common.errors import RunFormatError

Kind = Literal["int", "float", "bool", "bytes", "bytes?"]
_PYTHON_TYPES: dict[Kind, tuple[type, ...]] = {
    "int": (int,),
    "float": (float, int),
    "bool": (bool,),
    "bytes": (bytes,),
    "bytes?": (bytes, type(None)),
}
_MAX_RECORD_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class Field:
    """One column of a stream: its name, its kind, and its unit or meaning."""

    name: str
    kind: Kind
    unit: str


@dataclass(frozen=True, slots=True)
class StreamSchema:
    """What a stream holds. A change to ``fields`` raises ``version`` and `docs/run-format.md`."""

    name: str
    version: int
    fields: tuple[Field, ...]


@dataclass(frozen=True, slots=True)
class StreamContents:
    """A stream as read.

    Attributes
    ----------
    meta : dict
        What the writer put in the header beside the schema.
    columns : dict of str to list
        One list a field, all of the same length.
    leftover_bytes : int
        Bytes after the last whole record; not 0 means that the stream was cut.
    """

    meta: dict[str, Any]
    columns: dict[str, list[Any]]
    leftover_bytes: int

    @property
    def n_records(self) -> int:
        """Number of whole records."""
        return len(next(iter(self.columns.values())))


def write_stream(
    file: BinaryIO, schema: StreamSchema, records: Iterable[Sequence[object]], *, meta: dict[str, Any]
) -> int:
    """Write header and records to an open binary file; return the number of records."""
    pack = msgpack.Packer().pack
    header = {
        "schema": schema.name,
        "version": schema.version,
        "fields": [f.name for f in schema.fields],
        "kinds": [f.kind for f in schema.fields],
        "units": [f.unit for f in schema.fields],
        "meta": meta,
    }
    file.write(pack(header))
    n = 0
    for record in records:
        if len(record) != len(schema.fields):
            raise RunFormatError(
                f"{schema.name}: record of {len(record)} fields; expected {len(schema.fields)}"
            )
        file.write(pack(list(record)))
        n += 1
    return n


def read_stream(path: Path, schema: StreamSchema) -> StreamContents:
    """Return the whole records of a stream.

    Raises
    ------
    RunFormatError
        As `pass_records` says.
    """
    columns: dict[str, list[Any]] = {f.name: [] for f in schema.fields}
    appends = [column.append for column in columns.values()]

    def take(record: list[Any]) -> None:
        for append, value in zip(appends, record, strict=True):
            append(value)

    meta, leftover_bytes = pass_records(path, schema, take)
    return StreamContents(meta=meta, columns=columns, leftover_bytes=leftover_bytes)


def pass_records(
    path: Path, schema: StreamSchema, take: Callable[[list[Any]], None]
) -> tuple[dict[str, Any], int]:
    """Hand the whole records of a stream on, one after the other, without keeping them.

    Returns
    -------
    meta : dict
        What the writer put in the header beside the schema.
    leftover_bytes : int
        Bytes after the last whole record; not 0 means that the stream was cut.

    Raises
    ------
    RunFormatError
        If the file cannot be read, is no stream of this schema, is of a newer version, or holds a
        record of the wrong shape or type (which is damage, not a cut). ``take`` may raise it as well.
    """
    n_bytes, whole_bytes, n = 0, 0, 0
    try:
        with path.open("rb") as file:
            n_bytes = path.stat().st_size
            unpacker = msgpack.Unpacker(
                file, raw=False, strict_map_key=True, max_buffer_size=n_bytes + 1,
                max_str_len=_MAX_RECORD_BYTES, max_bin_len=_MAX_RECORD_BYTES, max_array_len=4096,
                max_map_len=4096, max_ext_len=0,
            )  # fmt: skip
            meta = _check_header(unpacker.unpack(), schema, path)
            while True:
                whole_bytes = unpacker.tell()
                record = unpacker.unpack()
                _check_record(record, schema, path, n)
                take(record)
                n += 1
    except msgpack.OutOfData:
        if whole_bytes == 0:
            raise RunFormatError(
                f"{path}: {n_bytes} bytes, no whole header; not a {schema.name} stream"
            ) from None
    except OSError as e:
        raise RunFormatError(f"{path}: {e.strerror or e}") from e
    except (ValueError, TypeError, msgpack.UnpackException) as e:
        if isinstance(e, RunFormatError):
            raise
        raise RunFormatError(f"{path}: damaged at byte {whole_bytes}, after {n} records: {e}") from e
    return meta, n_bytes - whole_bytes


def _check_header(header: object, schema: StreamSchema, path: Path) -> dict[str, Any]:
    if not isinstance(header, dict) or header.get("schema") != schema.name:
        raise RunFormatError(f"{path}: not a {schema.name} stream")
    version = header.get("version")
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise RunFormatError(f"{path}: {schema.name} version {version!r}; expected a positive integer")
    if version > schema.version:
        raise RunFormatError(
            f"{path}: {schema.name} version {version}; this bricktrack reads up to version "
            f"{schema.version}. Upgrade bricktrack on this machine"
        )
    if header.get("fields") != [f.name for f in schema.fields]:
        raise RunFormatError(
            f"{path}: fields {header.get('fields')!r} are not those of {schema.name} {version}"
        )
    meta = header.get("meta")
    if not isinstance(meta, dict):
        raise RunFormatError(f"{path}: header without 'meta'")
    return meta


def _check_record(record: object, schema: StreamSchema, path: Path, index: int) -> None:
    if not isinstance(record, list) or len(record) != len(schema.fields):
        raise RunFormatError(f"{path}: record {index} is not a list of {len(schema.fields)} fields")
    for value, field in zip(record, schema.fields, strict=True):
        allowed = _PYTHON_TYPES[field.kind]
        if not isinstance(value, allowed) or (isinstance(value, bool) and field.kind != "bool"):
            raise RunFormatError(
                f"{path}: record {index}: {field.name} is {value!r:.40}; expected {field.kind}"
            )
