"""The dataset of a campaign on disk: a file for each test, assembly and unit, added whole or not at all.

    campaign/
        dataset.json                                       schema and version
        motion/test=T/assembly=A/unit=U/motion.parquet     what was added last
        earlier/test=T/assembly=A/unit=U/1-<id>.parquet    what stood there before, never deleted

What is to be added is first written aside and synced; one rename then decides, and each file is put into its
place by another. After a kill behind the decision the next command of any kind does the rest.
`docs/dataset-format.md` describes the format.
"""

import fcntl
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import msgspec
import pyarrow as pa
import pyarrow.dataset
import pyarrow.parquet

from bricktrack_common.errors import ConfigError, RunFormatError, StorageError
from bricktrack_common.typed_data import convert, dump_json, load_json
from bricktrack_host.datasets.motion_rows import UnitSource, identity_of, unit_rows
from bricktrack_host.datasets.motion_schema import (
    MOTION_SCHEMA,
    MOTION_VERSION,
    PARTITION_KEYS,
    motion_schema,
    partition_schema,
    require_known_version,
)
from bricktrack_host.durable_files import (
    rename_durably,
    storage_errors,
    sync_file,
    sync_folder,
    write_durably,
)
from bricktrack_host.results.result_store import read_result

MARKER_NAME = "dataset.json"
MOTION_FOLDER = "motion"
EARLIER_FOLDER = "earlier"
FILE_NAME = "motion.parquet"
NULL_PARTITION = "__HIVE_DEFAULT_PARTITION__"
KEY_PATTERN = r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}"

_STAGED = ".adding"
_DECIDED = ".decided"
_RETIRE_NAME = "retire.json"

Progress = Callable[[str, int, int], None]


class _Marker(msgspec.Struct, frozen=True, kw_only=True):
    schema: str = MOTION_SCHEMA
    version: int = MOTION_VERSION


@dataclass(frozen=True, slots=True)
class AddedUnits:
    """What became of what was to be added, as ``test/assembly/unit``.

    Attributes
    ----------
    added, replaced, unchanged : list of str
        New; instead of others, which are kept among the earlier ones; there already, to the last bit.
    retired : list of str
        No longer in their test, or not in this assembly: kept among the earlier ones.
    """

    added: list[str]
    replaced: list[str]
    unchanged: list[str]
    retired: list[str]


@dataclass(frozen=True, slots=True)
class UnitEntry:
    """One file of a dataset, without its rows.

    Attributes
    ----------
    test, unit : str
    assembly : str or None
    run_id, results_id : str
    version : int
        Of the schema that it was written with.
    simulated : bool
    sample_agreement : str
    rows, size_bytes : int
    components : list of str
        Those that it has rows of, seen from the base.
    problems : list of str
        Of the run, in words.
    earlier : int
        How many files of before are kept.
    """

    test: str
    assembly: str | None
    unit: str
    run_id: str
    results_id: str
    version: int
    simulated: bool
    sample_agreement: str
    rows: int
    size_bytes: int
    components: list[str]
    problems: list[str]
    earlier: int


def add_units(
    root: Path,
    sources: Sequence[UnitSource],
    *,
    whole_tests: bool,
    progress: Progress | None = None,
) -> AddedUnits:
    """Add units to a dataset, which is made if there is none: all of them, or none.

    Parameters
    ----------
    root : Path
    sources : sequence of UnitSource
    whole_tests : bool
        The sources are all units of their tests: others of these tests are retired.
    progress : callable, optional
        Called with what is being done, how many are done, and of how many.

    Raises
    ------
    ConfigError
        If a name cannot be that of a folder, two sources are of the same place, or, without ``whole_tests``,
        the dataset has another run of a unit in this test, or has it with its assembly.
    RunFormatError
        If results cannot be read, or the dataset is of a newer version.
    StorageError
        If the dataset cannot be written, or another command writes to it.
    """
    say = progress or (lambda _what, _done, _of: None)
    places = _places(sources)
    with _locked(root):
        before = {place: root / MOTION_FOLDER / place / FILE_NAME for place in places}
        identities = {}
        for i, (place, source) in enumerate(places.items()):
            say("comparing", i, len(places))
            identities[place] = identity_of(source)
        unchanged = [place for place in places if _source_in(before[place]) == identities[place]]
        wanted = {place: source for place, source in places.items() if place not in unchanged}
        retired = _not_in(root, places, whole_tests=whole_tests)
        if not whole_tests:
            _require_nothing_lost(before, wanted, retired)
        staged = root / _STAGED
        with storage_errors(root, "The dataset cannot be written; make room"):
            staged.mkdir()
            for i, (place, source) in enumerate(wanted.items()):
                say("adding", i, len(wanted))
                path = staged / place / FILE_NAME
                path.parent.mkdir(parents=True)
                pa.parquet.write_table(unit_rows(source, identities[place]), path, compression="zstd")
                sync_file(path)
            write_durably(staged / _RETIRE_NAME, json.dumps(retired).encode())
            for folder in [path for path in staged.rglob("*") if path.is_dir()]:
                sync_folder(folder)
            sync_folder(staged)
            replaced = [place for place in wanted if before[place].is_file()]
            rename_durably(staged, root / _DECIDED)
            _finish(root)
    return AddedUnits(
        added=[_words(place) for place in wanted if place not in replaced],
        replaced=[_words(place) for place in replaced],
        unchanged=[_words(place) for place in unchanged],
        retired=[_words(place) for place in retired],
    )


