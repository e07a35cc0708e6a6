"""Tables for other programs: CSV, MATLAB's .mat, or Parquet, with units and meaning."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import scipy.io

from bricktrack_common.errors import RunFormatError
from bricktrack_host.durable_files import written_whole
from bricktrack_host.results.table_columns import COVARIANCES
from bricktrack_host.results.table_files import read_parquet

Format = Literal["csv", "mat", "parquet"]
_MAT_NAME_MAX = 63  # of MATLAB; savemat cuts longer field names off at 31 unless told


def read_run_table(results: Path, table: str) -> "pa.Table":
    """Return one table of a processed run.

    Parameters
    ----------
    results : Path
        Its results folder.
    table : str
        ``optical``, ``fused``, ``leds``, ``imu``, ``edges``; or ``samples``: the fused motion at the
        laboratory's samples only, with ``edge_index`` as its first column.

    Raises
    ------
    RunFormatError
        If there is no such table, or it is damaged.
    """
    name = "fused" if table == "samples" else table
    path = results / f"{name}.parquet"
    if not path.is_file():
        raise RunFormatError(
            f"{path}: no such table. Process the run first; if that was done, it has nothing for '{name}'"
        )
    whole = read_parquet(path)
    if table != "samples":
        return whole
    kind = np.array(whole.column("kind").to_pylist(), dtype=object)
    rows = whole.take(np.flatnonzero(kind == "edge"))
    if not rows.num_rows:
        raise RunFormatError(f"{path}: no motion at the laboratory's samples: the run has no square wave")
    order = ["edge_index", *(c for c in rows.column_names if c not in ("kind", "edge_index"))]
    return rows.select(order)


def write_table(table: "pa.Table", path: Path, form: Format) -> None:
    """Write a table for another program, whole or not at all.

    In MATLAB a file holds three structures of the same fields: ``data`` (columns; ``covariance`` one row of
    21 a sample; words as cells), ``units`` and ``meanings``; and ``about``, conventions and provenance.

    Raises
    ------
    StorageError
        If it cannot be written.
    """
    with written_whole(path, "Choose another --output, or make room") as partial:
        _WRITERS[form](table, partial)


def _write_csv(table: "pa.Table", path: Path) -> None:
    flat = table.drop_columns([name for name in COVARIANCES if name in table.column_names])
    pa.csv.write_csv(flat, path, pa.csv.WriteOptions(quoting_style="needed"))


def _write_parquet(table: "pa.Table", path: Path) -> None:
    pa.parquet.write_table(table, path, compression="zstd")


def _write_mat(table: "pa.Table", path: Path) -> None:
    names = [_mat_name(field.name) for field in table.schema]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise RunFormatError(f"two columns would both be called {twice!r} in MATLAB. Rename one of them")
    about = {
        _mat_name(key.decode().removeprefix("bricktrack.")): value.decode()
        for key, value in (table.schema.metadata or {}).items()
    }
    contents = {
        "data": {name: _mat_column(table.column(i)) for i, name in enumerate(names)},
        "units": {name: _note(field, b"unit") for name, field in zip(names, table.schema, strict=True)},
        "meanings": {name: _note(field, b"meaning") for name, field in zip(names, table.schema, strict=True)},
        "about": about,
    }
    scipy.io.savemat(
        str(path),
        contents,
        appendmat=False,
        long_field_names=True,
        do_compression=True,
        oned_as="column",
    )


def _note(field: "pa.Field[Any]", key: bytes) -> str:
    return str((field.metadata or {}).get(key, b"").decode())


def _mat_name(name: str) -> str:
    """Return a name that MATLAB takes: letters, digits and underscores, a letter first, at most 63."""
    safe = "".join(c if c.isascii() and c.isalnum() else "_" for c in name)
    return (safe if safe[:1].isalpha() else f"c_{safe}")[:_MAT_NAME_MAX]


def _mat_column(column: Any) -> Any:
    if pa.types.is_fixed_size_list(column.type):
        flat = column.combine_chunks().flatten()
        return np.asarray(flat.to_numpy(zero_copy_only=False)).reshape(-1, column.type.list_size)
    if pa.types.is_integer(column.type) and not column.null_count:
        return column.to_numpy()
    if pa.types.is_integer(column.type) or pa.types.is_floating(column.type):
        return np.array([np.nan if x is None else x for x in column.to_pylist()], dtype=np.float64)
    return np.array(["" if x is None else str(x) for x in column.to_pylist()], dtype=object)


_WRITERS: dict[Format, Callable[["pa.Table", Path], None]] = {
    "csv": _write_csv,
    "mat": _write_mat,
    "parquet": _write_parquet,
}
