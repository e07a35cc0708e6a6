"""A run that another machine processes: sent as a path or as bytes, its results brought back as bytes.

The worker reads and never writes what it shares with this machine. It gives back what it made, and this
machine puts that into the run's folder, whole or not at all: so nothing half-written is left wherever and
whenever a worker dies.
"""

import hashlib
import os
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from bricktrack_common.checksums import sha256_bytes, sha256_file
from bricktrack_common.errors import BricktrackError, ConfigError, TransferError
from bricktrack_common.run_manifest import MANIFEST_NAME, read_manifest
from bricktrack_common.typed_data import dump_json
from bricktrack_host.durable_files import storage_errors, write_folder_whole
from bricktrack_host.many_runs.one_at_a_time import alone_with
from bricktrack_host.many_runs.processing_record import RECORD_NAME, ProcessingRecord, Stopwatch
from bricktrack_host.many_runs.run_job import RunJob, RunSummary, summarise
from bricktrack_host.many_runs.software_identity import Identity, differences, identity
from bricktrack_host.many_runs.workers import RunProgress
from bricktrack_host.pipeline import REPORT_NAME, ProcessSettings, process_run
from bricktrack_host.results.result_store import SUMMARY_NAME, results_id

Files = dict[str, bytes]
"""Contents by name."""


@dataclass(frozen=True, slots=True)
class Parcel:
    """What a worker is sent.

    Attributes
    ----------
    run : Path
        Where the run is on this machine, and perhaps for the worker too.
    known_by : dict of str to str
        SHA-256 of files by their path from ``run``, by which the worker knows that they are there: the run's
        manifest, and what names the motion of a camera that moves.
    files : dict of str to bytes, or None
        All that is read of the run, and of another one if its sensor moves with the camera, by their path
        from ``run``; `None`: the worker shall find them there.
    calibration, layout : bytes
    truth : (str, bytes) or None
        Name and contents.
    settings : ProcessSettings
    software : dict
        The `identity` that the worker must have.
    """

    run: Path
    known_by: dict[str, str]
    files: Files | None
    calibration: bytes
    layout: bytes
    truth: tuple[str, bytes] | None
    settings: ProcessSettings
    software: Identity


@dataclass(frozen=True, slots=True)
class Returned:
    """What a worker gives back: the files of the results folder, their hash, and what it came to."""

    files: Files
    sha256: str
    summary: RunSummary


@dataclass(frozen=True, slots=True)
class NotThere:
    """What a worker gives back that was sent a path at which it finds no such run."""


def pack(job: RunJob, *, as_bytes: bool) -> Parcel:
    """Return what a worker is sent for a job, with the run's files or with their path alone.

    Raises
    ------
    RunFormatError, StorageError, ConfigError
        If something of it cannot be read.
    """
    run = job.run.resolve()
    names = _names_of(run, "")
    known_by = [MANIFEST_NAME]
    sensor = job.settings.camera_sensor
    if sensor is not None and sensor.source:
        others = [sensor.source] if sensor.kind == "table" else _names_of(run, f"{sensor.source}/")
        names += others
        known_by.append(others[0])
    truth = job.truth_file()
    with storage_errors(run, "Is it all there?"):
        return Parcel(
            run=run,
            known_by={name: sha256_file(run / name) for name in known_by},
            files={name: (run / name).read_bytes() for name in names} if as_bytes else None,
            calibration=job.calibration.read_bytes(),
            layout=job.layout.read_bytes(),
            truth=None if truth is None else (truth.name, truth.read_bytes()),
            settings=job.settings,
            software=identity(),
        )


def _names_of(run: Path, where: str) -> list[str]:
    """Return what is there of a run, the manifest first, as seen from ``run``."""
    listed = read_manifest(run / f"{where}{MANIFEST_NAME}").files
    present = [where + f.name for f in listed if (run / f"{where}{f.name}").is_file()]
    return [where + MANIFEST_NAME, *present]


def process_parcel(parcel: Parcel, progress: RunProgress) -> Returned | NotThere:
    """Process a run on the machine that was sent it.

    Raises
    ------
    ConfigError
        If other software computes here than where the results are wanted.
    BricktrackError
        As `pipeline.process_run`.
    """
    wrong = differences(parcel.software, identity())
    if wrong:
        raise ConfigError(f"the worker has other software: {wrong}. Install the same on both")
    with tempfile.TemporaryDirectory(prefix="bricktrack-") as name:
        scratch = Path(name)
        run = _unpacked(parcel, scratch) if parcel.files is not None else parcel.run
        if parcel.files is None and not _is_there(run, parcel.known_by):
            return NotThere()
        try:
            return _processed(parcel, run, scratch, progress)
        except BricktrackError as e:  # in the words of the machine that asked
            raise type(e)(str(e).replace(str(run), str(parcel.run))) from e


def _is_there(run: Path, known_by: dict[str, str]) -> bool:
    try:
        return all(sha256_file(run / name) == sha256 for name, sha256 in known_by.items())
    except OSError:
        return False


def _unpacked(parcel: Parcel, scratch: Path) -> Path:
    """Write a run's files as far down as the paths to its others lead up."""
    files = parcel.files or {}
    depth = max(PurePosixPath(name).parts.count("..") for name in files)
    run = scratch.joinpath(*["up"] * depth, parcel.run.name)
    run.mkdir(parents=True)
    for name, data in files.items():
        path = Path(os.path.normpath(run / name))
        if not path.is_relative_to(scratch):
            raise ConfigError(f"{name}: cannot be sent; it must be named relative to the run")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return run


def _processed(parcel: Parcel, run: Path, scratch: Path, progress: RunProgress) -> Returned:
    watch = Stopwatch()
    belongings = scratch / "belongings"
    belongings.mkdir()
    calibration, layout = belongings / "calibration.json", belongings / "layout.toml"
    calibration.write_bytes(parcel.calibration)
    layout.write_bytes(parcel.layout)
    truth = None
    if parcel.truth is not None:
        truth = belongings / parcel.truth[0]
        truth.write_bytes(parcel.truth[1])
    processed = process_run(
        run, calibration=calibration, layout=layout, output=scratch / "results", settings=parcel.settings,
        truth=truth, progress=progress,
    )  # fmt: skip
    files = {path.name: path.read_bytes() for path in sorted(processed.folder.iterdir())}
    return Returned(files, _hash_of(files), replace(summarise(processed), took=watch.read()))


def _hash_of(files: Files) -> str:
    listed = "".join(f"{name} {sha256_bytes(data)}\n" for name, data in sorted(files.items()))
    return hashlib.sha256(listed.encode()).hexdigest()


def publish(job: RunJob, input_sha256: str, returned: Returned) -> RunSummary:
    """Put what a worker gave back into the run's folder, whole or not at all.

    Raises
    ------
    TransferError
        If it is not what the worker sent.
    ConfigError
        If another command is at this run.
    StorageError
        If it cannot be written.
    """
    if _hash_of(returned.files) != returned.sha256:
        raise TransferError(f"{job.run.name}: its results were damaged on the way. Process it again")
    took = returned.summary.took
    files = dict(returned.files)
    if took is not None:
        files[RECORD_NAME] = dump_json(ProcessingRecord(input_sha256=input_sha256, took=took))

    def write(partial: Path) -> None:
        for name, data in files.items():
            (partial / name).write_bytes(data)

    with alone_with(job.run):
        earlier = write_folder_whole(
            job.results,
            write,
            marker=SUMMARY_NAME,
            keep_if=lambda new, old: results_id(new) != results_id(old),
        )
    return replace(returned.summary, folder=job.results, report=job.results / REPORT_NAME, earlier=earlier)
