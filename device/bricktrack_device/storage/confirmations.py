"""What hosts have said that they hold: one note a run, with the hashes of its files."""

import errno
from pathlib import Path

import msgspec

from bricktrack_common.typed_data import dump_json
from bricktrack_common.wire_messages import ErrorCode
from bricktrack_device.refusals import RequestRefusedError
from bricktrack_device.storage.disk import Disk, storage_error


class _Confirmation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    run_id: str
    sha256: list[str]


class Confirmations:
    """The notes in ``<storage>/confirmed``.

    Parameters
    ----------
    folder : Path
    disk : Disk
    """

    def __init__(self, folder: Path, disk: Disk) -> None:
        self.folder = folder
        self._disk = disk

    def note(self, run_id: str, sha256: list[str]) -> None:
        """Note durably that a host holds a run; raise `RequestRefusedError` where that cannot be written."""
        path = self._path(run_id)
        note = dump_json(_Confirmation(run_id=run_id, sha256=sha256))
        try:
            self._disk.replace_file(path, note)
        except OSError as e:
            code: ErrorCode = "no-space" if e.errno == errno.ENOSPC else "internal"
            raise RequestRefusedError(code, f"{path}: {e.strerror or e}") from e

    def has(self, run_id: str) -> bool:
        """Tell whether a host has said that it holds a run."""
        return self._path(run_id).exists()

    def run_ids(self) -> set[str]:
        """Return the runs that hosts hold; raise `StorageError` where the notes cannot be listed."""
        try:
            return {p.stem for p in self.folder.glob("*.json")}
        except OSError as e:
            raise storage_error(f"{self.folder}: cannot be listed", e) from e

    def forget(self, run_id: str) -> None:
        """Remove the note of a run that is gone; raise `OSError` where that fails."""
        self._path(run_id).unlink(missing_ok=True)

    def _path(self, run_id: str) -> Path:
        return self.folder / f"{run_id}.json"