def open_dataset(root: Path, *, earlier: bool = False) -> "pa.dataset.Dataset":
    """Return a dataset for queries: the rows added last, or all of before.

    Its schema is that of this version, and ``test``, ``assembly``, ``unit`` are words. Columns that an older
    file does not have read as null.

    Raises
    ------
    RunFormatError
        If there is no dataset, or it is of a newer version.
    """
    _require_dataset(root)
    _recover(root)
    schema = motion_schema()
    for key in partition_schema():
        schema = schema.append(key)
    partitioning = pa.dataset.partitioning(partition_schema(), flavor="hive")
    folder = root / (EARLIER_FOLDER if earlier else MOTION_FOLDER)
    files = [str(path) for path in sorted(folder.rglob("*.parquet"))]
    return pa.dataset.dataset(
        files, schema=schema, format="parquet", partitioning=partitioning, partition_base_dir=str(folder)
    )


def list_units(root: Path, *, progress: Progress | None = None) -> list[UnitEntry]:
    """Return what a dataset holds, in the order of tests, assemblies and units.

    Raises
    ------
    RunFormatError
        If there is no dataset, it is of a newer version, or a file is damaged.
    """
    say = progress or (lambda _what, _done, _of: None)
    _require_dataset(root)
    _recover(root)
    paths = sorted((root / MOTION_FOLDER).rglob(FILE_NAME))
    entries = []
    for i, path in enumerate(paths):
        say("reading", i, len(paths))
        entries.append(_entry(root, path))
    return entries


def _entry(root: Path, path: Path) -> UnitEntry:
    place = path.parent.relative_to(root / MOTION_FOLDER).as_posix()
    footer = _footer(path)
    facts = {key.decode(): value.decode() for key, value in (footer.metadata or {}).items()}
    try:
        test, assembly, unit = (part.split("=", 1)[1] for part in place.split("/"))
        return UnitEntry(
            test=test,
            assembly=None if assembly == NULL_PARTITION else assembly,
            unit=unit,
            run_id=facts["bricktrack.run_id"],
            results_id=facts["bricktrack.results_id"],
            version=require_known_version(int(facts["bricktrack.version"]), path),
            simulated=facts["bricktrack.simulated"] == "true",
            sample_agreement=facts["bricktrack.sample_agreement"],
            rows=footer.num_rows,
            size_bytes=path.stat().st_size,
            components=list(json.loads(facts["bricktrack.chains"])),
            problems=list(json.loads(facts["bricktrack.problems"])),
            earlier=len(_earlier_files(root, place)),
        )
    except (KeyError, ValueError, IndexError) as e:
        if isinstance(e, RunFormatError):
            raise
        raise RunFormatError(f"{path}: not of a {MOTION_SCHEMA} dataset: {e}") from e


def _footer(path: Path) -> "pa.parquet.FileMetaData":
    try:
        return pa.parquet.read_metadata(path)
    except (OSError, pa.ArrowException) as e:
        raise RunFormatError(
            f"{path}: not a readable Parquet file: {e}. Remove it, then add the run again"
        ) from e


def _source_in(path: Path) -> str | None:
    """Return the `source_id` of what a file was made of; `None` where there is no file."""
    if not path.is_file():
        return None
    return (_footer(path).metadata or {}).get(b"bricktrack.source", b"").decode()


def _require_nothing_lost(before: dict[str, Path], wanted: dict[str, UnitSource], others: list[str]) -> None:
    """Refuse runs, added without their test, that would take the place of another run or of an assembly."""
    if others:
        raise ConfigError(
            f"{_words(others[0])} is there already, with its assembly. Combine its test again and add that, "
            "or give another --test"
        )
    for place, source in wanted.items():
        if not before[place].is_file():
            continue
        there = (_footer(before[place]).metadata or {}).get(b"bricktrack.run_id", b"").decode()
        run_id = read_result(source.results).manifest.run_id
        if run_id != there:
            raise ConfigError(
                f"{_words(place)}: the dataset has run {there} there, not {run_id}. Give another --test for "
                "another shake; or add the combined test, which says which run is meant"
            )


