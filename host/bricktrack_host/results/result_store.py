"""The processed result of a run, on disk: Parquet tables, their CSV twins and a summary, all or nothing.

Everything but `timings.json` depends on the recording, the settings and the software alone: the same run
processed again gives the same bytes.
"""

import hashlib
import importlib.metadata
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.checksums import sha256_file
from bricktrack_common.errors import RunFormatError
from bricktrack_common.run_manifest import MANIFEST_NAME, RunManifest
from bricktrack_common.typed_data import dump_json, load_json
from bricktrack_host.durable_files import kept_beside, write_folder_whole
from bricktrack_host.results.daq_clock import EdgeFit, fit_edges
from bricktrack_host.results.rest_entry import RestEntry, rest_entry, rest_pose_of
from bricktrack_host.results.rest_pose import FromRest, RestPose
from bricktrack_host.results.result_tables import (
    FusedKind,
    edges_table,
    fused_table,
    imu_table,
    leds_table,
    optical_table,
)
from bricktrack_host.results.table_columns import CONVENTIONS
from bricktrack_host.results.table_files import read_table, write_table
from bricktrack_host.results.tables_to_tracks import (
    fused_from_table,
    imu_camera_times,
    imu_from_table,
    optical_from_tables,
)
from bricktrack_host.tracks import FusedTrack, ImuTrack, LedObservations, OpticalTrack

RESULTS_SCHEMA = "bricktrack.results"
RESULTS_VERSION = 3
RESULTS_FOLDER = "results"
SUMMARY_NAME = "summary.json"
REPORT_NAME = "report.html"
TIMINGS_NAME = "timings.json"

DetailValue = str | int | float | bool | None | list[str | int | float | bool | None]
Details = dict[str, DetailValue]
"""Named facts for the summary and the report; names carry their units."""


