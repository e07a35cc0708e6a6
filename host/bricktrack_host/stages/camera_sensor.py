"""The stage of a camera that moves: the samples of what feels its motion, in camera axes and camera time.

They are in the run itself, in the run of another unit whose LED component carries this camera, or in a table
of the laboratory's data acquisition. Another unit's clock, and the laboratory's, meet this unit's by the
rising edges that both saw.
"""

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import msgspec
import numpy as np

from bricktrack_common.checksums import sha256_file
from bricktrack_common.errors import ConfigError, RunFormatError
from bricktrack_common.imu_records import STANDARD_GRAVITY_MPS2
from bricktrack_common.run_folder import Run, read_run
from bricktrack_common.run_manifest import MANIFEST_NAME, RunManifest, read_manifest
from bricktrack_host.results.daq_clock import EdgeFit, EdgeFitError, fit_edges
from bricktrack_host.results.daq_table import read_daq_csv
from bricktrack_host.tracks import ImuTrack
from bricktrack_host.transfer.camera_config import AccelerationUnit, CameraTableEntry
from bricktrack_host.transfer.fleet_config import UnitConfig

if TYPE_CHECKING:
    from bricktrack_host.fusion.pose_by_pose.moving_camera import CameraImu

_Vector = tuple[float, float, float]
_SAME_SHAKE_NS = 5_000_000_000  # clocks set by a time server; shakes are minutes apart
_CLOCKS_WITHIN = 1e-3  # units of one shake see one wave, by crystals


