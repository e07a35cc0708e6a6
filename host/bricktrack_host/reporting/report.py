"""The report of one run: a single HTML file that needs no network, no script and no other file."""

import datetime
import inspect
import re
from dataclasses import dataclass
from enum import IntFlag
from pathlib import Path

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.imu_records import ImuFlag
from bricktrack_host.quality import LedFlag, PoseFlag
from bricktrack_host.reporting.page import Key, OriginTable, page_environment, write_page
from bricktrack_host.reporting.report_sections import ReportExtras, in_words, report_sections, value_text
from bricktrack_host.results.result_store import RunResult
from bricktrack_host.results.run_summary import KeyFigures, key_figures, main_track, verdict

__all__ = ["ReportExtras", "flag_meanings", "recording_date", "render_report", "write_report"]

_FIRST_DATE = datetime.datetime(2024, 1, 1, tzinfo=datetime.UTC)  # before it, the clock was never set


def write_report(result: RunResult, path: Path, extras: ReportExtras | None = None) -> None:
    """Write the report of a run as one HTML file; an older one stays until the new one is whole.

    Raises
    ------
    StorageError
        If it cannot be written.
    """
    write_page(path, render_report(result, extras))


def render_report(result: RunResult, extras: ReportExtras | None = None) -> str:
    """Return the report's HTML text."""
    extras = extras or ReportExtras()
    figures = key_figures(result)
    line, problems = verdict(result, figures)
    mood = "bad" if not figures.n_poses else "care" if problems else "good"
    sections = report_sections(result, figures, extras)
    return (
        page_environment()
        .get_template("report.html.j2")
        .render(
            run_id=result.manifest.run_id,
            unit=result.manifest.unit,
            label=result.manifest.label,
            simulated=result.manifest.simulated,
            date=recording_date(result),
            provenance=result.provenance,
            verdict=line,
            mood=mood,
            problems=problems,
            key=_key_figures(result, figures),
            sections=sections,
            flag_tables=_flag_tables(result),
            origin_tables=_origin_tables(result),
        )
    )


