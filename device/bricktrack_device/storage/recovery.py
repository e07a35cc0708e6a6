"""What a power cut or a bad card left: whole runs are finished, others get a manifest of what is there.

Nothing goes: what cannot be read is kept under another name.
"""

import errno
import logging
import re
import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

import msgspec

from bricktrack_common.errors import RunFormatError
from bricktrack_common.frame_times import FrameTimes, read_frames
from bricktrack_common.imu_records import ImuDescription, read_imu
from bricktrack_common.run_folder import read_edges
from bricktrack_common.run_manifest import (
    EDGES_NAME,
    FILE_NAME_PATTERN,
    FRAMES_NAME,
    MANIFEST_NAME,
    VIDEO_NAME,
    ClocksSection,
    FileEntry,
    NewerRunError,
    QualitySection,
    RunManifest,
    TriggerSection,
    file_entry,
    is_run_id,
    parse_manifest,
    read_manifest,
)
from bricktrack_common.typed_data import dump_json
from bricktrack_device.storage.disk import storage_error
from bricktrack_device.storage.folder_lock import FolderLock
from bricktrack_device.storage.run_store import RunStore
from bricktrack_device.storage.run_writer import DRAFT_NAME, PARTIAL_SUFFIX

logger = logging.getLogger(__name__)

DAMAGED_SUFFIX = ".damaged"
_CUT_OFF = "no whole manifest was on the card: saving was cut off, or the card lost it; what is there is here"
_NOT_THE_CARD = {errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EINTR, errno.EACCES, errno.EPERM}

T = TypeVar("T")


def recover_runs(store: RunStore, black_box: Path | None = None) -> list[str]:
    """Turn what a power cut left into runs: finish whole ones, mark the others interrupted.

    A run whose manifest was lost later, by a failing card, is taken up again in the same way; so is the one
    of which a killed daemon left a copy in memory.

    Parameters
    ----------
    store : RunStore
    black_box : Path or None
        Where such copies are (`capture.black_box`).

    Returns
    -------
    recovered : list of str
        Run ids. What cannot be recovered stays where it is, with a word in the log: the unit must come up.
    """
    store.empty_deleted()
    for folder in store.folders():
        try:
            _reopen_if_damaged(folder, store)
        except OSError as e:
            logger.warning("%s: cannot be recovered now: %s", folder, e.strerror or e)
    not_yet = {copy.name for copy in waiting_copies(black_box) if not _bring_in(copy, store)}
    recovered = []
    for folder in sorted(store.runs.glob(f"*{PARTIAL_SUFFIX}")):
        run_id = folder.name.removesuffix(PARTIAL_SUFFIX)
        if run_id in not_yet:
            continue
        if not folder.is_dir() or not is_run_id(run_id):
            logger.warning("%s: not a run folder's name; left alone", folder)
            continue
        if (store.runs / run_id).exists():
            logger.warning("%s: a run of this name exists already; left alone", folder)
            continue
        try:
            _finish(folder, run_id, store)
        except OSError as e:
            logger.warning("%s: cannot be recovered now: %s", folder, e.strerror or e)
        except Exception:
            logger.exception("%s: a bug in its recovery; left alone", folder)
        else:
            recovered.append(run_id)
    return recovered


def waiting_copies(black_box: Path | None) -> list[Path]:
    """Return what a killed daemon left in memory; nothing, and a word in the log, where it cannot be had."""
    try:
        return sorted(p for p in black_box.iterdir() if p.name[0] != ".") if black_box is not None else []
    except FileNotFoundError:  # it is made with the first run
        return []
    except OSError as e:
        logger.warning("%s: cannot be listed: %s", black_box, e.strerror or e)
        return []


def _bring_in(copy: Path, store: RunStore) -> bool:
    """Put a run that a killed daemon left in memory on the card, as one whose saving was cut off.

    The copy goes when the card has it all; what the daemon itself had saved whole is the better one. One of
    another unit, or of a daemon that is still at work, is not ours to take. Tell whether nothing is left to
    be done.
    """
    run_id = copy.name
    if not is_run_id(run_id) or not copy.is_dir():
        logger.warning("%s: not a run folder's name; left alone", copy)
        return True
    if not store.is_own(run_id):
        logger.warning("%s: is of another unit than %s; left alone", copy, store.unit)
        return True
    try:
        lock = FolderLock(copy)
    except BlockingIOError:
        logger.warning("%s: another bricktrackd is at work on it; left alone", copy)
        return True
    except OSError as e:
        logger.warning("%s: cannot be had now: %s; kept in memory", copy, e.strerror or e)
        return False
    try:
        return _put_on_card(copy, run_id, store)
    finally:
        lock.release()


