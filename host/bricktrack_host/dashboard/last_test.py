"""The last test that was combined: what its page says, for those who stand at the shaking table."""

from dataclasses import dataclass
from pathlib import Path

from bricktrack_common.errors import BricktrackError
from bricktrack_host.assemblies.combined_test import TEST_SUMMARY_NAME, TestSummary, read_test
from bricktrack_host.campaign.test_plan import COMBINED_FOLDER
from bricktrack_host.reporting.combined_report import REPORT_NAME


@dataclass(frozen=True, slots=True)
class LastTest:
    """The newest test's summary, or why it cannot be read; and its report, if there is one."""

    name: str
    summary: TestSummary | None
    error: str
    report: Path | None


def find_last_test(tests_folder: Path) -> LastTest | None:
    """Return the test that was combined last, below ``tests/`` beside the fleet file; `None` of none."""
    found = [
        path
        for pattern in (f"*/{COMBINED_FOLDER}/{TEST_SUMMARY_NAME}", f"*/{TEST_SUMMARY_NAME}")
        for path in tests_folder.glob(pattern)
    ]
    if not found:
        return None
    folder = max(found, key=lambda path: path.stat().st_mtime_ns).parent
    name = folder.parent.name if folder.name == COMBINED_FOLDER else folder.name
    report = folder / REPORT_NAME
    shown = report if report.is_file() else None
    try:
        return LastTest(name, read_test(folder), "", shown)
    except BricktrackError as e:
        return LastTest(name, None, str(e), shown)


def unit_rows(summary: TestSummary) -> list[dict[str, object]]:
    """Return one row for each unit: its run, its edges against the others', and what is wrong with it."""
    edges = {
        "agrees": "same samples as the others",
        "corrected": "put right",
        "contradictory": "contradictory",
        "unknown": "cannot be told",
        "none": "no edges",
    }
    return [
        {
            "unit": unit.unit,
            "run": unit.run_id,
            "edges": edges.get(unit.edges, unit.edges)
            + (f" by {unit.slip_samples:+d}" if unit.slip_samples else ""),
            "verdict": "; ".join(unit.problems) or "good",
        }
        for unit in summary.units
    ]


def assembly_rows(summary: TestSummary) -> list[dict[str, object]]:
    """Return one row for each component of each assembly: its largest motion from rest against the base."""
    return [
        {
            "assembly": entry.name,
            "component": component,
            "peak_mm": _number(entry.peak_mm.get(component)),
            "peak_deg": _number(entry.peak_deg.get(component)),
            "verdict": "; ".join(entry.problems) or "good",
        }
        for entry in summary.assemblies
        for component in (entry.chains or {"": []})
    ]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
