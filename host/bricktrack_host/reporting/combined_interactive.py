"""The interactive page of a test: all components of each assembly over the laboratory's time."""

from pathlib import Path

import numpy as np
from bokeh.models import GlyphRenderer, GridPlot
from bokeh.plotting import figure

from bricktrack_host.assemblies.combined_summary import AssemblyEntry
from bricktrack_host.assemblies.motion_history import MotionHistory
from bricktrack_host.reporting.combined_charts import NAMES, dropout_spans, impact_instants, lab_time
from bricktrack_host.reporting.combined_report import (
    CombinedTest,
    about_test,
    read_combined_test,
    verdict,
)
from bricktrack_host.reporting.interactive_panels import (
    Events,
    TimePanels,
    grid,
    legend_that_hides,
    samples,
    styled_panel,
    tell,
)
from bricktrack_host.reporting.interactive_report import (
    INTERACTIVE_NAME,
    MOTION_KEY,
    PlotSection,
    banded,
    render_plots,
)
from bricktrack_host.reporting.page import write_page
from bricktrack_host.reporting.plots import LED_COLOURS
from bricktrack_host.results.spectra import MIN_SAMPLES, amplitude_spectrum

_UNITS = ("mm", "mm", "mm", "deg", "deg", "deg")


def write_interactive_test(folder: Path, path: Path | None = None) -> Path:
    """Write the interactive page of a test, by default into its folder, and return where it is.

    Raises
    ------
    RunFormatError
        If the folder holds no test.
    StorageError
        If the page cannot be written.
    """
    page = path or folder / INTERACTIVE_NAME
    write_page(page, render_interactive_test(read_combined_test(folder)))
    return page


def render_interactive_test(test: CombinedTest) -> str:
    """Return the page's HTML text."""
    summary = test.summary
    made: list[tuple[PlotSection, GridPlot]] = []
    for entry in summary.assemblies:
        histories = test.motions[entry.name]
        if histories:
            made += [_motion(entry, histories), *_spectra(entry, histories)]
    line, mood = verdict(summary)
    return render_plots(
        made,
        title=summary.name,
        meta=about_test(summary),
        simulated=summary.simulated,
        software_version=summary.software_version,
        line=line,
        mood=mood,
        problems=summary.problems,
    )


def _motion(entry: AssemblyEntry, histories: dict[str, MotionHistory]) -> tuple[PlotSection, GridPlot]:
    times = {name: lab_time(history) for name, history in histories.items()}
    known = np.concatenate([t for t, _ in times.values()])
    (label,) = {label for _, label in times.values()}
    events = Events(
        dropouts_s=np.concatenate([dropout_spans(h) for h in histories.values()]),
        impacts_s=np.unique(np.concatenate([impact_instants(h) for h in histories.values()])),
    )
    panels = TimePanels(label, (float(known.min()), float(known.max())), events)
    made = [panels.panel(name) for name in NAMES]
    marks: dict[str, list[GlyphRenderer]] = {}
    for k, (name, history) in enumerate(histories.items()):
        colour = LED_COLOURS[k % len(LED_COLOURS)]
        y = np.concatenate([history.displacement_mm, history.rotation_deg], axis=1)
        y[~history.measured] = np.nan
        sd = np.concatenate([history.displacement_sd_mm, history.rotation_sd_deg], axis=1)
        source = samples(
            times[name][0], banded(y, 1.96 * sd) | {"sample": history.sample}, flags=history.flags
        )
        lines: list[GlyphRenderer] = []
        bands: list[GlyphRenderer] = []
        for i, (panel, unit) in enumerate(zip(made, _UNITS, strict=True)):
            bands.append(
                panel.varea("t", f"low{i}", f"high{i}", source=source, fill_color=colour, fill_alpha=0.2)
            )
            line = panel.line("t", f"y{i}", source=source, line_color=colour, line_width=1.2)
            said = [(name, f"@y{i}{{0.0000}} ± @half{i}{{0.0000}} {unit}"), ("sample", "@sample{0}"),
                    ("flags", "@said")]  # fmt: skip
            tell(panel, line, said, along_time=True)
            lines.append(line)
        marks[name] = [*lines, *bands]
    legend_that_hides(made[0], marks)
    made[3].height = made[0].height
    panels.reset_together()
    chains = "; ".join(f"{c} by {' then '.join(chain)}" for c, chain in entry.chains.items())
    section = PlotSection(
        f"assembly-{entry.name}",
        f"{entry.name} ({entry.kind})",
        f"Motion from rest, seen from {entry.base}, in the axes of the whole brick: {chains}. "
        "A click on a name hides that component.",
        MOTION_KEY[2:4],
    )
    return section, panels.grid([made[k] for k in (0, 3, 1, 4, 2, 5)], columns=2)


def _spectra(entry: AssemblyEntry, histories: dict[str, MotionHistory]) -> list[tuple[PlotSection, GridPlot]]:
    made: list[figure] = []
    marks: dict[str, list[GlyphRenderer]] = {}
    spectra = {
        name: amplitude_spectrum(
            h.t_s[rows], np.concatenate([h.displacement_mm, h.rotation_deg], axis=1)[rows]
        )
        for name, h in histories.items()
        if np.count_nonzero(rows := h.measured & np.isfinite(h.t_s)) >= MIN_SAMPLES
    }
    for i in range(6 if spectra else 0):
        unit, title = _UNITS[i], f"{'Displacement' if i < 3 else 'Rotation'} {'xyz'[i % 3]}"
        panel = styled_panel(f"{unit} / √Hz", title=title, log_y=True)
        panel.xaxis.axis_label = "frequency, Hz"
        for n, (name, spectrum) in enumerate(spectra.items()):
            source = samples(spectrum.f_hz, {"y": spectrum.density[:, i]})
            line = panel.line("t", "y", source=source, line_color=LED_COLOURS[n % len(LED_COLOURS)])
            tell(panel, line, [(name, f"@y{{0.00000}} {unit}/√Hz"), ("frequency", "@t{0.00} Hz")],
                 along_time=False)  # fmt: skip
            marks.setdefault(name, []).append(line)
        made.append(panel)
    if not made:
        return []
    section = PlotSection(
        f"spectra-{entry.name}", f"{entry.name}: spectra", "Amplitude density of the motion."
    )
    return [(section, grid(made, columns=3))]
