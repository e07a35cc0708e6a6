"""The columns of a campaign's dataset: name, type, unit, meaning, and the version that brought each.

`docs/dataset-format.md` describes them; a test compares the two. Columns are only ever added, with a new
version: none is renamed, retyped, given another unit or meaning, or removed. So a file of any older version
is one of this version with some columns missing, which read as null.
"""

from dataclasses import dataclass
from typing import Any

import pyarrow as pa

from bricktrack_common.errors import RunFormatError

MOTION_SCHEMA = "bricktrack.motion"
MOTION_VERSION = 1

PARTITION_KEYS = ("test", "assembly", "unit")

CONVENTIONS = {
    "partition": "test, assembly and unit are in the folders' names; a unit of no assembly has null there",
    "seen from camera": "motion of the first LED of the unit's layout from rest, brick axes at rest",
    "seen from base": "motion of a component's point from rest, axes of the whole brick, seen from the base",
    "angles": "intrinsic XYZ, degrees: R = Rx(angle_x) @ Ry(angle_y) @ Rz(angle_z)",
    "missing": "NaN (null where a number is whole, or a word), with a bit in flags that says why",
}


@dataclass(frozen=True, slots=True)
class MotionColumn:
    """One column of the dataset; ``since`` is the version that brought it."""

    name: str
    type: "pa.DataType"
    unit: str
    meaning: str
    since: int = 1


def _vector(name: str, unit: str, meaning: str) -> list[MotionColumn]:
    return [MotionColumn(name.format(c), pa.float64(), unit, f"{meaning}: {c}") for c in "xyz"]


COLUMNS: tuple[MotionColumn, ...] = (
    MotionColumn("run_id", pa.string(), "", "the recording"),
    MotionColumn("results_id", pa.string(), "", "its processing: same numbers, same id"),
    MotionColumn("simulated", pa.bool_(), "", "whether the recording is simulated"),
    MotionColumn(
        "seen_from", pa.string(), "", "camera (what this unit saw) or base (what its assembly makes of it)"
    ),
    MotionColumn("component", pa.string(), "", "seen from the base; null in rows seen from the camera"),
    MotionColumn(
        "kind", pa.string(), "", "what fixes the instant: edge (sample), imu (slot) or frame (picture)"
    ),
    MotionColumn(
        "sample",
        pa.float64(),
        "1",
        "the laboratory's sample number, corrected for slips; whole at edges; NaN without a square wave",
    ),
    MotionColumn(
        "sample_agreement",
        pa.string(),
        "",
        "whether the test's units agree on it: agrees, corrected, "
        "contradictory, unknown, none (no edges), alone (added without its test)",
    ),
    MotionColumn(
        "lab_s", pa.float64(), "s", "sample number over the wave's nominal frequency; NaN if that is not told"
    ),
    MotionColumn(
        "t_s", pa.float64(), "s", "instant since the unit's trigger, its own clock; NaN if seen from the base"
    ),
    MotionColumn(
        "t_ns", pa.int64(), "ns", "instant, CLOCK_MONOTONIC of the unit; null if seen from the base"
    ),
    *_vector("d{}_mm", "mm", "displacement from rest"),
    *_vector("drvec_{}_rad", "rad", "rotation vector from rest"),
    *_vector("dangle_{}_deg", "deg", "intrinsic XYZ angle from rest"),
    *_vector(
        "sd_d{}_mm",
        "mm",
        "standard deviation of the displacement; the rest pose's own is in it",
    ),
    *_vector("sd_rot_{}_deg", "deg", "standard deviation of the rotation from rest, axes of what moves"),
    *_vector(
        "dv_{}_mmps", "mm/s", "velocity of the first LED, brick axes at rest; NaN if seen from the base"
    ),
    *_vector("omega_{}_radps", "rad/s", "angular rate, brick axes; NaN if seen from the base"),
    MotionColumn("measured", pa.bool_(), "", "whether the motion is known and not extrapolated"),
    MotionColumn(
        "flags", pa.int64(), "bits", "PoseFlag bits; of all views in the chain if seen from the base"
    ),
    MotionColumn("flag_words", pa.string(), "", "names of the PoseFlag bits, parted by |"),
)


def columns_of(version: int) -> tuple[MotionColumn, ...]:
    """Return the columns of a version of the schema."""
    return tuple(column for column in COLUMNS if column.since <= version)


def motion_schema(metadata: dict[str, str] | None = None) -> "pa.Schema":
    """Return the schema of this version, each column with its unit and meaning."""
    fields = [
        pa.field(c.name, c.type, metadata={"unit": c.unit, "meaning": c.meaning})
        for c in columns_of(MOTION_VERSION)
    ]
    keys: dict[str | bytes, str | bytes] = dict((metadata or {}).items())
    return pa.schema(fields, metadata=keys)


def partition_schema() -> "pa.Schema":
    """Return the types of the keys in the folders' names: words, though they may look like numbers."""
    return pa.schema([(key, pa.string()) for key in PARTITION_KEYS])


def require_known_version(version: Any, where: object) -> int:
    """Return a version of the schema.

    Raises
    ------
    RunFormatError
        If it is none, or newer than this bricktrack knows.
    """
    if not isinstance(version, int) or version < 1:
        raise RunFormatError(f"{where}: {MOTION_SCHEMA} version {version!r}; expected a whole number from 1")
    if version > MOTION_VERSION:
        raise RunFormatError(
            f"{where}: {MOTION_SCHEMA} version {version}; this bricktrack reads up to version "
            f"{MOTION_VERSION}. Upgrade bricktrack on this machine"
        )
    return version
