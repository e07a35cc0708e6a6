"""Writing one run folder, file after file: what was written stays, and a failed save can be taken up again.

The folder is ``<id>.partial`` until the manifest, written last, stands in it with the hash of every file;
then it is renamed. The draft, the manifest as it was known first, stays: should the card damage the one, the
other still says how the run was recorded.
"""

from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import msgspec

from bricktrack_common.run_manifest import MANIFEST_NAME, FileEntry, RunManifest, file_entry
from bricktrack_common.typed_data import dump_json
from bricktrack_device.storage.disk import Disk, storage_error

PARTIAL_SUFFIX = ".partial"
DRAFT_NAME = "draft.json"


class RunWriter:
    """Writes one run, file after file; after a failure it can be taken up again where it stopped."""

    def __init__(self, runs: Path, run_id: str, disk: Disk) -> None:
        self._disk = disk
        self._final = runs / run_id
        self.folder = runs / (run_id + PARTIAL_SUFFIX)
        self._entries: dict[str, FileEntry] = {}
        self._others_wrote = False
        self._is_renamed = False

    def begin(self, draft: RunManifest) -> None:
        """Make the folder and write down what is known already, for a recovery.

        Raises
        ------
        StorageError
            If that fails; so do all that follow.
        """
        if self._is_renamed:
            return
        try:
            if not self.folder.is_dir():
                self._disk.make_folder(self.folder)
            self._disk.write_file(self.folder / DRAFT_NAME, lambda f: f.write(dump_json(draft)))
        except OSError as e:
            raise storage_error(f"{self.folder}: cannot be begun", e) from e

    def write(self, name: str, fill: Callable[[BinaryIO], object]) -> None:
        """Write one file with ``fill``, durably; does nothing if it was written before."""
        if name in self._entries:
            return
        path = self.folder / name
        try:
            self._disk.write_file(path, fill)
            self._entries[name] = file_entry(path)
        except OSError as e:
            raise storage_error(f"{path}: cannot be written", e) from e

    def write_by_others(self, write_into: Callable[[Path], Path | None]) -> None:
        """Let others write one file of their own into the folder, and take it in; does nothing twice."""
        if self._others_wrote:
            return
        try:
            path = write_into(self.folder)
            if path is not None:
                self._disk.sync_file(path)
                self._entries[path.name] = file_entry(path)
        except OSError as e:
            raise storage_error(f"{self.folder}: the true motion cannot be written", e) from e
        self._others_wrote = True

    def finish(self, manifest: RunManifest) -> Path:
        """Write the manifest with the files' hashes, give the folder its name and return it."""
        manifest = msgspec.structs.replace(manifest, files=list(self._entries.values()))
        path = self.folder / MANIFEST_NAME
        try:
            if self._is_renamed:
                self._disk.sync_folder(self._final.parent)
                return self._final
            self._disk.write_file(path, lambda f: f.write(dump_json(manifest)))
            self._disk.sync_folder(self.folder)
            self._disk.rename(self.folder, self._final)
        except OSError as e:
            self._is_renamed = self._final.is_dir()
            raise storage_error(f"{path}: the run cannot be finished", e) from e
        return self._final
