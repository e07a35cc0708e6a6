"""Run folders on the card: written beside their final name, synced, and renamed only when whole.

::

    <storage>/next_run.json        the counter that run ids take; survives reboots
    <storage>/runs/<id>.partial/   being written, or left by a power cut
    <storage>/runs/<id>/           whole: its manifest was written last
    <storage>/confirmed/<id>.json  the host said that it holds these hashes

    <storage>/deleted/<id>/        on its way out; emptied at the next start at the latest

A run exists when its manifest parses. Nothing is deleted but by `RunStore.delete`.
"""

import errno
import logging
import os
import re
import shutil
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec

from bricktrack_common.checksums import sha256_bytes
from bricktrack_common.errors import RunFormatError, StorageError
from bricktrack_common.run_manifest import (
    MANIFEST_NAME,
    is_run_id,
    parse_manifest,
)
from bricktrack_common.typed_data import dump_json, load_json
from bricktrack_common.wire_messages import FileSummary, RunDescription, RunSummary
from bricktrack_device.boot import kernel_boot_id
from bricktrack_device.refusals import RequestRefusedError
from bricktrack_device.storage.confirmations import Confirmations
from bricktrack_device.storage.disk import Disk, storage_error
from bricktrack_device.storage.folder_lock import FolderLock
from bricktrack_device.storage.open_files import OpenFiles
from bricktrack_device.storage.run_writer import PARTIAL_SUFFIX, RunWriter

logger = logging.getLogger(__name__)

_COUNTER_IN_ID = re.compile(r"_[0-9a-f]{6}_(\d{4,})(?:_|\.partial$|$)")
_MAX_LISTED = 10_000


