"""What a combined test's folder holds, and how it is read: the summary, and each assembly's table.

`docs/results-format.md` describes the files.
"""

from pathlib import Path

import msgspec
import pyarrow as pa

from bricktrack_common.errors import RunFormatError
from bricktrack_common.typed_data import convert, load_json
from bricktrack_host.durable_files import kept_beside
from bricktrack_host.results.result_store import Details, Provenance
from bricktrack_host.results.table_files import read_parquet

TEST_SCHEMA = "bricktrack.test"
TEST_VERSION = 1
TEST_SUMMARY_NAME = "test.json"


class UnitEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One unit of a test, in its summary.

    Attributes
    ----------
    slip_samples : int
        Added to its edge numbers.
    edges : str
        ``agrees``, ``corrected``, ``contradictory``, ``unknown``, or ``none`` without edges.
    problems : list of str
        As the report of its run says them.
    witnesses : list of dict
        What each witness says is to be added, ``samples``, and its deviation, ``sd_samples``.
    figures : dict
        How good the run is, in numbers.
    results : str or None
        Folder of the run's results, seen from the test's; absolute on another drive.
    """

    unit: str
    run_id: str
    simulated: bool
    slip_samples: int
    edges: str
    problems: list[str]
    provenance: Provenance
    witnesses: list[dict[str, str | float]] = []
    figures: Details = {}
    results: str | None = None


class AssemblyEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One assembly of a test, in its summary; ``table`` is `None` where no motion could be had."""

    name: str
    kind: str
    base: str
    chains: dict[str, list[str]]
    points_mm: dict[str, tuple[float, float, float]]
    peak_mm: dict[str, float]
    peak_deg: dict[str, float]
    loops: list[dict[str, str | float | None]]
    problems: list[str]
    table: str | None


class TestSummary(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``test.json``."""

    __test__ = False  # no test of pytest's

    schema: str = TEST_SCHEMA
    version: int = TEST_VERSION
    name: str
    simulated: bool
    nominal_hz: float | None
    reference: str | None
    units: list[UnitEntry]
    assemblies: list[AssemblyEntry]
    problems: list[str]
    conventions: dict[str, str]
    software_version: str


def read_test(folder: Path) -> TestSummary:
    """Return the summary that `combine_test` wrote.

    Raises
    ------
    RunFormatError
        If there is none, or it is of a newer version.
    """
    path = folder / TEST_SUMMARY_NAME
    if not path.is_file():
        raise RunFormatError(f"{folder}: no {TEST_SUMMARY_NAME}. Write it with 'bricktrack combine'")
    head = load_json(path, dict[str, object])
    version = head.get("version")
    if head.get("schema") != TEST_SCHEMA or not isinstance(version, int):
        raise RunFormatError(f"{path}: not a {TEST_SCHEMA} summary")
    if version > TEST_VERSION:
        raise RunFormatError(
            f"{path}: {TEST_SCHEMA} version {version}; this bricktrack reads up to version {TEST_VERSION}. "
            "Upgrade bricktrack on this machine"
        )
    return convert(head, TestSummary, where=str(path), error=RunFormatError)


def read_components(folder: Path, assembly: str) -> "pa.Table":
    """Return the table of an assembly's components that `combine_test` wrote.

    Raises
    ------
    RunFormatError
        If the test has no such assembly, or its table is missing or damaged.
    """
    entries = {entry.name: entry for entry in read_test(folder).assemblies}
    if assembly not in entries:
        raise RunFormatError(f"{folder}: no assembly {assembly!r}; there are {', '.join(entries) or 'none'}")
    table_name = entries[assembly].table
    if table_name is None:
        raise RunFormatError(f"{folder}: {assembly}: no motion: {'; '.join(entries[assembly].problems)}")
    return read_parquet(folder / table_name)


def earlier_tests(folder: Path) -> list[Path]:
    """Return the combinations of before that are kept beside a test's folder, the oldest first."""
    return kept_beside(folder, marker=TEST_SUMMARY_NAME)
