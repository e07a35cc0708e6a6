"""CSV files of times and numbers, as other programs write them: read whole or refused by line."""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.errors import RunFormatError, VideoError


@dataclass(frozen=True, slots=True, eq=False)
class TimedCsv:
    """The column names of a file, and its rows with their line numbers; empty lines and comments left out."""

    path: Path
    header: list[str]
    rows: list[tuple[int, list[str]]]

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file.

        Raises
        ------
        RunFormatError
            If it cannot be read, has no rows, or a row has another number of fields than there are names.
        """
        reader = csv.reader(read_text(path, RunFormatError).splitlines())
        header: list[str] = []
        rows: list[tuple[int, list[str]]] = []
        for row in reader:
            if not row or row[0].lstrip().startswith("#"):
                continue
            if not header:
                header = [c.strip() for c in row]
                refuse_other_separator(path, header)
                continue
            if len(row) != len(header):
                raise RunFormatError(
                    f"{path}: line {reader.line_num}: {len(row)} fields; the first line names {len(header)}"
                )
            rows.append((reader.line_num, row))
        if not rows:
            raise RunFormatError(f"{path}: no rows; expected a first line of column names, and rows below it")
        return cls(path, header, rows)

    def columns(self, names: Sequence[str], *, expected: str) -> tuple[IntArray, FloatArray]:
        """Return ``t_ns``, int64, shape (n,), strictly increasing, and the named columns, shape (n, n_names).

        An empty field is NaN. ``expected`` tells in words which columns there must be.

        Raises
        ------
        RunFormatError
            If a column is missing, a field is no number, or times do not increase.
        """
        missing = [c for c in ("t_ns", *names) if c not in self.header]
        if missing:
            raise RunFormatError(
                f"{self.path}: no column {', '.join(missing)}; the first line must name {expected}, "
                f"and names {', '.join(self.header)}"
            )
        wanted = [self.header.index(c) for c in names]
        values = [[self._number(line, row[c]) for c in wanted] for line, row in self.rows]
        return self._times_ns(), np.array(values).reshape(len(self.rows), len(names))

    def _times_ns(self) -> IntArray:
        column = self.header.index("t_ns")
        t_ns = np.empty(len(self.rows), dtype=np.int64)
        for i, (line, row) in enumerate(self.rows):
            # Never by float: ns since boot need more than the 53 bits of one.
            if not re.fullmatch(r"\s*-?\d{1,18}\s*", row[column]):
                raise RunFormatError(
                    f"{self.path}: line {line}: t_ns is {row[column][:40]!r}; expected whole nanoseconds"
                )
            t_ns[i] = int(row[column])
            if i and t_ns[i] <= t_ns[i - 1]:
                raise RunFormatError(
                    f"{self.path}: line {line}: t_ns {row[column].strip()} does not come after the one "
                    "before; rows must stand in the order of time, each once. Leave that row out: a sample "
                    "missing does less harm than one at a wrong time"
                )
        return t_ns

    def _number(self, line: int, text: str) -> float:
        if not text.strip():
            return float("nan")
        try:
            return float(text)
        except ValueError as e:
            raise RunFormatError(f"{self.path}: line {line}: {text[:40]!r} is no number") from e


def refuse_other_separator(path: Path, header: list[str]) -> None:
    """Refuse a table whose fields are parted by semicolons or tabs, as spreadsheets of some countries write.

    Raises
    ------
    RunFormatError
        If the first line is one field that holds such separators.
    """
    if len(header) != 1:
        return
    for separator, name in ((";", "semicolons"), ("\t", "tabs")):
        if separator in header[0]:
            raise RunFormatError(
                f"{path}: fields are parted by {name}. Write it again with commas between the fields, and "
                "points in the numbers"
            )


def refuse_longer_rows(path: Path, rows: Sequence[Mapping[str | None, object]]) -> None:
    """Refuse rows, as `csv.DictReader` gives them, with more fields than the first line names.

    Raises
    ------
    RunFormatError
        With the row's number: numbers with a decimal comma would be read as two.
    """
    for i, row in enumerate(rows, 1):
        surplus = row.get(None)
        if isinstance(surplus, list) and any(surplus):  # a comma at the end of a line is no field
            raise RunFormatError(
                f"{path}: row {i} has more fields than the first line names. Write numbers with points, and "
                "commas between the fields only"
            )


def read_text(path: Path, error: type[VideoError] | type[RunFormatError]) -> str:
    """Return a text file's contents, with or without a byte-order mark, or raise an ``error``."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as e:
        raise error(f"{path}: {e.strerror or e}") from e
    except UnicodeDecodeError as e:
        raise error(f"{path}: not UTF-8 text ({e.reason} at byte {e.start})") from e
