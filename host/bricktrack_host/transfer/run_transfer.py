"""Copies one run from a unit: resumable, every chunk and file verified, and durable before it is confirmed.

A run under way lies in ``<run-id>.part/`` with a journal of what is verified; the folder gets its name only
when every file has the hash that the unit's manifest says and is on the disk. Killed at any moment, the next
pull goes on where this one was.
"""

import shutil
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Literal

from bricktrack_common.checksums import sha256_file
from bricktrack_common.errors import (
    RunFormatError,
    StorageError,
    TransferError,
    UnitError,
    UnitTimeoutError,
)
from bricktrack_common.run_manifest import MANIFEST_NAME, read_manifest
from bricktrack_common.wire_messages import FileSummary, RunDescription
from bricktrack_host.durable_files import rename_durably, storage_errors
from bricktrack_host.transfer.chunk_reads import CHUNK_BYTES
from bricktrack_host.transfer.part_folder import PartFolder
from bricktrack_host.transfer.pull_progress import PullProgress, QuietProgress
from bricktrack_host.transfer.unit_client import UnitClient
from bricktrack_host.transfer.unit_connection import Stopped

_RESERVED_SUFFIXES = (".part", ".partial")
_FREE_MARGIN_BYTES = 16 * 1024 * 1024
_MIN_CHUNK_BYTES = 16 * 1024
_CHUNKS_AT_ONCE = 2048  # 512 MiB: however long a unit says that a file is, the list of its chunks is not
_FIRST_BACKOFF_S = 0.25
_MAX_BACKOFF_S = 5.0
_LOOK_AGAIN_S = 150.0
_NOT_TO_BE_HAD = "0" * 64

ClientFactory = Callable[[], AbstractContextManager[UnitClient]]


@dataclass(frozen=True, slots=True)
class PulledRun:
    """One run that is here now.

    Attributes
    ----------
    folder : Path
    outcome : "pulled" or "already here"
    n_bytes : int
        Of the whole run.
    n_bytes_fetched : int
        That came over the network in this pull; the rest was here.
    """

    run_id: str
    folder: Path
    outcome: Literal["pulled", "already here"]
    n_bytes: int
    n_bytes_fetched: int


