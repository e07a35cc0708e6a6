"""The last test that was combined: what its page says, for those who stand at the shaking table."""

import os
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from bricktrack_common.errors import BricktrackError
from bricktrack_host.assemblies.combined_summary import (
    TEST_SUMMARY_NAME,
    AssemblyEntry,
    TestSummary,
    UnitEntry,
    read_test,
)
from bricktrack_host.campaign.test_plan import COMBINED_FOLDER
from bricktrack_host.reporting.combined_report import REPORT_NAME

REPORTS_PATH = "/lab/"
"""Below this address are the reports, at the places that they have in the laboratory's folder."""
_SERVED_NAMES = (REPORT_NAME, "interactive.html")
_EDGES = {
    "agrees": "same samples as the others",
    "corrected": "put right",
    "contradictory": "contradictory",
    "unknown": "cannot be told",
    "none": "no edges",
}


@dataclass(frozen=True, slots=True)
class LastTest:
    """The newest test's summary, or why it cannot be read; and the folder that it is in."""

    name: str
    folder: Path
    summary: TestSummary | None
    error: str

    @property
    def report(self) -> Path:
        """Where its report is, if there is one."""
        return self.folder / REPORT_NAME


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
    try:
        return LastTest(name, folder, read_test(folder), "")
    except BricktrackError as e:
        return LastTest(name, folder, None, str(e))


def served_report(lab: Path, path: str) -> Path | None:
    """Return the report at a path below a laboratory's folder; `None` for any other file, or none."""
    file = Path(os.path.normpath(lab / path))
    served = file.is_relative_to(os.path.normpath(lab)) and file.name in _SERVED_NAMES and file.is_file()
    return file if served else None


def report_address(lab: Path, report: Path) -> str | None:
    """Return where the page serves a report; `None` if there is none, or it is outside the laboratory."""
    path = os.path.relpath(report, lab)
    return REPORTS_PATH + quote(Path(path).as_posix()) if served_report(lab, path) is not None else None


def unit_rows(last: LastTest, lab: Path) -> list[dict[str, object]]:
    """Return one row for each unit, those with problems first: its run, its edges, and how good it is."""
    if last.summary is None:
        return []
    units = sorted(last.summary.units, key=lambda unit: not unit.problems)
    return [
        {
            "unit": unit.unit,
            "run": unit.run_id,
            "edges": _EDGES.get(unit.edges, unit.edges)
            + (f" by {unit.slip_samples:+d}" if unit.slip_samples else ""),
            "poses": _of(unit, "poses", "frames"),
            "sd_mm": _number(unit.figures.get("sd_mm")),
            "verdict": "; ".join(unit.problems) or "good",
            "report": _run_report(last, unit, lab),
        }
        for unit in units
    ]


def assembly_rows(summary: TestSummary) -> list[dict[str, object]]:
    """Return one row for each component of each assembly: its largest motion from rest against the base."""
    return [
        {
            "assembly": entry.name,
            "component": component or "-",
            "peak_mm": _number(entry.peak_mm.get(component)),
            "peak_deg": _number(entry.peak_deg.get(component)),
            "loops": _loops(entry),
            "verdict": "; ".join(entry.problems) or "good",
        }
        for entry in summary.assemblies
        for component in (entry.chains or {"": []})
    ]


def _loops(entry: AssemblyEntry) -> str:
    gaps = [f"{_number(loop.get('rms_mm'))} by {loop.get('unit')}" for loop in entry.loops]
    return ", ".join(gaps) or "-"


def _run_report(last: LastTest, unit: UnitEntry, lab: Path) -> str | None:
    return None if unit.results is None else report_address(lab, last.folder / unit.results / REPORT_NAME)


def _of(unit: UnitEntry, part: str, whole: str) -> str:
    some, all_ = unit.figures.get(part), unit.figures.get(whole)
    return "-" if some is None or all_ is None else f"{some} of {all_}"


def _number(value: object) -> str:
    return f"{value:.3f}" if isinstance(value, (int, float)) else "-"
