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
import fcntl
import logging
import os
import re
import shutil
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TextIO

import msgspec

from bricktrack_common.checksums import sha256_bytes
from bricktrack_common.errors import RunFormatError, StorageError
from bricktrack_common.run_manifest import (
    FILE_NAME_PATTERN,
    MANIFEST_NAME,
    RunManifest,
    file_entry,
    is_run_id,
    parse_manifest,
    read_manifest,
)
from bricktrack_common.typed_data import dump_json, load_json
from bricktrack_common.wire_messages import ErrorCode, FileSummary, RunDescription, RunSummary
from bricktrack_device.refusals import RequestRefusedError
from bricktrack_device.storage.disk import Disk, storage_error
from bricktrack_device.storage.run_writer import DRAFT_NAME, PARTIAL_SUFFIX, RunWriter

logger = logging.getLogger(__name__)

_COUNTER_IN_ID = re.compile(r"_[0-9a-f]{6}_(\d{4,})(?:_|$)")
_MAX_LISTED = 10_000
_MAX_OPEN = 8


class _Counter(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    next_run: int


class _Confirmation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    run_id: str
    sha256: list[str]


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
    boot_id : str or None
        The kernel's, which tells the boots of one unit apart; read if not given.

    Raises
    ------
    StorageError
        If the folder cannot be made or written.
    """

    def __init__(
        self, folder: Path, unit: str, *, disk: Disk | None = None, boot_id: str | None = None
    ) -> None:
        self.folder = folder
        self.unit = unit
        self._disk = disk or Disk()
        self._boot = (boot_id or _kernel_boot_id()).replace("-", "")[:6]
        self._lock = threading.Lock()
        self._files_lock = threading.Lock()
        self._lock_file: TextIO | None = None
        self._runs_known: dict[str, _KnownRun] = {}
        self._open_files: dict[tuple[str, str], int] = {}
        self._problems_told: set[str] = set()
        self.runs = folder / "runs"
        self._confirmed = folder / "confirmed"
        self._deleted = folder / "deleted"
        try:
            for path in (self.runs, self._confirmed):
                path.mkdir(parents=True, exist_ok=True)
            if not os.access(self.runs, os.W_OK):
                raise PermissionError(errno.EACCES, "not writable")
        except OSError as e:
            raise StorageError(
                f"storage folder {folder}: {e.strerror or e}. Set storage.folder (or --storage) to a "
                "folder that this user can write"
            ) from e

    def lock(self) -> None:
        """Keep other daemons off this folder, until this process ends or calls `unlock`.

        Raises
        ------
        StorageError
            If another one has it.
        """
        path = self.folder / "lock"
        try:
            self._lock_file = path.open("w")
            fcntl.flock(self._lock_file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as e:
            self.unlock()
            raise StorageError(
                f"storage folder {self.folder} is in use by another bricktrackd. Stop that one, or set "
                "storage.folder (or --storage) to another folder"
            ) from e

    def unlock(self) -> None:
        """Let others have the folder; also closes what reading left open."""
        self.close_files()
        if self._lock_file is not None:
            self._lock_file.close()
            self._lock_file = None

    # New runs

    def new_run_id(self, label: str) -> str:
        """Return an id that no run has, and note durably that it is taken.

        Raises
        ------
        StorageError
            If the counter cannot be written.
        """
        path = self.folder / "next_run.json"
        number = 1 + max((_counter_of(p.name) for p in self._folders()), default=0)
        try:
            number = max(number, load_json(path, _Counter).next_run)
        except RunFormatError as e:
            if path.exists():
                logger.warning("%s; counting on from the runs that are there", e)
        try:
            temporary = path.with_suffix(".tmp")
            self._disk.write_file(temporary, lambda f: f.write(dump_json(_Counter(next_run=number + 1))))
            self._disk.rename(temporary, path)
        except OSError as e:
            raise storage_error(f"{path}: the run counter cannot be written", e) from e
        return f"{self.unit}_{self._boot}_{number:04d}" + (f"_{label}" if label else "")

    def free_bytes(self) -> int:
        """Return the free space."""
        return self._disk.free_bytes(self.folder)

    def open_writer(self, run_id: str) -> RunWriter:
        """Return what writes one run."""
        return RunWriter(self.runs, run_id, self._disk)

    # After a power cut

    def recover(self, rebuild: Callable[[Path, str, str], RunManifest]) -> list[str]:
        """Turn what a power cut left into runs: finish whole ones, mark the others interrupted.

        Parameters
        ----------
        rebuild : callable
            Makes a manifest (without files) over what a partial folder holds: folder, run id, unit.

        Returns
        -------
        recovered : list of str
            Run ids. What cannot be recovered stays where it is, with a warning.
        """
        shutil.rmtree(self._deleted, ignore_errors=True)
        recovered = []
        for partial in sorted(self.runs.glob(f"*{PARTIAL_SUFFIX}")):
            run_id = partial.name.removesuffix(PARTIAL_SUFFIX)
            if not partial.is_dir() or not is_run_id(run_id):
                logger.warning("%s: not a run folder's name; left alone", partial)
                continue
            final = self.runs / run_id
            if final.exists():
                logger.warning("%s: a run of this name exists already; left alone", partial)
                continue
            try:
                if not _is_whole(partial):
                    self._finish_interrupted(partial, rebuild(partial, run_id, self.unit))
                (partial / DRAFT_NAME).unlink(missing_ok=True)
                self._disk.rename(partial, final)
            except OSError as e:
                logger.warning("%s: cannot be recovered now: %s", partial, e.strerror or e)
                continue
            recovered.append(run_id)
        return recovered

    def _finish_interrupted(self, partial: Path, manifest: RunManifest) -> None:
        entries = [file_entry(p) for p in sorted(partial.iterdir()) if _is_run_file(p)]
        manifest = msgspec.structs.replace(manifest, state="interrupted", files=entries)
        path = partial / MANIFEST_NAME
        self._disk.write_file(path, lambda f: f.write(dump_json(manifest)))
        self._disk.sync_folder(partial)

    # Reading

    def list_runs(self) -> list[RunSummary]:
        """Return all whole runs, oldest first; at most the newest ten thousand."""
        summaries = []
        for folder in sorted(self._folders(), key=lambda p: (_counter_of(p.name), p.name))[-_MAX_LISTED:]:
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
                    confirmed=self.is_confirmed(folder.name),
                )
            )
        return summaries

    def count_runs(self) -> int:
        """Return how many run folders there are."""
        return sum(1 for _ in self._folders())

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
            # Not mapped into memory: a card that fails then is an error here, not the end of the process.
            with self._files_lock:
                file = self._descriptor(run_id, entry.name)
                return os.pread(file, min(length, entry.n_bytes - offset), offset)
        except OSError as e:
            raise RequestRefusedError(
                "internal", f"{run_id}: {entry.name} cannot be read: {e.strerror or e}"
            ) from e

    def _descriptor(self, run_id: str, name: str) -> int:
        """Return an open file's descriptor; the last few that were asked for stay open."""
        key = run_id, name
        found = self._open_files.pop(key, None)
        if found is None:
            found = os.open(self.runs / run_id / name, os.O_RDONLY)
        self._open_files[key] = found
        if len(self._open_files) > _MAX_OPEN:
            os.close(self._open_files.pop(next(iter(self._open_files))))
        return found

    def close_files(self, run_id: str | None = None) -> None:
        """Close the files that reading left open, of one run or all."""
        with self._files_lock:
            for key in [k for k in self._open_files if run_id in (None, k[0])]:
                os.close(self._open_files.pop(key))

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
        path = self._confirmed / f"{run_id}.json"
        note = dump_json(_Confirmation(run_id=run_id, sha256=sha256))
        try:
            temporary = path.with_suffix(".tmp")
            self._disk.write_file(temporary, lambda f: f.write(note))
            self._disk.rename(temporary, path)
        except OSError as e:
            code: ErrorCode = "no-space" if e.errno == errno.ENOSPC else "internal"
            raise RequestRefusedError(code, f"{path}: {e.strerror or e}") from e

    def is_confirmed(self, run_id: str) -> bool:
        """Tell whether a host has said that it holds a run."""
        return (self._confirmed / f"{run_id}.json").exists()

    def count_unconfirmed(self) -> int:
        """Return how many run folders no host has confirmed."""
        try:
            notes = {p.stem for p in self._confirmed.glob("*.json")}
        except OSError as e:
            raise storage_error(f"{self._confirmed}: cannot be listed", e) from e
        return sum(1 for folder in self._folders() if folder.name not in notes)

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
        if not force and not self.is_confirmed(run_id):
            raise RequestRefusedError(
                "not-confirmed",
                f"no host has confirmed that it holds run {run_id}: pull it first, or force its deletion",
            )
        try:
            self.close_files(run_id)
            n_bytes = sum(p.stat().st_size for p in folder.iterdir())
            self._deleted.mkdir(exist_ok=True)
            shutil.rmtree(self._deleted / run_id, ignore_errors=True)
            with self._lock:
                self._runs_known.pop(run_id, None)
                self._disk.rename(folder, self._deleted / run_id)
            self._disk.sync_folder(self.runs)
            (self._confirmed / f"{run_id}.json").unlink(missing_ok=True)
            shutil.rmtree(self._deleted / run_id)
        except OSError as e:
            raise RequestRefusedError("internal", f"run {run_id} cannot be deleted: {e.strerror or e}") from e
        logger.info("%s: deleted (%s)", run_id, "forced" if force else "confirmed")
        return n_bytes

    def _folders(self) -> list[Path]:
        try:
            return [p for p in self.runs.iterdir() if is_run_id(p.name) and p.suffix != PARTIAL_SUFFIX]
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


def _is_run_file(path: Path) -> bool:
    is_own = path.name in (MANIFEST_NAME, DRAFT_NAME)
    return path.is_file() and not is_own and re.fullmatch(FILE_NAME_PATTERN, path.name) is not None


def _is_whole(folder: Path) -> bool:
    """Tell whether only the renaming was cut off: the manifest and every hash are right."""
    try:
        manifest = read_manifest(folder / MANIFEST_NAME)
        return all(file_entry(folder / f.name) == f for f in manifest.files)
    except (RunFormatError, OSError):
        return False


def _kernel_boot_id() -> str:
    return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
