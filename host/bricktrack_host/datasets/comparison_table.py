"""A comparison as a table: one row for each motion, the worst first, for spreadsheets and scripts."""

import csv
import io
from pathlib import Path

import numpy as np

from bricktrack_host.datasets.comparison import Alike, worst_first
from bricktrack_host.datasets.comparison_pairs import Comparison
from bricktrack_host.durable_files import replace_durably, storage_errors

_AXES = ("dx_mm", "dy_mm", "dz_mm", "drot_x_deg", "drot_y_deg", "drot_z_deg")

Row = dict[str, str | int | float | None]


def comparison_rows(comparison: Comparison) -> list[Row]:
    """Return one row for each motion; `None` where there is no number."""
    return [_row(pair) for pair in worst_first(comparison.pairs)]


def write_comparison_csv(comparison: Comparison, path: Path) -> None:
    """Write the rows as CSV, whole or not at all; empty where there is no number.

    Raises
    ------
    StorageError
        If it cannot be written.
    """
    rows = comparison_rows(comparison)
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]) if rows else [])
    writer.writeheader()
    writer.writerows(rows)
    with storage_errors(path, "Choose another --csv, or make room"):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_durably(path, text.getvalue().encode())


def _row(pair: Alike) -> Row:
    figures = (("max", pair.largest), ("rms", pair.rms), ("in_sd", pair.in_sd))
    row: Row = {"motion": pair.name, "at": pair.at, "both": pair.n}
    row |= {
        "came": pair.appeared,
        "went": pair.disappeared,
        "share_beyond": _number(pair.share_beyond),
        "worst_s": _number(pair.worst_s),
    }
    for what, values in figures:
        row |= {f"{what}_{axis}": _number(x) for axis, x in zip(_AXES, values.tolist(), strict=True)}
    return row


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
