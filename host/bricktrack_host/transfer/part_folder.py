"""The folder of a run under way, ``<run-id>.part/``: files with holes, and a journal of what is verified.

The journal is JSON lines: first what is being fetched, then one line for every verified range with its
checksum, written behind the range's bytes. Nothing in it is believed without a look at those bytes: whoever
opens the folder again reads every range and compares, so that a power cut that lost bytes, or tore a line,
costs only those ranges. A killed pull loses nothing but the chunks that were on the network.

While bytes come in, one thread behind each folder hashes what lies there without a gap, as read back from the
file, so that little is left to do when the last chunk is here. The system writes to the disk meanwhile; a
file is synced once, when it is whole.
"""

import fcntl
import hashlib
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import msgspec

from bricktrack_common.checksums import crc32
from bricktrack_common.errors import StorageError
from bricktrack_common.wire_messages import RunDescription
from bricktrack_host.durable_files import rename_durably, sync_folder, write_durably
from bricktrack_host.transfer.chunk_reads import VerifiedChunk

JOURNAL_NAME = ".journal.jsonl"  # begins with a dot, which no file of a run may
JOURNAL_VERSION = 1
_HASH_BYTES = 8 * 1024 * 1024  # hashed at a time, behind the transfer
_READ_BYTES = 1024 * 1024