class CameraSensor(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What feels the camera's motion; stored with the results.

    Attributes
    ----------
    kind : "imu" or "table"
    source : str, path
        Another unit's run folder, or the CSV file of the table; ``""`` for a sensor of the run itself.
        Relative to the run folder.
    source_sha256 : str
        Of that run's manifest, or of the CSV file.
    imu : str
        Name of the inertial sensor in its run.
    columns, measured_in, sample_column, first_sample
        Of the CSV file, see `CameraTableEntry` and `read_daq_csv`.
    to_camera_mm : (float, float, float), mm, camera axes
        From the sensor to the projection centre; of a table that only shifts no matter.
    rotation : 3 x 3
        Takes the sensor's axes to the camera's.
    """

    kind: Literal["imu", "table"]
    source: str = ""
    source_sha256: str = ""
    imu: str = ""
    columns: tuple[str, str, str] | None = None
    measured_in: AccelerationUnit = "mps2"
    sample_column: str | None = None
    first_sample: int = 0
    to_camera_mm: _Vector = (0.0, 0.0, 0.0)
    rotation: tuple[_Vector, _Vector, _Vector]


def choose_camera_sensor(
    run: Path,
    unit: UnitConfig,
    *,
    camera_run: Path | None = None,
    table: Path | None = None,
    sample_column: str | None = None,
    first_sample: int = 0,
) -> CameraSensor | None:
    """Return what feels the motion of a unit's camera in one of its runs, or `None` if nothing is known to.

    Parameters
    ----------
    run : Path
        The run folder.
    unit : UnitConfig
    camera_run : Path, optional
        Run of the unit that carries the camera's sensor; looked for beside ``run`` if not given.
    table : Path, optional
        CSV file of the table's accelerometers during this run.
    sample_column, first_sample
        As `read_daq_csv`.

    Raises
    ------
    ConfigError
        If a file is named that this camera has no use for, or the other unit's run is not there, or several.
    """
    entry = unit.camera_imu
    if table is not None and unit.camera_table is None:
        raise ConfigError(
            f"{table}: by the fleet file the camera of unit '{unit.name}' does not move with the table. "
            'Give the unit camera = "table" and a [unit.camera_table]'
        )
    if camera_run is not None and (entry is None or not entry.unit):
        raise ConfigError(
            f"{camera_run}: the fleet file does not say that another unit's sensor moves with the camera of "
            f"unit '{unit.name}'. Give the unit a [unit.camera_imu] with that unit's name"
        )
    if unit.camera_table is not None and table is not None:
        return _of_table(run, unit.camera_table, table, sample_column, first_sample)
    if entry is None:
        return None
    other = None
    if entry.unit:
        other = camera_run or _run_beside(run, entry.unit)
        if read_manifest(other / MANIFEST_NAME).unit != entry.unit:
            raise ConfigError(
                f"{other}: not a run of unit '{entry.unit}', whose sensor moves with the camera"
            )
    return CameraSensor(
        kind="imu",
        source="" if other is None else _seen_from(run, other),
        source_sha256="" if other is None else sha256_file(other / MANIFEST_NAME),
        imu=entry.imu,
        to_camera_mm=entry.to_camera_mm,
        rotation=entry.rotation,
    )


def _of_table(
    run: Path, entry: CameraTableEntry, table: Path, sample_column: str | None, first_sample: int
) -> CameraSensor:
    if not table.is_file():
        raise ConfigError(f"{table}: no such file; expected the table's accelerations as CSV")
    return CameraSensor(
        kind="table",
        source=_seen_from(run, table),
        source_sha256=sha256_file(table),
        columns=entry.columns,
        measured_in=entry.measured_in,
        sample_column=sample_column,
        first_sample=first_sample,
        rotation=entry.rotation,
    )


def _run_beside(run: Path, unit: str) -> Path:
    """Return the other unit's run of the same shake: beside this one, with the same label."""
    manifest = read_manifest(run / MANIFEST_NAME)
    label, date_ns = manifest.label, _date_ns(manifest)
    dates_ns = {
        path: _date_ns(other)
        for path in sorted(run.resolve().parent.glob(f"{unit}_*"))
        if (path / MANIFEST_NAME).is_file()
        and (other := read_manifest(path / MANIFEST_NAME)).unit == unit
        and other.label == label
    }
    found = list(dates_ns)
    if len(found) > 1 and date_ns is not None:  # the test was recorded more than once
        found = [p for p, d in dates_ns.items() if d is not None and abs(d - date_ns) < _SAME_SHAKE_NS]
        found = found or list(dates_ns)
    if len(found) != 1 or not label:
        raise ConfigError(
            f"{run}: the sensor that moves with its camera is unit '{unit}''s, and beside this run there "
            f"{'is none' if not found else f'are {len(found)} runs'} of that unit labelled {label!r}. "
            "Name the one of the same shake with --camera-run"
        )
    return found[0]


def _date_ns(manifest: RunManifest) -> int | None:
    """Return the first edge by the unit's calendar clock, which may never have been set."""
    triplet = manifest.clocks.trigger or manifest.clocks.arm
    return None if triplet is None else triplet.realtime_ns


def _seen_from(run: Path, other: Path) -> str:
    try:
        return Path(os.path.relpath(other.resolve(), run.resolve())).as_posix()
    except ValueError:  # another drive
        return str(other.resolve())


def read_camera_sensor(
    run: Run, sensor: CameraSensor, edge_fit: EdgeFit | None, problems: list[str]
) -> "CameraImu | None":
    """Return the samples of what feels the camera's motion, or `None` and why.

    Parameters
    ----------
    run : Run
    sensor : CameraSensor
    edge_fit : EdgeFit or None
        The square wave as this unit saw it.
    problems : list of str
        What is missing, or harmed, is added in words.

    Raises
    ------
    ConfigError
        If the sensor named is not in its run, or its file is not the one chosen.
    RunFormatError
        If a file cannot be read.
    """
    from bricktrack_host.fusion.pose_by_pose.moving_camera import CameraImu

    if sensor.kind == "table":
        imu = _table_samples(run, sensor, edge_fit, problems)
    elif sensor.source:
        imu = _samples_of_another(run, sensor, edge_fit, problems)
    else:
        imu = _samples(run, sensor.imu)
    if imu is None:
        return None
    R = np.array(sensor.rotation)
    in_camera = replace(imu, acc_mps2=imu.acc_mps2 @ R.T, gyro_radps=imu.gyro_radps @ R.T)
    return CameraImu(in_camera, np.array(sensor.to_camera_mm, dtype=np.float64), sensor.kind)


def _samples(run: Run, name: str) -> ImuTrack:
    """Return the samples of a sensor in its own axes."""
    if name not in run.imus:
        raise ConfigError(
            f"{run.folder}: no IMU '{name}' to feel the camera's motion; the run has: "
            f"{', '.join(run.imus) or 'none'}. Name it as [unit.camera_imu] imu in the fleet file"
        )
    description, samples = run.imus[name]
    return ImuTrack(
        t_ns=samples.t_ns,
        acc_mps2=samples.acc_mps2,
        gyro_radps=samples.gyro_radps,
        flags=samples.flags,
        acc_range_mps2=description.acc_range_g * STANDARD_GRAVITY_MPS2,
    )


def _samples_of_another(
    run: Run, sensor: CameraSensor, edge_fit: EdgeFit | None, problems: list[str]
) -> ImuTrack | None:
    """Return the samples of another unit's sensor with this unit's stamps, by the edges that both saw."""
    folder = run.folder / sensor.source
    if _hash_of(folder / MANIFEST_NAME) != sensor.source_sha256:
        raise ConfigError(f"{folder}: not the run whose sensor was chosen to feel the camera's motion")
    other = read_run(folder, verify_hashes=True)
    try:
        theirs = fit_edges(other.edges_ns, other.manifest.trigger.nominal_hz)
    except EdgeFitError as e:
        problems.append(f"the camera's sensor is in {folder.name}, whose clock is not known here: {e}")
        return None
    if edge_fit is None:
        problems.append(
            f"the camera's sensor is in {folder.name}, and without edges of the square wave here its clock "
            "is not known"
        )
        return None
    if abs(theirs.period_ns / edge_fit.period_ns - 1) > _CLOCKS_WITHIN:
        raise ConfigError(
            f"{folder}: saw a square wave of {1e9 / theirs.period_ns:.4g} Hz, and {run.folder.name} one of "
            f"{1e9 / edge_fit.period_ns:.4g} Hz: not the same shake"
        )
    imu = _samples(other, sensor.imu)
    return replace(imu, t_ns=edge_fit.time_of_index(theirs.sample_index_of(imu.t_ns)))


def _table_samples(
    run: Run, sensor: CameraSensor, edge_fit: EdgeFit | None, problems: list[str]
) -> ImuTrack | None:
    """Return the table's accelerations, one a sample of the square wave, with this unit's stamps."""
    path = run.folder / sensor.source
    if edge_fit is None:
        problems.append(f"{path.name}: without edges of the square wave its samples have no time here")
        return None
    if _hash_of(path) != sensor.source_sha256:
        raise ConfigError(f"{path}: not the file that was chosen: it has changed since. Process again")
    table = read_daq_csv(path, sample_column=sensor.sample_column, first_sample=sensor.first_sample)
    names = sensor.columns or ()
    missing = [name for name in names if name not in table.column_names]
    if missing or not names:
        raise RunFormatError(
            f"{path}: no column {', '.join(missing)}; there are {', '.join(table.column_names)}. Name the "
            "table's channels as [unit.camera_table] columns in the fleet file"
        )
    try:
        acc = np.stack([table.column(name).to_numpy().astype(np.float64) for name in names], axis=1)
    except ValueError as e:
        raise RunFormatError(f"{path}: {', '.join(names)} must hold numbers: {e}") from e
    order = np.argsort(table.column("sample").to_numpy())
    acc = acc[order] * (STANDARD_GRAVITY_MPS2 if sensor.measured_in == "g" else 1.0)
    return ImuTrack(
        t_ns=edge_fit.time_of_index(table.column("sample").to_numpy()[order]),
        acc_mps2=acc,
        gyro_radps=np.zeros_like(acc),
        flags=np.zeros(len(acc), dtype=np.int64),
        acc_range_mps2=0.0,  # not known: nothing is taken for clipped
    )


def _hash_of(path: Path) -> str:
    try:
        return sha256_file(path)
    except OSError as e:
        raise ConfigError(
            f"{path}: cannot be read here ({e.strerror}); it holds what feels the camera's motion. Keep it "
            "where it was chosen, or process on a machine that sees it"
        ) from e
