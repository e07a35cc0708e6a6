"""Rows of a campaign's dataset, from a processed run and from the assembly that its unit belongs to."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa

from bricktrack_common.arrays import FloatArray
from bricktrack_common.errors import RunFormatError
from bricktrack_host.assemblies.motion_history import NOT_MEASURED
from bricktrack_host.datasets.motion_schema import CONVENTIONS, MOTION_SCHEMA, MOTION_VERSION, motion_schema
from bricktrack_host.results.export import read_run_table
from bricktrack_host.results.result_store import RunResult, read_result, results_id, software_version
from bricktrack_host.results.run_summary import key_figures, verdict


@dataclass(frozen=True, slots=True, eq=False)
class ComponentRows:
    """A component that a unit is the last to see, of the table of its assembly.

    Attributes
    ----------
    component, base : str
    chain : tuple of str
        Units whose views lead from the base to it.
    table : pyarrow.Table
        Of the component alone, as `read_components` gives it.
    """

    component: str
    base: str
    chain: tuple[str, ...]
    table: "pa.Table"


@dataclass(frozen=True, slots=True, eq=False)
class UnitSource:
    """What there is to add of one unit in one test.

    Attributes
    ----------
    test, unit : str
    assembly : str or None
    results : Path
        Results folder of its run.
    slip_samples : int
        To be added to its sample numbers.
    sample_agreement : str
        See the column of this name.
    with_camera_rows : bool
        False for the second and later assemblies of a unit: what its camera saw is in the first.
    components : sequence of ComponentRows
    """

    test: str
    unit: str
    assembly: str | None
    results: Path
    slip_samples: int = 0
    sample_agreement: str = "alone"
    with_camera_rows: bool = True
    components: Sequence[ComponentRows] = field(default=())


def identity_of(source: UnitSource) -> str:
    """Return a hash of everything that the rows are made of: equal ids, equal rows."""
    parts = [
        MOTION_SCHEMA, str(MOTION_VERSION), source.test, str(source.assembly), source.unit,
        results_id(source.results), str(source.slip_samples), source.sample_agreement,
        str(source.with_camera_rows),
    ]  # fmt: skip
    digest = hashlib.sha256("\n".join(parts).encode())
    for rows in source.components:
        digest.update("\n".join(("", rows.component, rows.base, *rows.chain, "")).encode())
        for column in rows.table.select(sorted(set(rows.table.column_names) - {"flag_words"})).columns:
            values: Any = column.combine_chunks()
            flat = values.flatten() if pa.types.is_fixed_size_list(values.type) else values
            if pa.types.is_string(flat.type):
                digest.update("\n".join(map(str, flat.to_pylist())).encode())
            else:
                digest.update(np.ascontiguousarray(flat.to_numpy(zero_copy_only=False)).tobytes())
    return digest.hexdigest()[:16]


def unit_rows(source: UnitSource, source_id: str) -> "pa.Table":
    """Return the rows of one unit: what its camera saw, then the components that it is the last to see.

    ``source_id`` is `identity_of` the source, and stands in the table's metadata.

    Raises
    ------
    RunFormatError
        If its results cannot be read, or are of another unit.
    """
    result = read_result(source.results)
    if result.manifest.unit != source.unit:
        raise RunFormatError(
            f"{source.results}: results of unit {result.manifest.unit!r}, not {source.unit!r}"
        )
    identity = results_id(source.results)
    schema = motion_schema(_metadata(source, result, identity, source_id))
    tables = [_camera_rows(source, result)] if source.with_camera_rows else []
    tables += [_base_rows(rows.table) for rows in source.components]
    common = {
        "run_id": result.manifest.run_id,
        "results_id": identity,
        "simulated": result.manifest.simulated,
        "sample_agreement": source.sample_agreement,
    }
    return (
        pa.concat_tables([_in_schema(rows, common, schema) for rows in tables])
        if tables
        else schema.empty_table()
    )


def _camera_rows(source: UnitSource, result: RunResult) -> dict[str, Any]:
    table = read_run_table(source.results, "fused")
    if not result.fused:  # the tables hold no row then
        table = table.slice(0, 0)
    at_edge = np.array(table.column("kind").to_pylist(), dtype=object) == "edge"
    numbers = np.array(
        [np.nan if x is None else x for x in table.column("edge_index").to_pylist()], dtype=np.float64
    )
    sample = np.where(at_edge, numbers, table.column("daq_sample").to_numpy()) + source.slip_samples
    rows = _columns_kept(table)
    for axis in "xyz":  # motion here is from rest; results of version 1 have the camera's own deviation alone
        if f"sd_drot_{axis}_deg" in table.column_names:
            rows[f"sd_rot_{axis}_deg"] = table.column(f"sd_drot_{axis}_deg").combine_chunks()
    hz = result.manifest.trigger.nominal_hz
    rows["sample"] = sample
    rows["lab_s"] = np.full(len(sample), np.nan) if hz is None else sample / hz
    rows["seen_from"] = "camera"
    return rows


def _base_rows(table: "pa.Table") -> dict[str, Any]:
    rows = _columns_kept(table)
    rows["sample"] = table.column("sample").to_numpy().astype(np.float64)
    rows["kind"] = "edge"
    rows["seen_from"] = "base"
    return rows


def _columns_kept(table: "pa.Table") -> dict[str, Any]:
    """Return the columns that a dataset takes over as they are."""
    names = (name for name in table.column_names if name in motion_schema().names and name != "sample")
    return {name: table.column(name).combine_chunks() for name in names}


def _in_schema(rows: Mapping[str, Any], common: Mapping[str, Any], schema: "pa.Schema") -> "pa.Table":
    """Return rows with every column of the schema: NaN, or null, in those that they do not have."""
    n = len(rows["sample"])
    displacement = np.stack([np.asarray(rows[f"d{c}_mm"]) for c in "xyz"], axis=1)
    given = {**rows, **common, "measured": _measured(displacement, rows)}
    arrays: list[Any] = []
    for wanted in schema:
        value = given.get(wanted.name)
        if value is None:
            is_float = pa.types.is_floating(wanted.type)
            arrays.append(pa.array(np.full(n, np.nan)) if is_float else pa.nulls(n, wanted.type))
        elif isinstance(value, str | bool):
            arrays.append(pa.array([value] * n, type=wanted.type))
        else:
            arrays.append(value if isinstance(value, pa.Array) else pa.array(value, type=wanted.type))
    return pa.Table.from_arrays(arrays, schema=schema)


def _measured(displacement_mm: FloatArray, rows: Mapping[str, Any]) -> Any:
    flags = np.asarray(rows["flags"], dtype=np.int64)
    return np.isfinite(displacement_mm).all(axis=1) & (flags & int(NOT_MEASURED) == 0)


def _metadata(source: UnitSource, result: RunResult, identity: str, source_id: str) -> dict[str, str]:
    chains = {rows.component: [rows.base, *rows.chain] for rows in source.components}
    return {f"bricktrack.{name.replace(' ', '_')}": words for name, words in CONVENTIONS.items()} | {
        "bricktrack.schema": MOTION_SCHEMA,
        "bricktrack.version": str(MOTION_VERSION),
        "bricktrack.source": source_id,
        "bricktrack.test": source.test,
        "bricktrack.assembly": source.assembly or "",
        "bricktrack.unit": source.unit,
        "bricktrack.run_id": result.manifest.run_id,
        "bricktrack.results_id": identity,
        "bricktrack.simulated": "true" if result.manifest.simulated else "false",
        "bricktrack.slip_samples": str(source.slip_samples),
        "bricktrack.sample_agreement": source.sample_agreement,
        "bricktrack.chains": msgspec.json.encode(chains).decode(),
        "bricktrack.problems": msgspec.json.encode(verdict(result, key_figures(result))[1]).decode(),
        "bricktrack.provenance": msgspec.json.encode(result.provenance).decode(),
        "bricktrack.added_by": f"bricktrack {software_version()}",
    }