def pull_run(
    connect: ClientFactory,
    run_id: str,
    runs_folder: Path,
    *,
    unit: str = "unit",
    progress: PullProgress | None = None,
    patience_s: float = 60.0,
    stop: threading.Event | None = None,
) -> PulledRun:
    """Bring one run into ``runs_folder`` and confirm it to the unit.

    Parameters
    ----------
    connect : callable
        Opens a new connection to the unit; called again whenever the unit went away.
    patience_s : float, s
        How long to try to reach a unit that went away before giving up; what came is kept.
    stop : threading.Event, optional
        Once it is set, the pull ends with `Stopped` at the next chunk and can be resumed.

    Raises
    ------
    TransferError
        If a file does not match twice, or a different run of this id is already here.
    StorageError
        If the disk here is full or cannot be written.
    UnitTimeoutError
        If the unit stays away.
    UnitError
        If the unit refuses, as it does while armed or recording.
    """
    transfer = _RunTransfer(run_id, runs_folder, unit, progress or QuietProgress())
    backoff_s, seen_s = _FIRST_BACKOFF_S, time.monotonic()
    while True:
        n_before = transfer.n_bytes_fetched
        try:
            with connect() as client:
                return transfer.run(client)
        except UnitTimeoutError as e:
            now_s = time.monotonic()
            if transfer.n_bytes_fetched > n_before:
                backoff_s, seen_s = _FIRST_BACKOFF_S, now_s
            else:  # on a very slow network not even one chunk comes in time
                transfer.chunk_bytes = max(transfer.chunk_bytes // 2, _MIN_CHUNK_BYTES)
            if now_s - seen_s >= patience_s:
                raise UnitTimeoutError(f"{run_id}: {e} What came is kept; pull again to go on") from e
            transfer.progress.note(unit, f"no answer during {run_id}; trying again")
        except UnitError as e:
            if e.code != "busy":
                raise
            raise UnitError(
                f"{run_id}: {e}. What came is kept: pull again when it is idle, or with --disarm", code=e.code
            ) from e
        if (stop or threading.Event()).wait(backoff_s):
            raise Stopped
        backoff_s = min(2 * backoff_s, _MAX_BACKOFF_S)


class _AlteredError(TransferError):
    """A unit's file is, again and again, another than its manifest says, or cannot be read there."""

    def __init__(self, message: str, name: str, found: str) -> None:
        super().__init__(message)
        self.name = name
        self.found = found


class _RunTransfer:
    """One run on its way; `run` may be called again with a new connection after a `UnitTimeoutError`."""

    def __init__(self, run_id: str, runs_folder: Path, unit: str, progress: PullProgress) -> None:
        if run_id.lower().endswith(_RESERVED_SUFFIXES) or ".bad-" in run_id:
            raise TransferError(
                f"{unit}: a run named {run_id} would be mistaken for an unfinished one. Rename it on the unit"
            )
        self.run_id = run_id
        self.folder = runs_folder / run_id
        self.part_path = runs_folder / f"{run_id}.part"
        self.unit = unit
        self.progress = progress
        self.n_bytes_fetched = 0
        self.chunk_bytes = CHUNK_BYTES
        self._n_bytes_told = 0
        self._was_fetched = False  # also by an earlier call, whose confirmation did not get through

    def run(self, client: UnitClient) -> PulledRun:
        description = client.describe_run(self.run_id)
        _check_description(description)
        n_bytes = sum(f.n_bytes for f in description.files)
        if self.folder.exists():
            self._check_present(description)
        else:
            try:
                self._fetch(client, description)
            except _AlteredError as e:
                description = self._described_anew(client, description, e)
                n_bytes = sum(f.n_bytes for f in description.files)
                self._fetch(client, description)
        self._tell(n_bytes)
        client.confirm(self.run_id, [f.sha256 for f in description.files])
        outcome: Literal["pulled", "already here"] = "pulled" if self._was_fetched else "already here"
        return PulledRun(self.run_id, self.folder, outcome, n_bytes, self.n_bytes_fetched)

    def _described_anew(
        self, client: UnitClient, description: RunDescription, altered: "_AlteredError"
    ) -> RunDescription:
        """Tell the unit what its card gives now; return how it then describes the run, or give up on it."""
        hashes = [altered.found if f.name == altered.name else f.sha256 for f in description.files]
        try:
            client.confirm(self.run_id, hashes, timeout_s=_LOOK_AGAIN_S)
        except UnitError as e:
            if e.code == "busy":
                raise
            if e.code != "hash-mismatch":
                raise TransferError(f"{altered}; asked to look at it, the unit says: {e}") from e
        anew = client.describe_run(self.run_id)
        if anew == description:
            raise altered
        _check_description(anew)
        self._note(
            f"{self.run_id}: the unit's card altered it after it was saved; it comes as it is, and says so"
        )
        return anew

    def _check_present(self, description: RunDescription) -> None:
        for file in description.files:
            path = self.folder / file.name
            if path.is_file() and sha256_file(path) == file.sha256:
                continue
            raise TransferError(
                f"{path}: {'is not what the unit has' if path.exists() else 'is missing'}, though the folder "
                f"stands as a whole run. Move {self.folder} away and pull again"
            )

    def _fetch(self, client: UnitClient, description: RunDescription) -> None:
        remedy = "What came is kept: make room or choose another folder with -o, then pull again"
        with storage_errors(self.part_path, remedy):
            with PartFolder.open(self.part_path, description, note=self._note) as part:
                if self.folder.exists():  # another pull has brought it since we looked
                    shutil.rmtree(part.path)
                    self._check_present(description)
                    return
                self._tell(part.n_bytes_verified)
                self._check_room(part)
                for index, file in enumerate(description.files):
                    self._fetch_file(client, part, index, file)
                    if index == 0:
                        self._check_manifest(part.path / file.name, description)
                part.finish()
                rename_durably(self.part_path, self.folder)  # while nobody else can begin to work there
            self._was_fetched = True
            PartFolder.forget_journal(self.folder)

    def _check_room(self, part: PartFolder) -> None:
        free = shutil.disk_usage(part.path).free
        needed = part.n_bytes_missing
        if needed and free < needed + _FREE_MARGIN_BYTES:
            raise StorageError(
                f"{part.path}: {needed / 1e6:.0f} MB are to come and {free / 1e6:.0f} MB are free. Make "
                "room or choose another folder with -o, then pull again; what came is kept"
            )

    def _fetch_file(self, client: UnitClient, part: PartFolder, index: int, file: FileSummary) -> None:
        found_before = problem_before = ""
        for attempt in (1, 2):
            try:
                missing = part.missing_chunks(file.name, self.chunk_bytes)
                while ranges := list(islice(missing, _CHUNKS_AT_ONCE)):
                    for chunk in client.read_chunks(self.run_id, index, ranges):
                        part.write(file.name, chunk)
                        self.n_bytes_fetched += len(chunk.data)
                        self._tell(part.n_bytes_verified)
            except (TransferError, UnitError) as e:
                if isinstance(e, UnitError) and e.code != "internal":
                    raise
                raise _AlteredError(f"{self.run_id}: {file.name}: {e}", file.name, _NOT_TO_BE_HAD) from e
            found = part.sha256(file.name)
            if found == file.sha256:
                return
            kept = part.set_aside(file.name)
            self._tell(part.n_bytes_verified)
            problem = (
                f"{self.run_id}: {file.name} arrived with SHA-256 {found[:12]}..., the unit says "
                f"{file.sha256[:12]}...; kept as {kept}"
            )
            if found == found_before:
                kept.unlink()  # the first copy says it all
                raise _AlteredError(f"{problem_before}. Twice: the unit's card is suspect", file.name, found)
            if attempt == 2:
                raise TransferError(
                    f"{problem}. Twice, and not the same: the unit's card or memory is suspect"
                )
            found_before, problem_before = found, problem
            self._note(f"{problem}; fetching it again")

    def _check_manifest(self, path: Path, description: RunDescription) -> None:
        try:
            manifest = read_manifest(path)
        except RunFormatError as e:
            raise TransferError(f"{self.run_id}: the unit's manifest cannot be read: {e}") from e
        listed = {f.name: (f.n_bytes, f.sha256) for f in manifest.files}
        described = {f.name: (f.n_bytes, f.sha256) for f in description.files[1:]}
        if manifest.run_id != self.run_id or listed != described:
            different = sorted(
                n for n in listed.keys() | described.keys() if listed.get(n) != described.get(n)
            )
            raise TransferError(
                f"{self.run_id}: the unit's manifest (of {manifest.run_id}) and its description differ in "
                f"{', '.join(different) or 'the run id'}. The unit's files were altered after the recording"
            )

    def _tell(self, n_bytes_here: int) -> None:
        self.progress.bytes_done(self.unit, n_bytes_here - self._n_bytes_told)
        self._n_bytes_told = n_bytes_here

    def _note(self, text: str) -> None:
        self.progress.note(self.unit, text)


def _check_description(description: RunDescription) -> None:
    names = [f.name for f in description.files]
    if names[0] != MANIFEST_NAME or len(set(names)) < len(names):
        raise TransferError(
            f"{description.run_id}: the unit lists the files {', '.join(names)}; expected {MANIFEST_NAME} "
            "first and no name twice"
        )
