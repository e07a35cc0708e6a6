"""``processing.json``, beside results: of what they were made, so that they need not be made again, and how.

Unlike the results themselves it says where they were made and what that took, so it differs each time.
"""

import hashlib
import platform
import resource
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import msgspec

from bricktrack_common.checksums import sha256_file
from bricktrack_common.errors import RunFormatError, StorageError
from bricktrack_common.run_manifest import MANIFEST_NAME, read_manifest
from bricktrack_common.typed_data import dump_json, load_json
from bricktrack_host.durable_files import replace_durably, storage_errors
from bricktrack_host.many_runs.software_identity import code_sha256

RECORD_NAME = "processing.json"


class Took(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the processing of a run took.

    Attributes
    ----------
    wall_s, cpu_s : float
    peak_memory_mb : float
        Largest that the process has been so far.
    machine : str
        Its host name.
    """

    wall_s: float
    cpu_s: float
    peak_memory_mb: float
    machine: str


class ProcessingRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The file.

    Attributes
    ----------
    input_sha256 : str
        Over everything that the results depend on: recording, calibration, layout, truth, settings, code.
    """

    schema: str = "bricktrack.processing"
    version: Annotated[int, msgspec.Meta(ge=1, le=1)] = 1
    input_sha256: str
    took: Took


class Stopwatch:
    """Measures what is done from its making on."""

    def __init__(self) -> None:
        self._wall_s, self._cpu_s = time.perf_counter(), time.process_time()

    def read(self) -> Took:
        """Return what it took until now."""
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return Took(
            wall_s=round(time.perf_counter() - self._wall_s, 3),
            cpu_s=round(time.process_time() - self._cpu_s, 3),
            peak_memory_mb=round(peak / 2**20 if sys.platform == "darwin" else peak / 1024, 1),
            machine=platform.node(),
        )


def input_sha256(run: Path, files: dict[str, Path | None], settings: Any) -> str:
    """Return a hash of everything that a run's results depend on.

    The manifest stands for the files that it lists with their hashes, which processing checks; their sizes
    on this disk are taken too, because a file that was cut or is gone is a problem and no error.

    Parameters
    ----------
    run : Path
    files : dict
        Other files that are read, by what they are; `None` where there is none.
    settings : msgspec.Struct

    Raises
    ------
    RunFormatError
        If the run has no manifest.
    StorageError
        If one of the files cannot be read.
    """
    manifest = read_manifest(run / MANIFEST_NAME)
    with storage_errors(run, "Is it all there?"):
        parts = {
            "manifest": sha256_file(run / MANIFEST_NAME),
            "sizes": {f.name: _size(run / f.name) for f in manifest.files},
            "files": {what: None if path is None else _sha256_of(what, path) for what, path in files.items()},
            "settings": msgspec.to_builtins(settings),
            "code": code_sha256(),
        }
    return hashlib.sha256(msgspec.json.encode(parts, order="sorted")).hexdigest()


def _sha256_of(what: str, path: Path) -> str:
    with storage_errors(path, f"It is to hold the run's {what}; name another with --{what} or in fleet.toml"):
        return sha256_file(path)


def _size(path: Path) -> int | None:
    return path.stat().st_size if path.is_file() else None


def write_record(folder: Path, record: ProcessingRecord) -> None:
    """Write a record into a results folder, replacing one of before.

    Raises
    ------
    StorageError
        If it cannot be written.
    """
    path = folder / RECORD_NAME
    with storage_errors(path, "Make room"):
        replace_durably(path, dump_json(record))


def read_record(folder: Path) -> ProcessingRecord | None:
    """Return a results folder's record; `None` if it has none, or one that cannot be read."""
    try:
        return load_json(folder / RECORD_NAME, ProcessingRecord)
    except (RunFormatError, StorageError, OSError):
        return None
