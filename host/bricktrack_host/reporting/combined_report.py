"""The report of a test: a single HTML file on all units of one shake and how the components moved."""

from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from bricktrack_host.assemblies.combined_summary import (
    AssemblyEntry,
    TestSummary,
    UnitEntry,
    read_components,
    read_test,
)
from bricktrack_host.assemblies.motion_history import MotionHistory, component_histories
from bricktrack_host.reporting.combined_charts import component_chart
from bricktrack_host.reporting.embedding import embed_chart
from bricktrack_host.reporting.page import Key, OriginTable, page_environment, write_page
from bricktrack_host.reporting.report_sections import Section, SectionTable, in_words, value_text

REPORT_NAME = "report.html"
AGREEING = ("agrees", "corrected")


@dataclass(frozen=True, slots=True)
class CombinedTest:
    """A test as it is on disk: its summary, and the motion of each assembly's components.

    Attributes
    ----------
    summary : TestSummary
    motions : dict of str to dict of str to MotionHistory
        By assembly and component; empty where an assembly could not be solved.
    """

    summary: TestSummary
    motions: dict[str, dict[str, MotionHistory]]


def read_combined_test(folder: Path) -> CombinedTest:
    """Return the test in a folder that `bricktrack combine` wrote.

    Raises
    ------
    RunFormatError
        If it holds none, or a table is missing or damaged.
    """
    summary = read_test(folder)
    motions = {
        entry.name: {} if entry.table is None else component_histories(read_components(folder, entry.name))
        for entry in summary.assemblies
    }
    return CombinedTest(summary, motions)


def write_combined_report(folder: Path, path: Path | None = None) -> Path:
    """Write the report of a test, by default into its folder, and return where it is.

    Raises
    ------
    RunFormatError
        If the folder holds no test.
    StorageError
        If the page cannot be written.
    """
    page = path or folder / REPORT_NAME
    # The runs' places are told as seen from the test's folder: from a page elsewhere they would lead nowhere.
    html = render_combined_report(read_combined_test(folder), links=page.resolve().parent == folder.resolve())
    write_page(page, html)
    return page


def render_combined_report(test: CombinedTest, *, links: bool = True) -> str:
    """Return the report's HTML text; with links to the reports of the runs where ``links``."""
    summary = test.summary
    sections = [_units_section(summary, links=links)]
    sections += [_assembly_section(entry, test.motions[entry.name]) for entry in summary.assemblies]
    line, mood = verdict(summary)
    return page_environment().get_template("combined.html.j2").render(
        run_id=summary.name,
        meta=about_test(summary),
        simulated=summary.simulated,
        provenance={"software_version": summary.software_version},
        verdict=line,
        mood=mood,
        problems=summary.problems,
        key=_key_figures(summary),
        sections=sections,
        flag_tables=[],
        origin_tables=_origin_tables(summary),
    )  # fmt: skip


def verdict(summary: TestSummary) -> tuple[str, str]:
    """Return one line on the test, and its mood: good, care or bad."""
    moved = sum(len(entry.chains) for entry in summary.assemblies)
    agree = sum(unit.edges in AGREEING for unit in summary.units)
    said = f"{agree} of {_units(len(summary.units))} on the same samples"
    if summary.assemblies:
        said += f", {_count(moved, 'component')} seen from their base"
    if summary.assemblies and not moved:
        return f"Not usable: {said}.", "bad"
    doubtful = sum(bool(unit.problems) for unit in summary.units)
    points = [_count(len(summary.problems), "point") + " to read first"] if summary.problems else []
    if doubtful:
        points.append(f"{_units(doubtful)} with points of {'its' if doubtful == 1 else 'their'} own")
    if points:
        return f"Usable with care: {said}; {', '.join(points)}.", "care"
    return f"No problem found: {said}.", "good"


