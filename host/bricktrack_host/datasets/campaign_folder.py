"""The folder of a campaign's dataset: who may write, what a kill left undone, and what is kept of before.

    campaign/
        dataset.json                                       schema and version
        motion/test=T/assembly=A/unit=U/motion.parquet     what was added last
        earlier/test=T/assembly=A/unit=U/1-<id>.parquet    what stood there before, never deleted

What is to be added is first staged and synced; one rename then decides, and each file is put into its place
by another. After a kill behind the decision the next command of any kind does the rest.
"""

import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pyarrow as pa
import pyarrow.parquet

from bricktrack_common.errors import RunFormatError, StorageError
from bricktrack_common.typed_data import convert, dump_json, load_json
from bricktrack_host.datasets.motion_schema import MOTION_SCHEMA, MOTION_VERSION, require_known_version
from bricktrack_host.durable_files import (
    rename_durably,
    replace_durably,
    storage_errors,
    sync_file,
    sync_folder,
    write_durably,
)

MARKER_NAME = "dataset.json"
MOTION_FOLDER = "motion"
EARLIER_FOLDER = "earlier"
FILE_NAME = "motion.parquet"
STAGED = ".adding"
_DECIDED = ".decided"
_RETIRE_NAME = "retire.json"


class _Marker(msgspec.Struct, frozen=True, kw_only=True):
    schema: str = MOTION_SCHEMA
    version: int = MOTION_VERSION


def require_dataset(root: Path) -> None:
    """Raise `RunFormatError` where there is no dataset, or one of a newer version."""
    path = root / MARKER_NAME
    if not path.is_file():
        raise RunFormatError(f"{root}: no {MARKER_NAME}: no dataset. Make it with 'bricktrack dataset add'")
    head = load_json(path, dict[str, object])
    if head.get("schema") != MOTION_SCHEMA:
        raise RunFormatError(f"{path}: not a {MOTION_SCHEMA} dataset")
    require_known_version(convert(head, _Marker, where=str(path), error=RunFormatError).version, path)


@contextmanager
def locked(root: Path) -> Iterator[None]:
    """Hold the dataset alone, made if there is none, with what a kill left undone put right."""
    partial = root / f".{MARKER_NAME}.partial"
    with storage_errors(root, "The dataset cannot be written; make room, or choose another folder"):
        if root.exists() and not (root / MARKER_NAME).is_file() and set(root.iterdir()) - {partial}:
            raise StorageError(
                f"{root} exists and holds no {MARKER_NAME}; it is left alone. Choose another folder"
            )
        root.mkdir(parents=True, exist_ok=True)
        handle = os.open(root, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as e:
            raise StorageError(
                f"{root}: another command adds to this dataset. Wait for it, or stop it"
            ) from e
        with storage_errors(root, "The dataset cannot be written; make room"):
            if not (root / MARKER_NAME).is_file():
                replace_durably(root / MARKER_NAME, dump_json(_Marker()))
            require_dataset(root)
            (root / MOTION_FOLDER).mkdir(exist_ok=True)
            _finish(root)
            if (root / STAGED).exists():
                shutil.rmtree(root / STAGED)
        yield
    finally:
        os.close(handle)


def recover(root: Path) -> None:
    """Finish what a kill has left decided and not done; a dataset that cannot be written is left as it is."""
    if (root / _DECIDED).exists() and os.access(root, os.W_OK):
        with locked(root):
            pass


def decide(root: Path, retired: list[str]) -> None:
    """Take what is staged into the dataset, and ``retired`` places out of it: from here on it is done."""
    staged = root / STAGED
    write_durably(staged / _RETIRE_NAME, json.dumps(retired).encode())
    for folder in [path for path in staged.rglob("*") if path.is_dir()]:
        sync_folder(folder)
    sync_folder(staged)
    rename_durably(staged, root / _DECIDED)
    _finish(root)


def _finish(root: Path) -> None:
    """Put decided files into their places, and what they replace or retire among the earlier ones."""
    decided = root / _DECIDED
    if not decided.exists():
        return
    motion = root / MOTION_FOLDER
    for place in json.loads((decided / _RETIRE_NAME).read_bytes()):
        path = motion / place / FILE_NAME
        if path.is_file():
            _keep(root, place)
            path.unlink()
            sync_folder(path.parent)
            _remove_empty(path.parent, motion)
    for path in sorted(decided.rglob(FILE_NAME)):
        place = path.parent.relative_to(decided).as_posix()
        target = motion / place / FILE_NAME
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.is_file():
            _keep(root, place)
        path.replace(target)
        _sync_up(target.parent, root)
    rename_durably(decided, root / STAGED)  # done: what is left of it decides nothing any more
    shutil.rmtree(root / STAGED)


def _keep(root: Path, place: str) -> None:
    """Copy a file among the earlier ones, unless the last of them is the same."""
    path = root / MOTION_FOLDER / place / FILE_NAME
    there = earlier_files(root, place)
    identity = source_in(path)
    if there and source_in(there[-1]) == identity:
        return
    folder = root / EARLIER_FOLDER / place
    folder.mkdir(parents=True, exist_ok=True)
    partial = folder / ".partial"
    shutil.copyfile(path, partial)
    sync_file(partial)
    rename_durably(partial, folder / f"{len(there) + 1}-{identity}.parquet")
    _sync_up(folder, root)


def earlier_files(root: Path, place: str) -> list[Path]:
    """Return what stood in a place before, the oldest first."""
    folder = root / EARLIER_FOLDER / place
    paths = folder.glob("*.parquet") if folder.is_dir() else ()
    return sorted(paths, key=lambda path: int(path.name.split("-")[0]))


def source_in(path: Path) -> str | None:
    """Return the `source_id` of what a file was made of; `None` where there is no file."""
    if not path.is_file():
        return None
    return (footer_of(path).metadata or {}).get(b"bricktrack.source", b"").decode()


def footer_of(path: Path) -> "pa.parquet.FileMetaData":
    """Return a file's metadata; raise `RunFormatError` where it cannot be read."""
    try:
        return pa.parquet.read_metadata(path)
    except (OSError, pa.ArrowException) as e:
        raise RunFormatError(
            f"{path}: not a readable Parquet file: {e}. Remove it, then add the run again"
        ) from e


def _sync_up(folder: Path, root: Path) -> None:
    """Make a folder's names durable, and its own and those above it in the dataset."""
    while folder != root.parent:
        sync_folder(folder)
        folder = folder.parent


def _remove_empty(folder: Path, stop: Path) -> None:
    while folder != stop and not any(folder.iterdir()):
        folder.rmdir()
        folder = folder.parent