class _Head(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The journal's first line."""

    journal: int
    description: RunDescription


class _Range(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One verified range."""

    file: str
    offset: int
    n_bytes: int
    crc32: int


class _PartFile:
    """One file with holes: which ranges are verified, and the hash of what lies before the first hole."""

    def __init__(self, path: Path, n_bytes: int) -> None:
        self.handle: BinaryIO = os.fdopen(
            os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644), "r+b", 0
        )
        if os.fstat(self.handle.fileno()).st_size > n_bytes:
            self.handle.truncate(n_bytes)
        self.n_bytes = n_bytes
        self.verified: list[_Range] = []
        self.n_bytes_verified = 0
        self.n_bytes_without_gap = 0
        self.n_bytes_to_hash = 0
        self._ends_ahead: dict[int, int] = {}  # behind the first hole: the end of a range by its start
        self._digest = hashlib.sha256()
        self._n_bytes_hashed = 0

    def add(self, done: _Range) -> None:
        """Note a verified range; it overlaps no other."""
        self.verified.append(done)
        self.n_bytes_verified += done.n_bytes
        self._ends_ahead[done.offset] = done.offset + done.n_bytes
        while (end := self._ends_ahead.pop(self.n_bytes_without_gap, None)) is not None:
            self.n_bytes_without_gap = end

    def overlaps(self, other: _Range) -> bool:
        """Tell whether a verified range covers a part of another one."""
        end = other.offset + other.n_bytes
        return any(r.offset < end and other.offset < r.offset + r.n_bytes for r in self.verified)

    def hash_to(self, end: int) -> None:
        """Hash the file up to ``end``, as it is on disk; for one thread only."""
        while self._n_bytes_hashed < end:
            n_bytes = min(_READ_BYTES, end - self._n_bytes_hashed)
            data = os.pread(self.handle.fileno(), n_bytes, self._n_bytes_hashed)
            if not data:
                return  # cut short behind our back: the hash will tell
            self._digest.update(data)
            self._n_bytes_hashed += len(data)

    def sha256(self) -> str:
        """Return the hash of what was hashed, as 64 hex digits."""
        return self._digest.hexdigest()


class PartFolder:
    """A run under way on disk; use as a context, which holds a lock on the folder."""

    def __init__(self, path: Path, description: RunDescription, lock: int) -> None:
        self.path = path
        self._description = description
        self._lock = lock
        self._journal: BinaryIO | None = None
        self._files: dict[str, _PartFile] = {}
        self._behind = ThreadPoolExecutor(1, f"hash-{description.run_id}")
        self._hashing: list[Future[None]] = []

    @classmethod
    def open(cls, path: Path, description: RunDescription, *, note: Callable[[str], None]) -> Self:
        """Open or make the folder, and check what an earlier pull left in it.

        A folder that was begun for other contents of the same run is set aside as ``*.bad-N``.

        Raises
        ------
        StorageError
            If another pull holds the folder.
        """
        lock = _make_locked(path)
        if not _is_journal_of(path / JOURNAL_NAME, description):
            kept = _free_name(path)
            rename_durably(path, kept)
            os.close(lock)
            note(f"{path.name} was begun for other contents of this run; kept as {kept.name}")
            lock = _make_locked(path)
        part = cls(path, description, lock)
        try:
            part._resume(note)
        except BaseException:
            part.close()
            raise
        return part

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close all files; what was written and noted is still there next time."""
        self._behind.shutdown()
        for file in self._files.values():
            with suppress(OSError):
                file.handle.close()
        if self._journal is not None:
            with suppress(OSError):
                self._journal.close()
        os.close(self._lock)

    @property
    def n_bytes_verified(self) -> int:
        """Bytes of the run that are here and verified."""
        return sum(f.n_bytes_verified for f in self._files.values())

    @property
    def n_bytes_missing(self) -> int:
        """Bytes of the run that are still to come."""
        return sum(f.n_bytes for f in self._description.files) - self.n_bytes_verified

    def missing_chunks(self, name: str, chunk_bytes: int) -> Iterator[tuple[int, int]]:
        """Yield offset and length of the chunks of a file that are not verified now, in order."""
        file = self._files[name]
        position = 0
        ends = sorted((r.offset, r.offset + r.n_bytes) for r in file.verified)
        for start, end in [*ends, (file.n_bytes, file.n_bytes)]:
            while position < start:
                length = min(chunk_bytes, start - position)
                yield position, length
                position += length
            position = max(position, end)

    def write(self, name: str, chunk: VerifiedChunk) -> None:
        """Write a chunk and note it in the journal."""
        file = self._files[name]
        write_at(file.handle, chunk.offset, chunk.data)
        done = _Range(file=name, offset=chunk.offset, n_bytes=len(chunk.data), crc32=chunk.crc32)
        if self._journal is not None:
            self._journal.write(msgspec.json.encode(done) + b"\n")
        file.add(done)
        if file.n_bytes_without_gap >= file.n_bytes_to_hash + _HASH_BYTES:
            self._hash(file)

    def sha256(self, name: str) -> str:
        """Return the hash of a file as it is on disk; what was written is synced when this returns."""
        file = self._files[name]
        self._hash(file)
        os.fsync(file.handle.fileno())
        self._wait_until_hashed()
        return file.sha256()

    def _hash(self, file: _PartFile) -> None:
        file.n_bytes_to_hash = file.n_bytes_without_gap
        self._hashing.append(self._behind.submit(file.hash_to, file.n_bytes_to_hash))

    def _wait_until_hashed(self) -> None:
        hashing, self._hashing = self._hashing, []
        for work in hashing:
            work.result()

    def set_aside(self, name: str) -> Path:
        """Keep a wrong file beside the folder, as ``<run-id>.bad-N.<name>``, and begin it anew."""
        self._wait_until_hashed()
        old = self._files.pop(name)
        old.handle.close()
        evidence = _free_name(self.path.with_suffix(""), ending=f".{name}")
        (self.path / name).rename(evidence)
        sync_folder(self.path.parent)
        self._files[name] = _PartFile(self.path / name, old.n_bytes)
        self._rewrite_journal()
        return evidence

    def finish(self) -> None:
        """Make the names durable; the folder may then be renamed, if the hash of each file was asked for."""
        sync_folder(self.path)

    @staticmethod
    def forget_journal(folder: Path) -> None:
        """Remove the journal from a whole run's folder."""
        (folder / JOURNAL_NAME).unlink(missing_ok=True)

    def _resume(self, note: Callable[[str], None]) -> None:
        for file in self._description.files:
            self._files[file.name] = _PartFile(self.path / file.name, file.n_bytes)
        n_wrong = 0
        for line in _read_journal(self.path / JOURNAL_NAME)[1:]:
            known = _parse_range(line)
            if known is None or known.file not in self._files or not self._still_there(known):
                n_wrong += 1
                continue
            self._files[known.file].add(known)
        if n_wrong:
            note(f"{self.path.name}: {n_wrong} ranges noted earlier are not as noted; they are fetched again")
        self._rewrite_journal()

    def _still_there(self, known: _Range) -> bool:
        file = self._files[known.file]
        if known.offset < 0 or known.n_bytes < 1 or known.offset + known.n_bytes > file.n_bytes:
            return False
        data = os.pread(file.handle.fileno(), known.n_bytes, known.offset)
        return len(data) == known.n_bytes and crc32(data) == known.crc32 and not file.overlaps(known)

    def _rewrite_journal(self) -> None:
        """Begin the journal anew with what is verified; the old one stays until it is whole."""
        if self._journal is not None:
            self._journal.close()
        ranges = [r for f in self._files.values() for r in f.verified]
        fresh = self.path / f"{JOURNAL_NAME}.new"
        fresh.unlink(missing_ok=True)
        head = _Head(journal=JOURNAL_VERSION, description=self._description)
        write_durably(fresh, b"".join(msgspec.json.encode(line) + b"\n" for line in (head, *ranges)))
        rename_durably(fresh, self.path / JOURNAL_NAME)
        self._journal = (self.path / JOURNAL_NAME).open("ab", buffering=0)


def _make_locked(path: Path) -> int:
    """Make the folder if there is none, and return the handle that holds its lock."""
    while True:
        path.mkdir(exist_ok=True)
        sync_folder(path.parent)
        lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as e:
            os.close(lock)
            raise StorageError(f"{path}: another pull is at work here. Wait for it, or stop it") from e
        with suppress(FileNotFoundError):
            if os.path.samestat(path.stat(), os.fstat(lock)):
                return lock
        os.close(lock)  # it got its final name between the opening and the locking


def write_at(handle: BinaryIO, offset: int, data: bytes) -> None:
    """Write all of ``data`` at ``offset``."""
    view = memoryview(data)
    while view:
        n = os.pwrite(handle.fileno(), view, offset)
        view, offset = view[n:], offset + n


def _free_name(path: Path, ending: str = "") -> Path:
    n = 1
    while (candidate := path.with_name(f"{path.name}.bad-{n}{ending}")).exists():
        n += 1
    return candidate


def _read_journal(path: Path) -> list[bytes]:
    """Return the journal's whole lines."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return []
    return data.split(b"\n")[:-1]


def _is_journal_of(path: Path, description: RunDescription) -> bool:
    lines = _read_journal(path)
    if not lines:
        return True
    try:
        head = msgspec.json.decode(lines[0], type=_Head)
    except (msgspec.DecodeError, UnicodeDecodeError):
        return False
    return head.journal == JOURNAL_VERSION and head.description == description


def _parse_range(line: bytes) -> _Range | None:
    try:
        return msgspec.json.decode(line, type=_Range)
    except (msgspec.DecodeError, UnicodeDecodeError):
        return None


# As in `bricktrack_common.wire_codec`: not when the threads of several pulls come here at once.
for _line in (_Head, _Range):
    msgspec.json.Decoder(_line)