def about_test(summary: TestSummary) -> str:
    """Return what a test is made of, in a line."""
    wave = "" if summary.nominal_hz is None else f" · square wave of {summary.nominal_hz:g} Hz"
    reference = "" if summary.reference is None else f" · samples counted by {summary.reference}"
    return f"Test of {_units(len(summary.units))}{wave}{reference} · bricktrack {summary.software_version}"


def _key_figures(summary: TestSummary) -> list[Key]:
    agree = sum(unit.edges in AGREEING for unit in summary.units)
    corrected = sum(unit.edges == "corrected" for unit in summary.units)
    keys = [
        Key("Units on the same samples", f"{agree} of {len(summary.units)}", f"{corrected} put right"),
        Key("Assemblies", str(len(summary.assemblies))),
    ]
    for what, unit, peaks in (
        ("Largest displacement", "mm", [entry.peak_mm for entry in summary.assemblies]),
        ("Largest rotation", "deg", [entry.peak_deg for entry in summary.assemblies]),
    ):
        found = [
            (value, f"{entry.name}, {component} from {entry.base}")
            for entry, by_component in zip(summary.assemblies, peaks, strict=True)
            for component, value in by_component.items()
        ]
        if found:
            largest, where = max(found)
            keys.append(Key(what, f"{largest:.3f} {unit}", where))
    gaps = [
        value for e in summary.assemblies for loop in e.loops if isinstance(value := loop["rms_mm"], float)
    ]
    if gaps:
        keys.append(Key("Widest loop", f"{max(gaps):.3f} mm", f"rms, of {_count(len(gaps), 'loop')}"))
    return keys


def _units_section(summary: TestSummary, *, links: bool) -> Section:
    section = Section("units", "Units", [
        "Edges: whether a unit's edge 0 is the wave's edge 0 by the reference's count. Witnesses: what each "
        "says is to be added to a unit's sample numbers, ± its standard deviation. Added: what was."
    ])  # fmt: skip
    edges = [
        [unit.unit, _run_link(unit) if links else unit.run_id, _edges_words(unit, summary),
         _witness_words(unit), f"{unit.slip_samples:+d}" if unit.slip_samples else "0"]
        for unit in summary.units
    ]  # fmt: skip
    section.tables.append(SectionTable("", ["unit", "run", "edges", "witnesses", "added"], edges, 4))
    quality = [[unit.unit, *_quality_cells(unit)] for unit in summary.units]
    head = ["unit", "frames with a pose", "dropped", "dropouts", "longest, s", "impacts", "residual, px",
            "sd, mm", "sd, deg"]  # fmt: skip
    if any(unit.figures for unit in summary.units):
        section.tables.append(SectionTable("How good each run is", head, quality, 1))
    problems = [[unit.unit, problem] for unit in summary.units for problem in unit.problems]
    if problems:
        section.tables.append(SectionTable("What their own reports say", ["unit", "problem"], problems, 2))
    return section


def _run_link(unit: UnitEntry) -> str:
    if unit.results is None:
        return unit.run_id
    # A colon in the first part of a relative path would read as a scheme.
    place = unit.results if unit.results.startswith((".", "/")) else f"./{unit.results}"
    return Markup('<a href="{}/{}">{}</a>').format(_as_url(place), REPORT_NAME, unit.run_id)


def _as_url(path: str) -> str:
    return f"file:{quote(path)}" if path.startswith("/") else quote(path)


def _edges_words(unit: UnitEntry, summary: TestSummary) -> str:
    if unit.unit == summary.reference:
        return "counts for all"
    return {"none": "no edges", "unknown": "nothing tells", "contradictory": "witnesses disagree"}.get(
        unit.edges, unit.edges
    )


def _witness_words(unit: UnitEntry) -> str:
    return (
        ", ".join(f"{w['witness']} {w['samples']:+z.2f} ± {w['sd_samples']:.2f}" for w in unit.witnesses)
        or "–"
    )