def _places(sources: Sequence[UnitSource]) -> dict[str, UnitSource]:
    places: dict[str, UnitSource] = {}
    for source in sources:
        for key in PARTITION_KEYS:
            name = getattr(source, key)
            if name is not None and re.fullmatch(KEY_PATTERN, name) is None:
                raise ConfigError(
                    f"{key} {name!r} cannot be the name of a folder that every program reads alike: letters, "
                    "digits, dots, hyphens and underscores. Name the test with --test"
                )
        place = f"test={source.test}/assembly={source.assembly or NULL_PARTITION}/unit={source.unit}"
        if place in places:
            raise ConfigError(
                f"{_words(place)}: two runs, {places[place].results} and {source.results}. Add one of them, "
                "or each with a --test of its own"
            )
        places[place] = source
    return places


def _words(place: str) -> str:
    return "/".join(
        "-" if part.endswith(f"={NULL_PARTITION}") else part.split("=", 1)[1] for part in place.split("/")
    )


def _not_in(root: Path, places: dict[str, UnitSource], *, whole_tests: bool) -> list[str]:
    """Return places of the same tests that are not among those to be added, of the same units or of all."""
    found = []
    for test in dict.fromkeys(source.test for source in places.values()):
        units = {source.unit for source in places.values() if source.test == test}
        for path in sorted((root / MOTION_FOLDER / f"test={test}").rglob(FILE_NAME)):
            place = path.parent.relative_to(root / MOTION_FOLDER).as_posix()
            unit = path.parent.name.removeprefix("unit=")
            if place not in places and (whole_tests or unit in units):
                found.append(place)
    return found


def _require_dataset(root: Path) -> None:
    path = root / MARKER_NAME
    if not path.is_file():
        raise RunFormatError(f"{root}: no {MARKER_NAME}: no dataset. Make it with 'bricktrack dataset add'")
    head = load_json(path, dict[str, object])
    if head.get("schema") != MOTION_SCHEMA:
        raise RunFormatError(f"{path}: not a {MOTION_SCHEMA} dataset")
    require_known_version(convert(head, _Marker, where=str(path), error=RunFormatError).version, path)


@contextmanager
def _locked(root: Path) -> Iterator[None]:
    """Hold the dataset alone, made if there is none, with what a kill left undone put right."""
    if root.exists() and not (root / MARKER_NAME).is_file() and any(root.iterdir()):
        raise StorageError(
            f"{root} exists and holds no {MARKER_NAME}; it is left alone. Choose another folder"
        )
    with storage_errors(root, "The dataset cannot be written; make room, or choose another folder"):
        (root / MOTION_FOLDER).mkdir(parents=True, exist_ok=True)
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
                partial = root / f".{MARKER_NAME}.partial"
                partial.unlink(missing_ok=True)
                write_durably(partial, dump_json(_Marker()))
                rename_durably(partial, root / MARKER_NAME)
            _require_dataset(root)
            _finish(root)
            if (root / _STAGED).exists():
                shutil.rmtree(root / _STAGED)
        yield
    finally:
        os.close(handle)


def _recover(root: Path) -> None:
    """Finish what a kill has left decided and not done; a dataset that cannot be written is left as it is."""
    if (root / _DECIDED).exists() and os.access(root, os.W_OK):
        with _locked(root):
            pass


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
    shutil.rmtree(decided)
    sync_folder(root)


def _keep(root: Path, place: str) -> None:
    """Copy a file among the earlier ones, unless the last of them is the same."""
    path = root / MOTION_FOLDER / place / FILE_NAME
    there = _earlier_files(root, place)
    identity = _source_in(path)
    if there and _source_in(there[-1]) == identity:
        return
    folder = root / EARLIER_FOLDER / place
    folder.mkdir(parents=True, exist_ok=True)
    partial = folder / ".partial"
    shutil.copyfile(path, partial)
    sync_file(partial)
    rename_durably(partial, folder / f"{len(there) + 1}-{identity}.parquet")
    _sync_up(folder, root)


def _earlier_files(root: Path, place: str) -> list[Path]:
    folder = root / EARLIER_FOLDER / place
    paths = folder.glob("*.parquet") if folder.is_dir() else ()
    return sorted(paths, key=lambda path: int(path.name.split("-")[0]))


def _sync_up(folder: Path, root: Path) -> None:
    """Make a folder's names durable, and its own and those above it in the dataset."""
    while folder != root.parent:
        sync_folder(folder)
        folder = folder.parent


def _remove_empty(folder: Path, stop: Path) -> None:
    while folder != stop and not any(folder.iterdir()):
        folder.rmdir()
        folder = folder.parent
