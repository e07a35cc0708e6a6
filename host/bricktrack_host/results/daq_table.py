"""The laboratory's own channels beside the motion: a table of its data acquisition, joined by sample."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv

from bricktrack_common.arrays import IntArray
from bricktrack_common.errors import RunFormatError
from bricktrack_host.recordings.timed_csv import refuse_other_separator

MAX_SAMPLE = 2**53  # whole numbers in a float64 column end here


def read_daq_csv(path: Path, *, sample_column: str | None = None, first_sample: int = 0) -> "pa.Table":
    """Return the channels of a CSV file with their sample numbers in the column ``sample``.

    Parameters
    ----------
    path : Path
        One header line, then one row a sample.
    sample_column : str, optional
        Column that holds the sample numbers. Without it rows are counted.
    first_sample : int
        What the laboratory calls the sample of the wave's first rising edge; it becomes 0.

    Raises
    ------
    RunFormatError
        If the file is no such table, a name stands twice, or a sample number is missing, stands twice or is
        no whole number.
    """
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            refuse_other_separator(path, file.readline().split(","))
        table = pa.csv.read_csv(path)
    except (OSError, pa.ArrowException) as e:
        raise RunFormatError(f"{path}: not a readable CSV table: {e}") from e
    names = table.column_names
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise RunFormatError(f"{path}: the column {twice[0]!r} stands twice")
    if sample_column is None:
        sample = np.arange(table.num_rows, dtype=np.int64)
    else:
        if sample_column not in names:
            raise RunFormatError(f"{path}: no column {sample_column!r}; there are {', '.join(names)}")
        sample = _whole_numbers(table.column(sample_column), where=f"{path}: {sample_column}")
        table = table.drop_columns([sample_column])
    if "sample" in table.column_names:
        raise RunFormatError(
            f"{path}: a channel is called 'sample'. Name it as --sample-column if it counts the samples, or "
            "rename it"
        )
    unique, counts = np.unique(sample, return_counts=True)
    if counts.size and counts.max() > 1:
        raise RunFormatError(f"{path}: sample {unique[np.argmax(counts)]} stands {counts.max()} times")
    return table.add_column(0, pa.field("sample", pa.int64()), pa.array(sample - first_sample))


def join_samples(motion: "pa.Table", daq: "pa.Table", *, number: str) -> "pa.Table":
    """Return every row of ``daq`` with the motion of the same sample behind it; nulls where there is none.

    Parameters
    ----------
    motion : pyarrow.Table
        With at most one row a sample.
    daq : pyarrow.Table
        From `read_daq_csv`.
    number : str
        Column of ``motion`` that holds the sample number.

    Raises
    ------
    RunFormatError
        If no sample is common to both, or a name is.
    """
    numbers = np.asarray(motion.column(number).to_numpy(), dtype=np.int64)
    row_of = {int(sample): row for row, sample in enumerate(numbers)}
    wanted = daq.column("sample").to_numpy()
    rows = [row_of.get(int(sample)) for sample in wanted]
    if not any(row is not None for row in rows):
        raise RunFormatError(
            f"no sample of the motion ({_span(numbers)}) is among those of the data acquisition "
            f"({_span(wanted)}). Is the number of the first sample right?"
        )
    beside = motion.drop_columns([number]).take(pa.array(rows, type=pa.int64()))
    clash = sorted(set(beside.column_names) & set(daq.column_names))
    if clash:
        raise RunFormatError(f"the channel {clash[0]!r} has the name of a column of the motion. Rename it")
    joined = daq
    for field, column in zip(beside.schema, beside.columns, strict=True):
        joined = joined.append_column(field, column)
    return joined.replace_schema_metadata(motion.schema.metadata)


def _whole_numbers(column: Any, *, where: str) -> IntArray:
    if column.null_count or not (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)):
        raise RunFormatError(f"{where}: sample numbers must be whole numbers, one in each row")
    values = np.asarray(column.to_numpy(), dtype=np.float64)
    if not (np.isfinite(values) & (values == np.rint(values)) & (np.abs(values) < MAX_SAMPLE)).all():
        bad = values[~(values == np.rint(values))]
        raise RunFormatError(f"{where}: {bad[0] if bad.size else 'a value'} is no sample number")
    return values.astype(np.int64)


def _span(numbers: IntArray) -> str:
    return f"{numbers.min()} to {numbers.max()}" if numbers.size else "none"