def _quality_cells(unit: UnitEntry) -> list[str]:
    f = unit.figures

    def number(name: str, digits: int) -> str:
        value = f.get(name)
        return f"{value:.{digits}f}" if isinstance(value, (int, float)) else "–"

    poses = f"{f['poses']} of {f['frames']}" if "poses" in f else "–"
    return [poses, number("frames_dropped", 0), number("dropouts", 0), number("longest_dropout_s", 2),
            number("impacts", 0), number("residual_rms_px", 3), number("sd_mm", 3),
            number("sd_deg", 3)]  # fmt: skip


def _assembly_section(entry: AssemblyEntry, motions: dict[str, MotionHistory]) -> Section:
    section = Section(f"assembly-{entry.name}", f"{entry.name} ({entry.kind})", [
        f"Motion of each component from rest, seen from {entry.base}, in the axes of the whole brick."
    ])  # fmt: skip
    section.words += entry.problems
    rows = []
    for component, chain in entry.chains.items():
        history = motions[component]
        known = history.measured
        rows.append([
            component, " then ".join(chain), ", ".join(f"{x:g}" for x in entry.points_mm[component]),
            *_peak_cells(history, entry.peak_mm.get(component), entry.peak_deg.get(component)),
            _median(history.displacement_sd_mm[known]), _median(history.rotation_sd_deg[known]),
            f"{100 * np.mean(known):.1f} %" if len(known) else "–",
        ])  # fmt: skip
    if rows:
        head = ["component", "seen by", "point, mm", "peak, mm", "at sample", "peak, deg", "sd, mm",
                "sd, deg", "measured"]  # fmt: skip
        section.tables.append(SectionTable("", head, rows, 3))
    if entry.loops:
        head = ["closed by", "rms, mm", "largest, mm", "rms, deg", "largest, deg", "over expected variance"]
        keys = ("rms_mm", "max_mm", "rms_deg", "max_deg", "normalised")
        loops = [[str(loop["unit"]), *(value_text(_rounded(loop[k])) for k in keys)] for loop in entry.loops]
        section.tables.append(SectionTable("Loops: two ways to the same component", head, loops, 1))
    for component, history in motions.items():
        section.figures.append(
            embed_chart(
                component_chart(history),
                f"Time histories of {component} seen from {entry.base}",
                f"{component} seen from {entry.base}. Shaded: a view of the chain had no optical pose. Red: "
                "impacts. Where a sensor saw nothing at all, nothing is drawn.",
            )
        )
    return section


def _peak_cells(history: MotionHistory, peak_mm: float | None, peak_deg: float | None) -> list[str]:
    if peak_mm is None or peak_deg is None:
        return ["–", "–", "–"]
    length_mm = np.linalg.norm(history.displacement_mm, axis=1)
    at = int(np.nanargmax(np.where(history.measured, length_mm, np.nan)))
    return [f"{peak_mm:.3f}", f"{history.sample[at]:.0f}", f"{peak_deg:.3f}"]


def _median(sd: np.ndarray) -> str:
    known = sd[np.isfinite(sd).all(axis=1)]
    return f"{np.median(np.linalg.norm(known, axis=1)):.3f}" if len(known) else "–"


def _rounded(value: str | float | None) -> str | float | None:
    return float(f"{value:.4g}") if isinstance(value, float) else value


def _origin_tables(summary: TestSummary) -> list[OriginTable]:
    tables = [OriginTable("Software", [("software", f"bricktrack {summary.software_version}")], True)]
    for unit in summary.units:
        p = unit.provenance
        rows = [
            ("run", unit.run_id),
            ("manifest, SHA-256", p.manifest_sha256),
            ("calibration, SHA-256", p.calibration_sha256 or "none"),
            ("layout, SHA-256", p.layout_sha256 or "none"),
            ("processed by", f"bricktrack {p.software_version}"),
        ]
        tables.append(OriginTable(unit.unit, rows, True))
    tables.append(
        OriginTable("Conventions", [(in_words(k), v) for k, v in summary.conventions.items()], False)
    )
    return tables


def _units(n: int) -> str:
    return _count(n, "unit")


def _count(n: int, what: str) -> str:
    return f"{n} {what}" if n == 1 else f"{n} {what}s"
