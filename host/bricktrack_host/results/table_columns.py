"""Columns of result tables: each with its unit and meaning, which the schema of a table carries."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.imu_records import ImuFlag
from bricktrack_host.quality import LedFlag, PoseFlag

XYZ = "xyz"
COVARIANCES = "covariance", "dcovariance"
"""Columns of lists, which no CSV holds."""
TRIANGLE = np.triu_indices(6)
"""Rows and columns of a covariance that are written."""

CONVENTIONS = {
    "time": "t_ns is CLOCK_MONOTONIC of the unit, int64 ns; t_s counts from the first rising edge, in s",
    "camera frame": "origin at the projection centre, x right (u), y down (v), z out through the lens, mm",
    "brick frame": "origin at the first LED of the layout, axes as in the drawing, mm",
    "rest frame": "the brick frame where it stood before the shake; columns in d are seen from it, as the "
    "mean of the same kind of poses has it, optical or fused",
    "quaternion": "order w, x, y, z; takes brick to camera coordinates; the sign is chosen to be continuous",
    "rotation vector": "axis times angle, rad, of the rotation that takes brick to camera coordinates",
    "angles": "intrinsic XYZ, degrees: R = Rx(angle_x) @ Ry(angle_y) @ Rz(angle_z)",
    "covariance": "upper triangle, row by row, of the 6 x 6 covariance of [dtheta rad, dt mm]: "
    "R_true = R Exp(dtheta), brick axes; t_true = t + dt, camera axes; dcovariance: of the motion from rest, "
    "brick axes at rest",
    "missing": "NaN, with a bit in flags that says why",
}


@dataclass(frozen=True, slots=True)
class Column:
    """One column: name, unit, and what it means, for the schema and for people."""

    name: str
    unit: str
    meaning: str


Columns = list[tuple[Column, "pa.Array[Any]"]]


def make_table(columns: Columns, metadata: dict[str, str]) -> "pa.Table":
    """Return a table whose schema carries unit and meaning of each column."""
    fields = [
        pa.field(c.name, array.type, metadata={"unit": c.unit, "meaning": c.meaning}) for c, array in columns
    ]
    keys: dict[str | bytes, str | bytes] = dict(metadata.items())
    return pa.Table.from_arrays([array for _, array in columns], schema=pa.schema(fields, metadata=keys))


def covariance_column(covariance: FloatArray, *, name: str = "covariance") -> tuple[Column, "pa.Array[Any]"]:
    """Return the upper triangles of covariances, shape (n, 6, 6), as one column of lists."""
    triangle = np.ascontiguousarray(covariance[:, TRIANGLE[0], TRIANGLE[1]])
    packed = pa.FixedSizeListArray.from_arrays(pa.array(triangle.reshape(-1)), 21)
    return Column(name, "rad, mm", "see the table's conventions; left out of the CSV"), packed


def vector_columns(name: str, unit: str, meaning: str, values: FloatArray) -> Columns:
    """Return three columns, x, y and z; ``{}`` in the name stands for the letter."""
    return [
        (Column(name.format(c), unit, f"{meaning}: {c}"), pa.array(np.ascontiguousarray(values[:, i])))
        for i, c in enumerate(XYZ)
    ]


def flag_columns(flags: IntArray) -> Columns:
    """Return `PoseFlag` bits and their names."""
    return [
        (Column("flags", "bits", "PoseFlag bits"), pa.array(flags)),
        (
            Column("flag_words", "", "names of the PoseFlag bits, parted by |"),
            pa.array(flag_words(flags, PoseFlag), type=pa.string()),
        ),
    ]


def flag_words(flags: IntArray, kind: type[PoseFlag] | type[LedFlag] | type[ImuFlag]) -> list[str]:
    """Return the names of the set bits of each value, as ``"dropout|impact"``."""
    names = [(int(f), (f.name or "").lower()) for f in kind if int(f)]
    values, which = np.unique(flags, return_inverse=True)
    known = ["|".join(name for bit, name in names if bit & value) for value in values.tolist()]
    return [known[i] for i in which.tolist()]