def recording_date(result: RunResult) -> str:
    """Return when the run was recorded by the unit's clock, or words that it was not set."""
    clocks = result.manifest.clocks
    triplet = clocks.trigger or clocks.arm or clocks.end
    if triplet is None:
        return "no date: the unit's clock was not logged"
    try:
        when = datetime.datetime.fromtimestamp(triplet.realtime_ns // 10**9, tz=datetime.UTC)
    except (OverflowError, OSError, ValueError):
        return "no date: the unit's clock was not set"
    if when < _FIRST_DATE:
        return "no date: the unit's clock was not set"
    return when.strftime("%d %B %Y, %H:%M:%S UTC").lstrip("0")


# Key figures and tables.


def _key_figures(result: RunResult, f: KeyFigures) -> list[Key]:
    longest_s = float((f.dropouts_ns[:, 1] - f.dropouts_ns[:, 0]).max() / 1e9) if len(f.dropouts_ns) else 0.0
    longest = f"longest {longest_s:.2f} s" if longest_s else ""
    dropped = f"{f.n_frames_dropped} dropped by the camera"
    keys = [
        Key("Frames with a pose", f"{f.n_poses} of {f.n_frames}", dropped),
        Key("Duration", f"{f.duration_s:.2f} s", "" if result.t0_ns is not None else "no trigger"),
        Key("Times without a pose", str(len(f.dropouts_ns)), longest),
        Key("LED residual", _number(f.residual_rms_px, 3, "px"), "rms over LEDs used"),
        Key("Peak displacement", _triple(f.peak_mm, 2, "mm"), "x, y, z from rest"),
        Key("Peak rotation", _triple(f.peak_deg, 2, "deg"), "about x, y, z from rest"),
        Key("Peak speed", _number(f.peak_speed_mmps, 0, "mm/s")),
        Key("Standard deviation", _triple(f.sd_mm, 3, "mm"), "x, y, z, camera axes; median"),
        Key("Standard deviation", _triple(f.sd_deg, 3, "deg"), "about brick axes; median"),
        Key("Inertial samples", str(f.n_imu) if f.n_imu else "none",
             f"{f.n_imu_unusable} not usable" if f.n_imu else ""),
        Key("Impacts", str(len(f.impacts_ns)) if result.fused else "–"),
    ]  # fmt: skip
    fit = result.edge_fit
    if fit is None:
        keys.append(Key("Square wave", "none"))
    else:
        rate = "" if fit.nominal_hz is None else f"{fit.rate_ppm:+.1f} ppm by the unit's clock"
        keys.append(Key("Square wave", f"{1e9 / fit.period_ns:.3f} Hz", rate))
    return keys


@dataclass(frozen=True, slots=True)
class _FlagRow:
    name: str
    count: int
    meaning: str


@dataclass(frozen=True, slots=True)
class _FlagTable:
    title: str
    rows: list[_FlagRow]


def flag_meanings(kind: type[IntFlag]) -> dict[str, str]:
    """Return the words under each bit in the source of a flag class, where each is documented once.

    Examples
    --------
    >>> flag_meanings(LedFlag)["MISSING"]
    'Not found in the picture; its coordinates are NaN.'
    """
    # The class alone would be sought by parsing the whole file, which takes longer than a chart.
    after = Path(inspect.getfile(kind)).read_text(encoding="utf-8").split(f"\nclass {kind.__name__}(")[1]
    body = re.split(r"\n(?=\S)", after, maxsplit=1)[0]
    pairs = re.findall(r'^    ([A-Z_]+) = \d+\n    """(.*?)"""', body, re.M | re.S)
    return {name: " ".join(words.split()) for name, words in pairs}


def _flag_tables(result: RunResult) -> list[_FlagTable]:
    given: list[tuple[str, type[IntFlag], IntArray]] = [
        ("Optical poses", PoseFlag, result.optical.flags),
        ("LEDs", LedFlag, result.observations.led_flags),
    ]
    track = main_track(result)
    if track is not None:
        given.insert(1, ("Fused poses", PoseFlag, track.flags))
    if result.imu is not None:
        given.append(("Inertial samples", ImuFlag, result.imu.flags))
    tables = []
    for title, kind, flags in given:
        meanings = flag_meanings(kind)
        rows = [
            _FlagRow(
                (f.name or "").lower().replace("_", " "),
                int(np.count_nonzero(flags & int(f))),
                meanings.get(f.name or "", ""),
            )
            for f in kind
            if int(f)
        ]
        if title == "Optical poses":
            rows = [row for row in rows if not row.meaning.startswith("Fused:")]
        tables.append(_FlagTable(f"{title}, {flags.size} in all", rows))
    return tables


def _origin_tables(result: RunResult) -> list[OriginTable]:
    p, m = result.provenance, result.manifest
    files = [
        ("software", f"bricktrack {p.software_version}"),
        ("manifest, SHA-256", p.manifest_sha256),
        ("calibration, SHA-256", p.calibration_sha256 or "none"),
        ("layout, SHA-256", p.layout_sha256 or "none"),
    ]
    tables = [OriginTable("Software and files", files, True)]
    settings = [(in_words(k), value_text(v)) for k, v in p.settings.items()]
    if settings:
        tables.append(OriginTable("Settings", settings, False))
    unit: list[tuple[str, str]] = [("recorded by", m.origin), ("state", m.state)]
    if m.camera is not None:
        c = m.camera
        gain = f"{c.analogue_gain:g}" if c.analogue_gain else "unknown"  # 0: imported, and nobody knows
        unit.append(("camera", f"{c.model}, {c.mode.name}, {c.mode.width} x {c.mode.height}, exposure "
                     f"{c.exposure_us} µs, gain {gain}, encoder {c.encoder}"))  # fmt: skip
    unit += [
        (f"inertial sensor {i.name}", f"range {i.acc_range_g:g} g, {1e9 / i.period_ns:g} slots a second, "
         f"latency {i.latency_ns / 1e6:g} ms")
        for i in m.imus
    ]  # fmt: skip
    unit += [*m.hardware.items(), *((f"version of {k}", v) for k, v in m.software.items())]
    tables.append(OriginTable("Unit", unit, False))
    if result.timings_s:
        tables.append(
            OriginTable("Time taken", [(name, f"{s:.2f} s") for name, s in result.timings_s.items()], False)
        )
    return tables


def _number(value: float, digits: int, unit: str) -> str:
    return f"{value:.{digits}f} {unit}" if np.isfinite(value) else "–"


def _triple(values: FloatArray, digits: int, unit: str) -> str:
    if not np.isfinite(values).all():
        return "–"
    return " · ".join(f"{v:.{digits}f}" for v in values) + f" {unit}"