class Provenance(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the numbers come from.

    Attributes
    ----------
    manifest_sha256 : str
        Of the run's manifest, which holds the hashes of everything recorded.
    calibration_sha256, layout_sha256 : str or None
        Of the files used; `None` where none was.
    settings : dict
        Every setting of the processing that can change a number.
    """

    manifest_sha256: str
    calibration_sha256: str | None
    layout_sha256: str | None
    software_version: str
    settings: Details = {}


@dataclass(frozen=True, eq=False, kw_only=True)
class RunResult:
    """Everything that processing one run gave.

    Attributes
    ----------
    manifest : RunManifest
    led_names : tuple of str
        In the layout's order, as the second axis of the LED arrays.
    observations : LedObservations
    optical : OpticalTrack
    fused : dict
        A `FusedTrack` for each of ``"imu"`` (sensor slots), ``"frame"`` and ``"edge"`` (square wave) that
        was made; empty if the fusion could not run.
    edge_index : ndarray of int64, shape (n,)
        Number of the rising edge of each row of ``fused["edge"]``.
    edge_fit : EdgeFit or None
    imu : ImuTrack or None
        The samples that the fusion used, brick axes.
    imu_camera_t_ns : ndarray of int64, shape (n,), or None
        When each of those samples was taken, on the camera's time; `None` where the clocks were not aligned.
    rest : RestPose or None
        Of the optical poses. `None`: nothing was quiet; displacements from rest are NaN.
    fused_rest : RestPose or None
        From which the fused motion is counted; `None`: from `rest`.
    moved_covariance : dict
        Of the fused motion from rest, (n, 6, 6) for each kind, where it was read; else it is worked out.
    alignment : dict
        What the time alignment found, as ``offset_ms``, ``offset_sd_ms``, ``skew_ppm``, ``method``.
    calibration : dict
        What to know of the calibration, as ``method``, ``rms_um``, ``date``, ``camera``.
    problems : tuple of str
        In words, the gravest first.
    timings_s : dict
        Wall time of each stage; kept apart from the numbers.
    """

    manifest: RunManifest
    led_names: tuple[str, ...]
    observations: LedObservations
    optical: OpticalTrack
    fused: dict[FusedKind, FusedTrack]
    edge_index: IntArray
    edge_fit: EdgeFit | None
    imu: ImuTrack | None
    rest: RestPose | None
    alignment: Details
    calibration: Details
    problems: tuple[str, ...]
    provenance: Provenance
    timings_s: dict[str, float] = field(default_factory=dict)
    imu_camera_t_ns: IntArray | None = None
    fused_rest: RestPose | None = None
    moved_covariance: dict[FusedKind, FloatArray] = field(default_factory=dict)

    @property
    def t0_ns(self) -> int | None:
        """Return the trigger, CLOCK_MONOTONIC of the unit; `None` if none came."""
        return self.manifest.trigger.t0_ns

    @cached_property
    def from_rest(self) -> dict[str, FromRest]:
        """The poses as seen from rest: ``"optical"`` and each kind of `fused`; empty without a rest pose.

        Worked out once, for all who show it.
        """
        if self.rest is None:
            return {}
        seen, rest = {"optical": self.rest.from_rest(self.optical)}, self.fused_rest or self.rest
        for kind, track in self.fused.items():
            seen[kind] = rest.from_rest(track, covariance=self.moved_covariance.get(kind))
        return seen


class _Summary(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    schema: str = RESULTS_SCHEMA
    version: int = RESULTS_VERSION
    run_id: str
    unit: str
    simulated: bool
    problems: list[str]
    led_names: list[str]
    conventions: dict[str, str]
    tables: dict[str, int]
    rest_pose: RestEntry | None
    fused_rest_pose: RestEntry | None = None
    square_wave: Details | None
    alignment: Details
    calibration: Details
    acc_range_mps2: float | None
    provenance: Provenance
    manifest: RunManifest


def software_version() -> str:
    """Return the installed version of bricktrack."""
    return importlib.metadata.version("bricktrack")


def write_results(
    result: RunResult, folder: Path, *, also: Callable[[Path], object] | None = None
) -> Path | None:
    """Write a run's results; those of an earlier processing that say something else are kept beside them.

    The folder is written whole or not at all; see `write_folder_whole`.

    Parameters
    ----------
    result : RunResult
    folder : Path
        As ``<run folder>/results``.
    also : callable, optional
        Writes more files into the folder that it is given, before that takes its name.

    Returns
    -------
    earlier : Path or None
        Where the results of before are kept now, as ``<run folder>/results_1``; `None` where there were none,
        or they were the same to the last bit.

    Raises
    ------
    StorageError
        If the folder exists and holds something else than results, or cannot be written.
    """

    def write(partial: Path) -> None:
        _write_files(result, partial)
        if also is not None:
            also(partial)

    return write_folder_whole(
        folder, write, marker=SUMMARY_NAME, keep_if=lambda new, old: results_id(new) != results_id(old)
    )


def results_of(run: Path) -> Path:
    """Return the results folder of a run, or the folder itself where it holds the results."""
    return run / RESULTS_FOLDER if (run / MANIFEST_NAME).is_file() else run


def earlier_results(folder: Path) -> list[Path]:
    """Return the results of earlier processings that are kept beside a results folder, the oldest first."""
    return kept_beside(folder, marker=SUMMARY_NAME)


def results_id(folder: Path) -> str:
    """Return what names a processing of a run: 16 hexadecimal digits of a hash of its summary and tables.

    Results of the same numbers have the same id, whenever and wherever they were made.
    """
    return content_id(folder, SUMMARY_NAME)


def content_id(folder: Path, summary: str) -> str:
    """Return 16 hexadecimal digits of a hash of a folder's summary and tables, and of nothing else there."""
    names = sorted(p.name for p in folder.iterdir() if p.name == summary or p.suffix == ".parquet")
    listed = "".join(f"{name} {sha256_file(folder / name)}\n" for name in names)
    return hashlib.sha256(listed.encode()).hexdigest()[:16]


def _write_files(result: RunResult, folder: Path) -> None:
    t0_ns = result.t0_ns
    metadata = _table_metadata(result)
    n_rows: dict[str, int] = {}

    def write(name: str, table: Any) -> None:
        write_table(table, folder, name)
        n_rows[name] = table.num_rows

    # One after the other: a long run's are as large as all that they are made of.
    write("optical", optical_table(
        result.optical, result.observations, t0_ns=t0_ns, from_rest=result.from_rest.get("optical"),
        edge_fit=result.edge_fit, metadata=metadata,
    ))  # fmt: skip
    write("fused", fused_table(
        result.fused, edge_index=result.edge_index, t0_ns=t0_ns, rest=result.fused_rest or result.rest,
        from_rest=result.from_rest, edge_fit=result.edge_fit, metadata=metadata,
    ))  # fmt: skip
    write(
        "leds",
        leds_table(result.observations, result.optical, result.led_names, t0_ns=t0_ns, metadata=metadata),
    )
    if result.imu is not None:
        write("imu", imu_table(result.imu, result.imu_camera_t_ns, t0_ns=t0_ns, metadata=metadata))
    if result.edge_fit is not None:
        write("edges", edges_table(result.edge_fit, t0_ns=t0_ns, metadata=metadata))
    summary = _Summary(
        run_id=result.manifest.run_id,
        unit=result.manifest.unit,
        simulated=result.manifest.simulated,
        problems=list(result.problems),
        led_names=list(result.led_names),
        conventions=CONVENTIONS,
        tables=n_rows,
        rest_pose=rest_entry(result.rest),
        fused_rest_pose=rest_entry(result.fused_rest, with_rays=False),
        square_wave=_square_wave(result.edge_fit),
        alignment=result.alignment,
        calibration=result.calibration,
        acc_range_mps2=None if result.imu is None else result.imu.acc_range_mps2,
        provenance=result.provenance,
        manifest=result.manifest,
    )
    (folder / SUMMARY_NAME).write_bytes(dump_json(summary))
    (folder / TIMINGS_NAME).write_bytes(dump_json(result.timings_s))


def read_provenance(folder: Path) -> Provenance:
    """Return what results are of, without their tables.

    Raises
    ------
    RunFormatError
        If the folder holds no results, or of a newer version.
    """
    return _read_summary(folder).provenance


def read_result(folder: Path) -> RunResult:
    """Return the results that `write_results` wrote.

    Raises
    ------
    RunFormatError
        If the folder holds no results, is of a newer version, or a table is missing or damaged.
    """
    summary = _read_summary(folder)
    tables = {name: read_table(folder / f"{name}.parquet", rows) for name, rows in summary.tables.items()}
    for name in ("optical", "fused", "leds"):
        if name not in tables:
            raise RunFormatError(f"{folder / SUMMARY_NAME}: tables: no '{name}'")
    optical, observations = optical_from_tables(tables["optical"], tables["leds"], len(summary.led_names))
    fused, moved_covariance, edge_index = fused_from_table(tables["fused"])
    rest = rest_pose_of(summary.rest_pose)
    imu = imu_camera_t_ns = None
    if "imu" in tables:
        imu_camera_t_ns = imu_camera_times(tables["imu"])
        imu = imu_from_table(
            tables["imu"], np.nan if summary.acc_range_mps2 is None else summary.acc_range_mps2
        )
    edge_fit = None
    if "edges" in tables:
        nominal_hz = summary.manifest.trigger.nominal_hz
        edge_fit = fit_edges(tables["edges"].column("t_ns").to_numpy(), nominal_hz)
    timings = folder / TIMINGS_NAME
    return RunResult(
        manifest=summary.manifest,
        led_names=tuple(summary.led_names),
        observations=observations,
        optical=optical,
        fused=fused,
        edge_index=edge_index,
        edge_fit=edge_fit,
        imu=imu,
        imu_camera_t_ns=imu_camera_t_ns,
        rest=rest,
        fused_rest=rest_pose_of(summary.fused_rest_pose, rays_of=rest),
        moved_covariance=moved_covariance,
        alignment=summary.alignment,
        calibration=summary.calibration,
        problems=tuple(summary.problems),
        provenance=summary.provenance,
        timings_s=load_json(timings, dict[str, float]) if timings.is_file() else {},
    )


def _why_no_results(folder: Path) -> str:
    if folder.is_file():
        return "a file; expected a processed run, or its results"
    if any(folder.glob(f"*/{MANIFEST_NAME}")):
        return "a folder of runs. Name one of them"
    lacks = f"no {SUMMARY_NAME}; this is no results folder" if folder.is_dir() else "no such folder"
    return f"{lacks}. Process the run first"


def _read_summary(folder: Path) -> _Summary:
    path = folder / SUMMARY_NAME
    if not path.is_file():
        raise RunFormatError(f"{folder}: {_why_no_results(folder)}")
    head = load_json(path, dict[str, Any])
    if head.get("schema") != RESULTS_SCHEMA or not isinstance(head.get("version"), int):
        raise RunFormatError(f"{path}: not a {RESULTS_SCHEMA} summary")
    if head["version"] > RESULTS_VERSION:
        raise RunFormatError(
            f"{path}: {RESULTS_SCHEMA} version {head['version']}; this bricktrack reads up to version "
            f"{RESULTS_VERSION}. Upgrade bricktrack on this machine"
        )
    return load_json(path, _Summary)


def _table_metadata(result: RunResult) -> dict[str, str]:
    metadata = {f"bricktrack.{name.replace(' ', '_')}": words for name, words in CONVENTIONS.items()}
    metadata |= {
        "bricktrack.schema": RESULTS_SCHEMA,
        "bricktrack.version": str(RESULTS_VERSION),
        "bricktrack.run_id": result.manifest.run_id,
        "bricktrack.unit": result.manifest.unit,
        "bricktrack.simulated": "true" if result.manifest.simulated else "false",
        "bricktrack.trigger_ns": "none" if result.t0_ns is None else str(result.t0_ns),
        "bricktrack.rest_pose": msgspec.json.encode(rest_entry(result.rest, with_rays=False)).decode(),
        "bricktrack.provenance": msgspec.json.encode(result.provenance).decode(),
    }
    return metadata


def _square_wave(fit: EdgeFit | None) -> Details | None:
    if fit is None:
        return None
    return {
        "edges": fit.n_edges,
        "edges_missed": int(fit.missed_index.size),
        "edges_extra": int(np.count_nonzero(fit.is_extra)),
        "nominal_hz": fit.nominal_hz,
        "period_ns": fit.period_ns,
        "period_sd_ns": fit.period_sd_ns,
        "t0_ns": fit.t0_ns,
        "t0_fraction_ns": fit.t0_fraction_ns,
        "t0_sd_ns": fit.t0_sd_ns,
        "rate_ppm": fit.rate_ppm,
        "rate_sd_ppm": fit.rate_sd_ppm,
        "residual_rms_ns": fit.residual_rms_ns,
        "residual_max_ns": fit.residual_max_ns,
    }
