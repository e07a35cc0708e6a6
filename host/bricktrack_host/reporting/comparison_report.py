"""The page on what another processing changed: the worst runs first, what is behind it, and how it looks."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from bricktrack_host.datasets.comparison import AT_WORDS, Alike, Change, worst_first
from bricktrack_host.datasets.comparison_pairs import Comparison
from bricktrack_host.durable_files import storage_errors
from bricktrack_host.reporting.chart import Chart, panel_grid
from bricktrack_host.reporting.chart_marks import Spans, band
from bricktrack_host.reporting.combined_charts import NAMES, spans
from bricktrack_host.reporting.embedding import embed_chart
from bricktrack_host.reporting.page import Key, OriginTable, page_environment, write_page
from bricktrack_host.reporting.plots import FUSED, OPTICAL, SHADE, line
from bricktrack_host.reporting.report_sections import Section, SectionTable
from bricktrack_host.reporting.thinning import thinned_band
from bricktrack_host.results.result_store import software_version

N_DRAWN = 6
"""Runs, the worst ones, that are drawn; all are in the table."""
AXES = ("x, mm", "y, mm", "z, mm", "rot x, deg", "rot y, deg", "rot z, deg")
_SMALL_IN_SD = 0.5


def write_comparison_page(
    comparison: Comparison, path: Path, *, progress: Callable[[str, int, int], None] | None = None
) -> None:
    """Write the page of a comparison.

    Raises
    ------
    StorageError
        If it cannot be written.
    """
    with storage_errors(path, "Choose another --output, or make room"):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_page(path, render_comparison(comparison, progress=progress))


def render_comparison(
    comparison: Comparison, *, progress: Callable[[str, int, int], None] | None = None
) -> str:
    """Return the page's HTML text."""
    say = progress or (lambda _what, _done, _of: None)
    pairs = worst_first(comparison.pairs)
    drawn = [pair for pair in pairs if not pair.is_same][:N_DRAWN]
    sections = [_table_section(pairs), _changes_section(pairs)]
    for i, pair in enumerate(drawn):
        say("drawing", i, len(drawn))
        sections.append(_pair_section(pair, f"pair-{i}"))
    words, mood = verdict(comparison)
    return page_environment().get_template("combined.html.j2").render(
        run_id=f"{comparison.title}: what changed",
        meta=f"Before: {comparison.before} · after: {comparison.after} · bricktrack {software_version()}",
        simulated=comparison.simulated,
        provenance={"software_version": software_version()},
        verdict=words,
        mood=mood,
        problems=_one_sided(comparison),
        key=_key_figures(pairs),
        sections=[section for section in sections if section is not None],
        flag_tables=[],
        origin_tables=[OriginTable("How to read it", _READING, False)],
    )  # fmt: skip


def verdict(comparison: Comparison) -> tuple[str, str]:
    """Return what the comparison amounts to in a line, and its mood: good, care or bad."""
    pairs = comparison.pairs
    moved = [pair for pair in pairs if not pair.is_same]
    if not moved:
        return f"No number differs in {_count(len(pairs), 'motion')}.", "good"
    said = f"{len(moved)} of {len(pairs)} motions differ" if len(pairs) > 1 else "The motion differs"
    worst = worst_first(moved)[0]
    if worst.n == 0:
        return f"{said}; {worst.name} has no instant that both measured.", "bad"
    in_sd = float(np.nan_to_num(worst.in_sd).max())
    came_and_went = sum(pair.appeared + pair.disappeared for pair in moved)
    gone = f"; {_count(came_and_went, 'instant')} came or went" if came_and_went else ""
    line_ = f"{said}, at most by {in_sd:.2g} standard deviations ({worst.name}){gone}."
    return line_, "good" if in_sd < _SMALL_IN_SD and not came_and_went else "care" if in_sd < 3 else "bad"


_READING = [
    ("same instants", "rows of the same laboratory sample, or picture, which no processing changes"),
    ("standard deviation", "the larger of the two that are stated; a bias common to both is in neither"),
    ("beyond", "instants at which an axis differs by more than 1.96 standard deviations"),
    ("came, went", "instants that are measured after only, and before only"),
    ("rotation", "from before to after, as a rotation vector"),
]


def _count(n: int, what: str) -> str:
    return f"{n} {what}" if n == 1 else f"{n} {what}s"


def _one_sided(comparison: Comparison) -> list[str]:
    found = []
    for names, words in ((comparison.only_before, "before"), (comparison.only_after, "after")):
        if names:
            shown = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
            found.append(f"{words} only, so not compared: {shown}")
    return found


def _key_figures(pairs: list[Alike]) -> list[Key]:
    keys = [Key("Compared", _count(len(pairs), "motion"), f"{sum(p.is_same for p in pairs)} the same")]
    for name, columns, unit in (("displacement", slice(0, 3), "mm"), ("rotation", slice(3, 6), "deg")):
        largest = [(float(pair.largest[columns].max()), pair.name) for pair in pairs if pair.n]
        if largest:
            value, where = max(largest)
            keys.append(Key(f"Largest change of {name}", f"{value:.3g} {unit}", f"{where}, one axis"))
    known = [pair for pair in pairs if pair.n]
    if known:
        beyond = max(known, key=lambda pair: pair.share_beyond)
        keys.append(Key("Most beyond the 95 % band", f"{100 * beyond.share_beyond:.1f} %", beyond.name))
    keys.append(
        Key("Instants", f"{sum(p.appeared for p in pairs)} came, {sum(p.disappeared for p in pairs)} went")
    )
    return keys