def _put_on_card(copy: Path, run_id: str, store: RunStore) -> bool:
    """Copy what is in memory beside its final name, and do away with it; tell whether that worked."""
    unfinished = store.runs / (run_id + PARTIAL_SUFFIX)
    if not (copy / DRAFT_NAME).exists():
        logger.warning("%s: the daemon was killed before anything was in it", copy)
    elif not (store.runs / run_id).exists() and not _is_whole(unfinished):
        try:
            if not unfinished.is_dir():
                store.disk.make_folder(unfinished)
            for path in sorted(p for p in copy.iterdir() if re.fullmatch(FILE_NAME_PATTERN, p.name)):
                with path.open("rb") as contents:
                    store.disk.write_file(unfinished / path.name, partial(shutil.copyfileobj, contents))
        except OSError as e:
            logger.warning("%s: cannot be put on the card now: %s; kept in memory", copy, e.strerror or e)
            return False
    shutil.rmtree(copy, ignore_errors=True)
    return True


def _reopen_if_damaged(folder: Path, store: RunStore) -> None:
    """Take up a run again whose manifest is lost, none any more, or another than its draft says.

    One of a newer version is left alone.
    """
    path = folder / MANIFEST_NAME
    if path.is_file():
        try:
            manifest = parse_manifest(path.read_bytes(), where=str(path))
        except NewerRunError as e:
            logger.warning("%s", e)
            return
        except RunFormatError as e:
            problem = str(e)
        else:
            altered = _differing(manifest, folder)
            if not altered:
                return
            problem = f"{path}: {', '.join(altered)}: not as in {DRAFT_NAME}"
        aside = path.with_name(MANIFEST_NAME + DAMAGED_SUFFIX)
        logger.warning("%s; kept as %s", problem, aside.name)
        store.disk.rename(path, aside)
    elif not folder.is_dir() or not any(_is_run_file(p) for p in folder.iterdir()):
        logger.warning("%s: holds nothing of a run; left alone", folder)
        return
    # Without a manifest perhaps since a power cut between the two renamings.
    store.disk.rename(folder, folder.with_name(folder.name + PARTIAL_SUFFIX))


def describe_anew_if_altered(store: RunStore, run_id: str) -> list[str]:
    """Compare a run's files with the manifest; where the card altered or lost one, describe them as they are.

    The new manifest takes the place of the old one, kept as ``manifest.json.damaged``, in one step: the run
    is on offer throughout.

    Returns
    -------
    altered : list of str
        The files' names. The manifest made anew says so, and counts the run as interrupted.

    Raises
    ------
    RunFormatError
        If the manifest cannot be read.
    StorageError
        If the card is full or fails; what the manifest said still holds.
    """
    folder = store.runs / run_id
    path = folder / MANIFEST_NAME
    before = read_manifest(path)
    is_doubted = bool(_differing(before, folder))
    try:
        altered = [MANIFEST_NAME] if is_doubted else []
        altered += [f.name for f in before.files if _entry(folder / f.name) != f]
        if altered:
            logger.warning("%s: altered on the card since it was saved: %s", run_id, ", ".join(altered))
            contents = path.read_bytes()
            aside = path.with_name(MANIFEST_NAME + DAMAGED_SUFFIX)
            store.disk.write_file(aside, lambda f: f.write(contents))
            words = [
                f"{name}: the card altered it after it was saved; what is left is as found"
                for name in altered
            ]
            anew = rebuild_manifest(folder, run_id, store.unit, None if is_doubted else before)
            anew = _with_files(anew, folder, words)
            temporary = path.with_name(f".{MANIFEST_NAME}")  # no name of a run's file
            store.disk.write_file(temporary, lambda f: f.write(dump_json(anew)))
            try:
                store.disk.rename(temporary, path)
            finally:
                store.forget(run_id)
    except OSError as e:
        raise storage_error(f"{folder}: cannot be compared with its manifest", e) from e
    return altered


def _differing(manifest: RunManifest, folder: Path) -> list[str]:
    """Return the keys in which a manifest and its draft differ: the card has altered one of them."""
    try:
        draft = read_manifest(folder / DRAFT_NAME)
    except RunFormatError:
        return []
    keys = set(draft.__struct_fields__) - {"state", "missing", "files"}
    return sorted(k for k in keys if getattr(manifest, k) != getattr(draft, k))


def _why(folder: Path) -> str:
    """Return in words why a run has no manifest of its own any more."""
    try:
        altered = _differing(read_manifest(folder / (MANIFEST_NAME + DAMAGED_SUFFIX)), folder)
    except RunFormatError:
        altered = []
    if not altered:
        return _CUT_OFF
    return (
        f"the card altered the manifest or its draft: {', '.join(altered)} are the draft's, and may be wrong"
    )