class _Counter(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    next_run: int


@dataclass(frozen=True, slots=True)
class _KnownRun:
    state: Literal["complete", "interrupted"]
    description: RunDescription


class RunStore:
    """All runs of a unit.

    Parameters
    ----------
    folder : Path
        Made if missing.
    unit : str
    disk : Disk
        What writes to the card.
    boot_id : str or None
        The kernel's, which tells the boots of one unit apart; read if not given.
    may_be_read_only : bool
        Whether what is there may be served though nothing can be written.

    Attributes
    ----------
    problem : str
        Why nothing could be written at the beginning, in words; ``""`` where it could.

    Raises
    ------
    StorageError
        If the folder cannot be made or written.
    """

    def __init__(
        self,
        folder: Path,
        unit: str,
        *,
        disk: Disk | None = None,
        boot_id: str | None = None,
        may_be_read_only: bool = False,
    ) -> None:
        self.folder = folder
        self.unit = unit
        self.disk = disk or Disk()
        self._boot = (boot_id or kernel_boot_id()).replace("-", "")[:6]
        self._lock = threading.Lock()
        self._folder_lock: FolderLock | None = None
        self._runs_known: dict[str, _KnownRun] = {}
        self._problems_told: set[str] = set()
        self.runs = folder / "runs"
        self._files = OpenFiles(self.runs)
        self._confirmations = Confirmations(folder / "confirmed", self.disk)
        self._deleted = folder / "deleted"
        self.problem = ""
        try:
            self._make_folders()
        except StorageError as e:
            if not (may_be_read_only and self.runs.is_dir()):
                raise
            self.problem = str(e)

    def _make_folders(self) -> None:
        try:
            for path in (self.runs, self._confirmations.folder):
                path.mkdir(parents=True, exist_ok=True)
            if not os.access(self.runs, os.W_OK):
                is_read_only = os.statvfs(self.runs).f_flag & os.ST_RDONLY
                number = errno.EROFS if is_read_only else errno.EACCES
                raise OSError(number, os.strerror(number))
        except OSError as e:
            raise StorageError(
                f"storage folder {self.folder}: {e.strerror or e}. Set storage.folder (or --storage) to a "
                "folder that this user can write"
            ) from e

    def lock(self) -> None:
        """Keep other daemons off this folder, until this process ends or calls `unlock`.

        Raises
        ------
        StorageError
            If another one has it.
        """
        try:
            self._folder_lock = FolderLock(self.folder)
        except BlockingIOError as e:
            raise StorageError(
                f"storage folder {self.folder} is in use by another bricktrackd. Stop that one, or set "
                "storage.folder (or --storage) to another folder"
            ) from e
        except OSError as e:
            raise storage_error(f"{self.folder}: cannot be locked", e) from e

    def unlock(self) -> None:
        """Let others have the folder; also closes what reading left open."""
        self._files.close()
        if self._folder_lock is not None:
            self._folder_lock.release()
            self._folder_lock = None

    # New runs

    def new_run_id(self, label: str) -> str:
        """Return an id that no run has, and note durably that it is taken.

        Raises
        ------
        StorageError
            If the counter cannot be written, or there is no place for runs.
        """
        self._make_folders()  # they may have been missing on a card that could not be written
        path = self.folder / "next_run.json"
        number = 1 + max((_counter_of(p.name) for p in self._entries()), default=0)
        try:
            number = max(number, load_json(path, _Counter).next_run)
        except RunFormatError as e:
            if path.exists():
                logger.warning("%s; counting on from the runs that are there", e)
        try:
            self.disk.replace_file(path, dump_json(_Counter(next_run=number + 1)))
        except OSError as e:
            raise storage_error(f"{path}: the run counter cannot be written", e) from e
        return f"{self.unit}_{self._boot}_{number:04d}" + (f"_{label}" if label else "")

    def has(self, run_id: str) -> bool:
        """Tell whether anything of a run is on the card, whole or not; no where the card does not tell."""
        try:
            return any((self.runs / name).exists() for name in (run_id, run_id + PARTIAL_SUFFIX))
        except OSError:
            return False

    def is_own(self, run_id: str) -> bool:
        """Tell whether a run is named as those of this unit are."""
        own = re.match(re.escape(self.unit) + _COUNTER_IN_ID.pattern, run_id)
        return own is not None

    def free_bytes(self) -> int:
        """Return the free space; raise `StorageError` where the card does not tell."""
        try:
            return self.disk.free_bytes(self.folder)
        except OSError as e:
            raise storage_error(f"{self.folder}: its free space cannot be told", e) from e

    def open_writer(self, run_id: str) -> RunWriter:
        """Return what writes one run."""
        return RunWriter(self.runs, run_id, self.disk)

    def empty_deleted(self) -> None:
        """Do away with what a power cut left of runs that were being deleted."""
        shutil.rmtree(self._deleted, ignore_errors=True)

    # Reading

    def list_runs(self) -> list[RunSummary]:
        """Return all whole runs, oldest first; at most the newest ten thousand."""
        summaries = []
        for folder in sorted(self.folders(), key=lambda p: (_counter_of(p.name), p.name))[-_MAX_LISTED:]:
            try:
                run = self._known(folder.name)
            except RequestRefusedError as e:
                if folder.name not in self._problems_told:
                    self._problems_told.add(folder.name)
                    logger.warning("%s", e)
                continue
            summaries.append(
                RunSummary(
                    run_id=folder.name,
                    state=run.state,
                    n_bytes=sum(f.n_bytes for f in run.description.files),
                    confirmed=self._confirmations.has(folder.name),
                )
            )
        return summaries

    def count_runs(self) -> int:
        """Return how many run folders there are."""
        return sum(1 for _ in self.folders())

    def describe(self, run_id: str) -> RunDescription:
        """Return a run's files; index 0 is its manifest.

        Raises
        ------
        RequestRefusedError
            If there is no such run.
        """
        return self._known(run_id).description

    def read_chunk(self, run_id: str, file_index: int, offset: int, length: int) -> bytes:
        """Return ``length`` bytes of a file from ``offset``, fewer at its end.

        Raises
        ------
        RequestRefusedError
            If there is no such run or file, or ``offset`` lies behind its end.
        """
        files = self.describe(run_id).files
        if file_index >= len(files):
            raise RequestRefusedError(
                "no-such-file", f"run {run_id} has {len(files)} files; there is none with index {file_index}"
            )
        entry = files[file_index]
        if offset > entry.n_bytes:
            raise RequestRefusedError(
                "out-of-range", f"{run_id}: {entry.name} has {entry.n_bytes} bytes; offset {offset} is behind"
            )
        try:
            return self._files.read(
                run_id, entry.name, offset=offset, length=min(length, entry.n_bytes - offset)
            )
        except OSError as e:
            raise RequestRefusedError(
                "internal", f"{run_id}: {entry.name} cannot be read: {e.strerror or e}"
            ) from e

    def confirm(self, run_id: str, sha256: list[str]) -> None:
        """Note that the host holds a run: the hashes, in any order, must be those of all its files.

        Raises
        ------
        RequestRefusedError
            If there is no such run, a hash differs, or the note cannot be written.
        """
        files = self.describe(run_id).files
        if sorted(sha256) != sorted(f.sha256 for f in files):
            wrong = [f.name for f in files if f.sha256 not in sha256]
            raise RequestRefusedError(
                "hash-mismatch",
                f"{run_id}: {len(sha256)} hashes do not match the {len(files)} files"
                + (f"; differing: {', '.join(wrong)}" if wrong else ""),
            )
        self._confirmations.note(run_id, sha256)

    def count_unconfirmed(self) -> int:
        """Return how many run folders no host has confirmed."""
        confirmed = self._confirmations.run_ids()
        return sum(1 for folder in self.folders() if folder.name not in confirmed)

    def forget(self, run_id: str) -> None:
        """Read a run's manifest again when it is asked for next, and its files."""
        self._files.close(run_id)
        with self._lock:
            self._runs_known.pop(run_id, None)

    def delete(self, run_id: str, *, force: bool = False) -> int:
        """Remove a run that a host has confirmed, or any with ``force``; return how many bytes it had.

        The folder first leaves ``runs`` by one renaming: a power cut leaves a whole run, or none.

        Raises
        ------
        RequestRefusedError
            If there is no such run, it is not confirmed, or the card does not do it.
        """
        folder = self.runs / run_id
        if not is_run_id(run_id) or run_id.endswith(PARTIAL_SUFFIX) or not folder.is_dir():
            raise RequestRefusedError("no-such-run", f"there is no run {run_id!r:.120} on this unit")
        if not force and not self._confirmations.has(run_id):
            raise RequestRefusedError(
                "not-confirmed",
                f"no host has confirmed that it holds run {run_id}: pull it first, or force its deletion",
            )
        try:
            n_bytes = sum(p.stat().st_size for p in folder.iterdir())
            self._deleted.mkdir(exist_ok=True)
            shutil.rmtree(self._deleted / run_id, ignore_errors=True)
            with self._lock:
                self._runs_known.pop(run_id, None)
                self.disk.rename(folder, self._deleted / run_id)
            self._files.close(run_id)  # now no reader can open one again, and keep its room on the card
            self.disk.sync_folder(self.runs)
            self._confirmations.forget(run_id)
            shutil.rmtree(self._deleted / run_id)
        except OSError as e:
            raise RequestRefusedError("internal", f"run {run_id} cannot be deleted: {e.strerror or e}") from e
        logger.info("%s: deleted (%s)", run_id, "forced" if force else "confirmed")
        return n_bytes

    def folders(self) -> list[Path]:
        """Return the folders named as whole runs; raise `StorageError` where they cannot be listed."""
        return [p for p in self._entries() if is_run_id(p.name) and p.suffix != PARTIAL_SUFFIX]

    def _entries(self) -> list[Path]:
        try:
            return list(self.runs.iterdir())
        except OSError as e:
            raise storage_error(f"{self.runs}: cannot be listed", e) from e

    def _known(self, run_id: str) -> _KnownRun:
        """Return what is said of a run; it never changes again."""
        with self._lock:
            known = self._runs_known.get(run_id)
            if known is not None:
                return known
            if not is_run_id(run_id) or run_id.endswith(PARTIAL_SUFFIX):
                raise RequestRefusedError("no-such-run", f"{run_id!r:.120} is no run id")
            path = self.runs / run_id / MANIFEST_NAME
            if not path.parent.is_dir():
                raise RequestRefusedError("no-such-run", f"there is no run {run_id} on this unit")
            try:
                data = path.read_bytes()
                manifest = parse_manifest(data, where=str(path))
            except (RunFormatError, OSError) as e:
                raise RequestRefusedError("no-such-run", f"run {run_id} cannot be read: {e}") from e
            files = [FileSummary(name=MANIFEST_NAME, n_bytes=len(data), sha256=sha256_bytes(data))]
            files += [FileSummary(name=f.name, n_bytes=f.n_bytes, sha256=f.sha256) for f in manifest.files]
            known = _KnownRun(manifest.state, RunDescription(run_id=run_id, files=files))
            self._runs_known[run_id] = known
            return known


def _counter_of(name: str) -> int:
    found = _COUNTER_IN_ID.search(name)
    return int(found.group(1)) if found else 0