def _table_section(pairs: list[Alike]) -> Section:
    section = Section("motions", "Motions, the worst first", [
        "Of each axis: largest difference / root mean square. Then the largest in standard deviations, when "
        "it was, how much lies beyond the 95 % band, and the instants measured both times, or once only."
    ])  # fmt: skip
    rows = []
    for pair in pairs:
        cells = [
            "–" if pair.n == 0 else f"{high:.3f}\N{NO-BREAK SPACE}/ {rms:.3f}"
            for high, rms in zip(pair.largest.tolist(), pair.rms.tolist(), strict=True)
        ]
        in_sd = "–" if pair.n == 0 else f"{float(np.nan_to_num(pair.in_sd).max()):.2g}"
        beyond = "–" if pair.n == 0 else f"{100 * pair.share_beyond:.1f} %"
        worst = f"{pair.worst_s:.2f}" if np.isfinite(pair.worst_s) else "–"
        came, went = str(pair.appeared), str(pair.disappeared)
        rows.append([pair.name, AT_WORDS[pair.at], *cells, in_sd, worst, beyond, str(pair.n), came, went])
    head = ["motion", "rows", *AXES, "largest, sd", "at, s", "beyond", "both", "came", "went"]
    section.tables.append(SectionTable("", head, rows, 2))
    return section


def _changes_section(pairs: list[Alike]) -> Section | None:
    """Return what else is another, each once, with the motions that it holds for."""
    names: dict[Change, list[str]] = {}
    for pair in pairs:
        for change in pair.changes:
            names.setdefault(change, []).append(pair.name)
    if not names:
        return None
    rows = [
        [change.what, change.before, change.after, _shown(where, len(pairs))]
        for change, where in sorted(names.items(), key=lambda item: -len(item[1]))
    ]
    section = Section("changes", "What else is another")
    head = ["what", "before", "after", "of"]
    if len(pairs) == 1:
        head, rows = head[:3], [row[:3] for row in rows]
    section.tables.append(SectionTable("", head, rows, 4))
    return section


def _shown(names: list[str], of: int) -> str:
    if len(names) == of > 1:
        return "all"
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def _pair_section(pair: Alike, anchor: str) -> Section:
    section = Section(anchor, pair.name)
    if pair.n:
        section.figures.append(
            embed_chart(
                difference_chart(pair),
                f"Differences of {pair.name} over time",
                "After less before. Band: 1.96 of the larger standard deviation. Shaded: measured once only.",
            )
        )
    section.figures.append(
        embed_chart(
            motion_chart(pair), f"{pair.name} before and after", "Motion from rest, before and after."
        )
    )
    return section


def difference_chart(pair: Alike) -> Chart:
    """Return six differences over time with the band that their uncertainty allows."""
    chart = panel_grid(3, 2, height_in=6.0, legend=True)
    known = np.isfinite(pair.difference).all(axis=1)
    either = np.isfinite(pair.before).all(axis=1) | np.isfinite(pair.after).all(axis=1)
    once = spans(pair.t_s, np.asarray(either & ~known))
    for i, panel in enumerate([row[k] for k in range(2) for row in chart.panels]):
        if len(once):
            panel.add(Spans(once, SHADE, label="measured before or after only"))
        half = 1.96 * np.where(known, pair.sd[:, i], np.nan)
        promised = thinned_band(pair.t_s, -half, half)
        panel.add(
            band(*promised, colour=FUSED, opacity=0.18, label="95 % band"),
            line(pair.t_s, pair.difference[:, i], colour=FUSED, width_pt=0.9, label="after less before"),
        )
        panel.y_label = NAMES[i]
        # Of a dropout, or where nothing was measured, the band may be a hundred times wider: it is cut off.
        limit = max(np.nanmax(np.abs(pair.difference[:, i])), 1.5 * np.nanmedian(half), 1e-9) * 1.15
        panel.y_limits = (-limit, limit)
    for panel in chart.panels[-1]:
        panel.x_label = "time, s"
    return chart


def motion_chart(pair: Alike) -> Chart:
    """Return the six time histories before and after."""
    chart = panel_grid(3, 2, height_in=6.0, legend=True)
    for i, panel in enumerate([row[k] for k in range(2) for row in chart.panels]):
        panel.add(
            line(pair.t_s, pair.before[:, i], colour=OPTICAL, width_pt=1.3, label="before"),
            line(pair.t_s, pair.after[:, i], colour=FUSED, width_pt=0.8, label="after"),
        )
        panel.y_label = NAMES[i]
    for panel in chart.panels[-1]:
        panel.x_label = "time, s"
    return chart
