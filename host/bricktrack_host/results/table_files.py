"""Tables on disk: Parquet for programs, and CSV for everybody."""

from pathlib import Path

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from bricktrack_common.errors import RunFormatError
from bricktrack_host.results.table_columns import COVARIANCES

_ROWS_OF_GROUP = 1 << 16
"""Of a Parquet file, which is packed group by group: so many rows are some 20 MB."""
_ROWS_AT_ONCE = 8192  # of a CSV: a tenth faster than the 1024 of Arrow, and some 8 MB of text


def write_table(table: "pa.Table", folder: Path, name: str) -> None:
    """Write a table as Parquet, and as CSV without its covariances.

    What is measured hardly repeats, and dictionaries of it take time and room: what repeats alone has one. No
    packing makes covariances smaller.
    """
    types = pa.types
    repeats = [c.name for c in table.schema if types.is_string(c.type) or types.is_integer(c.type)]
    lists = [name for name in COVARIANCES if name in table.column_names]
    packing = dict.fromkeys(table.column_names, "zstd") | {f"{name}.list.element": "none" for name in lists}
    pa.parquet.write_table(
        table, folder / f"{name}.parquet", compression=packing,  # type: ignore[arg-type]
        row_group_size=_ROWS_OF_GROUP, use_dictionary=repeats,  # type: ignore[arg-type]
    )  # fmt: skip
    flat = table.drop_columns(lists)
    how = pa.csv.WriteOptions(quoting_style="needed", batch_size=_ROWS_AT_ONCE)
    pa.csv.write_csv(flat, folder / f"{name}.csv", how)


def read_table(path: Path, n_rows: int) -> "pa.Table":
    """Return one table of so many rows.

    Raises
    ------
    RunFormatError
        If it is missing, cannot be read, or has another number of rows.
    """
    if not path.is_file():
        raise RunFormatError(f"{path}: missing. Process the run again")
    table = read_parquet(path)
    if table.num_rows != n_rows:
        raise RunFormatError(f"{path}: {table.num_rows} rows; the summary says {n_rows}")
    return table


def read_parquet(path: Path) -> "pa.Table":
    """Return one table; raise `RunFormatError` where it cannot be read."""
    try:
        return pa.parquet.read_table(path)
    except (OSError, pa.ArrowException) as e:
        raise RunFormatError(f"{path}: not a readable Parquet table: {e}") from e