def _finish(folder: Path, run_id: str, store: RunStore) -> None:
    """Give a folder its final name, with a manifest made anew where its own is not whole."""
    if not _is_whole(folder):
        manifest = _with_files(rebuild_manifest(folder, run_id, store.unit), folder, [_why(folder)])
        store.disk.write_file(folder / MANIFEST_NAME, lambda f: f.write(dump_json(manifest)))
        store.disk.sync_folder(folder)
    store.forget(run_id)
    store.disk.rename(folder, store.runs / run_id)


def _with_files(manifest: RunManifest, folder: Path, why: Sequence[str]) -> RunManifest:
    """Return a manifest made anew with the files that are there, the reasons, and what cannot be read."""
    found = {p.name: _entry(p) for p in sorted(folder.iterdir()) if _is_run_file(p)}
    unreadable = [f"{name} is on the card and cannot be read" for name, entry in found.items() if not entry]
    return msgspec.structs.replace(
        manifest,
        missing=[*manifest.missing, *why, *unreadable],
        files=[entry for entry in found.values() if entry],
    )


def _entry(path: Path) -> FileEntry | None:
    """Return name, size and hash of a file; `None` of one that the card does not give.

    Raises
    ------
    OSError
        If that is not the card's doing: the file may be whole.
    """
    try:
        return file_entry(path)
    except OSError as e:
        if e.errno in _NOT_THE_CARD:
            raise
        logger.warning("%s: %s", path, e.strerror or e)
        return None


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


def rebuild_manifest(folder: Path, run_id: str, unit: str, before: RunManifest | None = None) -> RunManifest:
    """Return a manifest, still without files, over what a folder holds.

    The one ``before``, or else the draft that was written first, gives camera, clocks and trigger; without it
    the streams' own headers must do, and the manifest says so. A stream that cannot be read is renamed, so
    that it stands in nobody's way and is still there.
    """
    missing: list[str] = []
    imus: list[ImuDescription] = []
    t0_ns: int | None = None
    for path in sorted(folder.glob("imu_*.msgpack")):
        read = _read_or_set_aside(path, read_imu, missing)
        if read is not None:
            imus.append(read[0])
    if (edges := _read_or_set_aside(folder / EDGES_NAME, read_edges, missing)) is not None:
        t0_ns = int(edges[0][0]) if edges[0].size else None
    frames = _read_or_set_aside(folder / FRAMES_NAME, read_frames, missing)
    try:
        manifest = before or read_manifest(folder / DRAFT_NAME)
    except RunFormatError:
        missing.append("the run's description was lost: camera settings, clocks and window are unknown")
        manifest = RunManifest(
            run_id=run_id, unit=unit, label="", state="interrupted", simulated=False, origin="bricktrackd",
            hardware={}, software={}, camera=None, imus=imus,
            trigger=TriggerSection(pin="unknown", t0_ns=t0_ns), clocks=ClocksSection(), window_ns=None,
            quality=QualitySection(), missing=[], files=[],
        )  # fmt: skip
    missing += _words_of_absent_files(folder, manifest, frames)
    return msgspec.structs.replace(manifest, state="interrupted", missing=manifest.missing + missing)


def _read_or_set_aside(path: Path, read: Callable[[Path], T], missing: list[str]) -> T | None:
    if not path.exists():
        return None
    try:
        return read(path)
    except RunFormatError as e:
        if isinstance(e.__cause__, OSError) and e.__cause__.errno in _NOT_THE_CARD:
            raise e.__cause__ from None
        aside = path.with_name(path.name + DAMAGED_SUFFIX)
        path.rename(aside)
        logger.warning("%s; kept as %s", e, aside.name)
        missing.append(f"{path.name} cannot be read and is kept as {aside.name}")
        return None


def _words_of_absent_files(folder: Path, manifest: RunManifest, frames: FrameTimes | None) -> list[str]:
    words = [
        f"imu_{imu.name}.msgpack did not reach the card"
        for imu in manifest.imus
        if not (folder / f"imu_{imu.name}.msgpack").exists()
    ]
    if not (folder / EDGES_NAME).exists():
        words.append(f"{EDGES_NAME} did not reach the card")
    video = folder / VIDEO_NAME
    if not video.exists():
        words.append(f"{VIDEO_NAME} did not reach the card")
    if frames is None:
        words.append(f"{FRAMES_NAME} did not reach the card")
    elif video.exists():
        ends = frames.byte_offset + frames.n_bytes
        whole = int((ends <= video.stat().st_size).sum())
        if whole < frames.n_frames:
            words.append(f"{VIDEO_NAME} is cut: {whole} of {frames.n_frames} pictures are whole")
    return words
