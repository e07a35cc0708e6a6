"""The dataset of a campaign: one Parquet file for each test, assembly and unit; added to, opened, listed.

`docs/dataset-format.md` describes the format.
"""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.dataset
import pyarrow.parquet

from bricktrack_common.errors import ConfigError, RunFormatError
from bricktrack_host.datasets.campaign_folder import (
    EARLIER_FOLDER,
    FILE_NAME,
    MOTION_FOLDER,
    STAGED,
    decide,
    earlier_files,
    footer_of,
    locked,
    recover,
    require_dataset,
    source_in,
)
from bricktrack_host.datasets.motion_rows import UnitSource, identity_of, unit_rows
from bricktrack_host.datasets.motion_schema import (
    MOTION_SCHEMA,
    PARTITION_KEYS,
    motion_schema,
    partition_schema,
    require_known_version,
)
from bricktrack_host.durable_files import storage_errors, sync_file
from bricktrack_host.results.result_store import read_result

NULL_PARTITION = "__HIVE_DEFAULT_PARTITION__"
KEY_PATTERN = r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}"


Progress = Callable[[str, int, int], None]


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
    with locked(root):
        before = {place: root / MOTION_FOLDER / place / FILE_NAME for place in places}
        identities = {}
        for i, (place, source) in enumerate(places.items()):
            say("comparing", i, len(places))
            identities[place] = identity_of(source)
        unchanged = [place for place in places if source_in(before[place]) == identities[place]]
        wanted = {place: source for place, source in places.items() if place not in unchanged}
        retired = _not_in(root, places, whole_tests=whole_tests)
        if not whole_tests:
            _require_nothing_lost(before, wanted, retired)
        staged = root / STAGED
        with storage_errors(root, "The dataset cannot be written; make room"):
            staged.mkdir()
            for i, (place, source) in enumerate(wanted.items()):
                say("adding", i, len(wanted))
                path = staged / place / FILE_NAME
                path.parent.mkdir(parents=True)
                pa.parquet.write_table(unit_rows(source, identities[place]), path, compression="zstd")
                sync_file(path)
            replaced = [place for place in wanted if before[place].is_file()]
            decide(root, retired)
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
    require_dataset(root)
    recover(root)
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
    require_dataset(root)
    recover(root)
    paths = sorted((root / MOTION_FOLDER).rglob(FILE_NAME))
    entries = []
    for i, path in enumerate(paths):
        say("reading", i, len(paths))
        entries.append(_entry(root, path))
    return entries


def _entry(root: Path, path: Path) -> UnitEntry:
    place = path.parent.relative_to(root / MOTION_FOLDER).as_posix()
    footer = footer_of(path)
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
            earlier=len(earlier_files(root, place)),
        )
    except (KeyError, ValueError, IndexError) as e:
        if isinstance(e, RunFormatError):
            raise
        raise RunFormatError(f"{path}: not of a {MOTION_SCHEMA} dataset: {e}") from e


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
        there = (footer_of(before[place]).metadata or {}).get(b"bricktrack.run_id", b"").decode()
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
