"""The interactive page of a run: zoom, pan and point at every sample; one file that needs no network."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bokeh.models import GlyphRenderer, GridPlot
from bokeh.plotting import figure

from bricktrack_common.arrays import FloatArray
from bricktrack_host.assemblies.motion_history import NOT_MEASURED
from bricktrack_host.reporting.interactive_panels import (
    Events,
    TimePanels,
    embedded,
    grid,
    legend_that_hides,
    samples,
    scripts,
    styled_panel,
    tell,
)
from bricktrack_host.reporting.page import page_environment, write_page
from bricktrack_host.reporting.plots import (
    FUSED,
    IMPACT,
    INK,
    LED_COLOURS,
    OPTICAL,
    TRUTH,
    TimeAxis,
    half_frame_rate_hz,
    six_components,
)
from bricktrack_host.reporting.quality_plots import frame_intervals_us, imu_lateness_us
from bricktrack_host.reporting.rate_comparison import compare_rates
from bricktrack_host.reporting.report import recording_date
from bricktrack_host.results.result_store import RunResult
from bricktrack_host.results.run_summary import (
    KeyFigures,
    imu_camera_time_ns,
    key_figures,
    main_kind,
    main_track,
    verdict,
)
from bricktrack_host.results.spectra import MIN_SAMPLES, amplitude_spectrum

INTERACTIVE_NAME = "interactive.html"
_UNITS = ("mm", "mm", "mm", "deg", "deg", "deg")


@dataclass(frozen=True, slots=True)
class PlotSection:
    """One section of an interactive page: words, a key to the marks, and the name of its plots."""

    id: str
    title: str
    words: str
    key: tuple[tuple[str, str, str], ...] = ()


MOTION_KEY = (
    ("line", FUSED, "fused, with its 95 % band"),
    ("dot", OPTICAL, "optical, 95 % bars"),
    ("shade", "#d5cfc2", "no optical pose used"),
    ("bar", IMPACT, "impact"),
    ("dashes", INK, "trigger"),
)


def write_interactive_report(result: RunResult, path: Path) -> None:
    """Write the interactive page of a run as one HTML file.

    Raises
    ------
    StorageError
        If it cannot be written.
    """
    write_page(path, render_interactive_report(result))


def render_interactive_report(result: RunResult) -> str:
    """Return the page's HTML text."""
    figures = key_figures(result)
    line, problems = verdict(result, figures)
    panels = _time_panels(result, figures)
    made: list[tuple[PlotSection, GridPlot]] = []
    if figures.n_poses:
        made.append(_motion(result, panels))
    made += _inertial(result, panels)
    if figures.n_poses:
        made.append(_residuals(result, panels))
    made += _alignment(result, panels)
    made += _timing(result, figures, panels)
    made += _spectra(result)
    panels.reset_together()
    mood = "bad" if not figures.n_poses else "care" if problems else "good"
    return render_plots(
        made,
        title=result.manifest.run_id,
        meta=f"Unit {result.manifest.unit} · {recording_date(result)} · bricktrack "
        f"{result.provenance.software_version}",
        simulated=result.manifest.simulated,
        software_version=result.provenance.software_version,
        line=line,
        mood=mood,
        problems=problems,
    )


def render_plots(
    made: list[tuple[PlotSection, GridPlot]],
    *,
    title: str,
    meta: str,
    simulated: bool,
    software_version: str,
    line: str,
    mood: str,
    problems: list[str],
) -> str:
    """Return a page of sections with their plots."""
    script, places = embedded({section.id: plots for section, plots in made}) if made else ("", {})
    return page_environment().get_template("interactive.html.j2").render(
        run_id=title,
        meta=meta,
        simulated=simulated,
        provenance={"software_version": software_version},
        verdict=line,
        mood=mood,
        problems=problems,
        key=[],
        sections=[section for section, _ in made],
        places=places,
        library=scripts(),
        script=script,
        flag_tables=[],
    )  # fmt: skip


def _time_panels(result: RunResult, figures: KeyFigures) -> TimePanels:
    axis = TimeAxis.of(result)
    # Of what the camera saw: inertial samples before and after it are a pan away.
    stamps = result.observations.sensor_timestamp_ns
    if len(stamps) < 2 and result.imu is not None:
        stamps = result.imu.t_ns
    known = axis.s(stamps)
    span = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    events = Events(
        dropouts_s=axis.s(figures.dropouts_ns),
        impacts_s=axis.s(figures.impacts_ns),
        trigger_s=None if result.t0_ns is None else 0.0,
    )
    return TimePanels(axis.label, span, events)


def _motion(result: RunResult, panels: TimePanels) -> tuple[PlotSection, GridPlot]:
    axis, optical, kind = TimeAxis.of(result), result.optical, main_kind(result)
    d = "d" if result.rest is not None else ""
    names = [f"{d}x", f"{d}y", f"{d}z", f"{d}rot x", f"{d}rot y", f"{d}rot z"]
    if kind is not None:
        track = result.fused[kind]
        y, sd = six_components(result, kind)
        y[track.flags & int(NOT_MEASURED) != 0] = np.nan
        fused = samples(axis.s(track.t_ns), banded(y, 1.96 * sd), flags=track.flags)
    seen = np.asarray(np.isfinite(optical.t_camera_brick_mm).all(axis=1))
    y, sd = six_components(result, "optical")
    columns = banded(y[seen], 1.96 * sd[seen])
    columns["frame"] = np.flatnonzero(seen).astype(np.float64)
    columns["leds"] = np.count_nonzero(np.isfinite(optical.residual_px[seen]).all(axis=2), axis=1).astype(
        float
    )
    poses = samples(axis.s(optical.t_ns[seen]), columns, flags=optical.flags[seen])
    made = []
    for i, (name, unit) in enumerate(zip(names, _UNITS, strict=True)):
        panel = panels.panel(f"{name}, {unit}")
        value = f"@y{i}{{0.0000}} ± @half{i}{{0.0000}} {unit}"
        panel.segment("t", f"low{i}", "t", f"high{i}", source=poses, line_color=OPTICAL, line_alpha=0.45)
        dots = panel.scatter("t", f"y{i}", source=poses, color=OPTICAL, size=4)
        dots.name = "optical"
        tell(panel, dots, [("optical", value), ("frame", "@frame{0} at @t{0.0000} s, @leds{0} LEDs"),
                           ("flags", "@said")], along_time=False)  # fmt: skip
        if kind is not None:
            panel.varea("t", f"low{i}", f"high{i}", source=fused, fill_color=FUSED, fill_alpha=0.22)
            line = panel.line("t", f"y{i}", source=fused, line_color=FUSED, line_width=1.2)
            line.name = "fused"
            tell(
                panel, line, [("fused", value), ("time", "@t{0.0000} s"), ("flags", "@said")], along_time=True
            )
        made.append(panel)
    words = (
        "Displacement of the first LED and rotation vector from rest, in the brick's axes at rest."
        if result.rest is not None
        else "No rest pose: position of the first LED and rotation vector in the camera frame."
    )
    ordered = [made[k] for k in (0, 3, 1, 4, 2, 5)]
    return PlotSection("motion", "Motion", words, MOTION_KEY), panels.grid(ordered, columns=2)


def banded(values: FloatArray, half: FloatArray) -> dict[str, FloatArray]:
    """Return columns ``y``, ``half``, ``low`` and ``high``, each with the number of its component.

    The library's areas bridge NaN: where a value is not known, ``low`` and ``high`` meet on a straight line,
    so that nothing is seen of the band there.
    """
    columns: dict[str, FloatArray] = {}
    row = np.arange(len(values))
    for i in range(values.shape[1]):
        y, h = values[:, i], half[:, i]
        known = np.isfinite(y) & np.isfinite(h)
        closed = np.interp(row, row[known], y[known]) if known.any() else np.zeros(len(y))
        low, high = (np.where(known, edge, closed) for edge in (y - h, y + h))
        columns |= {f"y{i}": y, f"half{i}": h, f"low{i}": low, f"high{i}": high}
    return columns


def _inertial(result: RunResult, panels: TimePanels) -> list[tuple[PlotSection, GridPlot]]:
    imu, track = result.imu, main_track(result)
    if imu is None or not len(imu.t_ns):
        return []
    axis = TimeAxis.of(result)
    t_s = axis.s(imu_camera_time_ns(result))
    force = samples(t_s, {f"y{i}": imu.acc_mps2[:, i] for i in range(3)})
    rates = compare_rates(result)
    if rates is None:
        gyro = samples(t_s, {f"y{i}": np.rad2deg(imu.gyro_radps[:, i]) for i in range(3)})
    else:
        gyro = samples(rates.gyro_s, {f"y{i}": rates.gyro_dps[:, i] for i in range(3)})
        turns = samples(rates.optical_s, {f"y{i}": rates.optical_dps[:, i] for i in range(3)})
    if track is not None:
        omega_dps = np.rad2deg(track.omega_brick_radps)
        omega_dps[track.flags & int(NOT_MEASURED) != 0] = np.nan
        fused = samples(axis.s(track.t_ns), {f"y{i}": omega_dps[:, i] for i in range(3)})
    left, right = [], []
    for i, c in enumerate("xyz"):
        panel = panels.panel(f"force {c}, m/s²")
        line = panel.line("t", f"y{i}", source=force, line_color=INK, line_width=1.0)
        tell(
            panel,
            line,
            [("accelerometer", f"@y{i}{{0.000}} m/s²"), ("time", "@t{0.0000} s")],
            along_time=True,
        )
        left.append(panel)
        panel = panels.panel(f"rate {c}, deg/s")
        if rates is not None:
            dots = panel.scatter("t", f"y{i}", source=turns, color=OPTICAL, size=3.5)
            tell(
                panel, dots, [("optical", f"@y{i}{{0.00}} deg/s"), ("time", "@t{0.0000} s")], along_time=False
            )
        line = panel.line("t", f"y{i}", source=gyro, line_color=INK, line_width=1.0)
        tell(panel, line, [("gyroscope", f"@y{i}{{0.00}} deg/s"), ("time", "@t{0.0000} s")], along_time=True)
        if track is not None:
            panel.line("t", f"y{i}", source=fused, line_color=FUSED, line_width=1.2)
        right.append(panel)
    section = PlotSection(
        "inertial",
        "Inertial sensor",
        "Specific force, gravity included, and angular rate, less the gyroscope's offset; both in brick axes "
        "and on the camera's time.",
        (
            ("line", INK, "inertial sensor"),
            ("line", FUSED, "fused"),
            ("dot", OPTICAL, "optical, frame to frame"),
        ),
    )
    return [(section, panels.grid([p for pair in zip(left, right, strict=True) for p in pair], columns=2))]


def _residuals(result: RunResult, panels: TimePanels) -> tuple[PlotSection, GridPlot]:
    t_s = TimeAxis.of(result).s(result.optical.t_ns)
    both = [panels.panel(f"residual {c}, px") for c in "uv"]
    marks: dict[str, list[GlyphRenderer]] = {}
    for i, name in enumerate(result.led_names):
        residual = result.optical.residual_px[:, i]
        used = np.asarray(np.isfinite(residual).all(axis=1))
        source = samples(t_s[used], {"u": residual[used, 0], "v": residual[used, 1],
                                     "frame": np.flatnonzero(used).astype(float)})  # fmt: skip
        colour = LED_COLOURS[i % len(LED_COLOURS)]
        marks[name] = []
        for c, panel in zip("uv", both, strict=True):
            dots = panel.scatter("t", c, source=source, color=colour, size=3.5)
            tell(panel, dots, [(name, f"@{c}{{0.000}} px"), ("frame", "@frame{0} at @t{0.0000} s")],
                 along_time=False)  # fmt: skip
            marks[name].append(dots)
    legend_that_hides(both[0], marks)
    words = "Where each LED was seen less where the pose puts it. A click on a name hides that LED."
    return PlotSection("residuals", "Residuals of the LEDs", words), panels.grid(both)


def _alignment(result: RunResult, panels: TimePanels) -> list[tuple[PlotSection, GridPlot]]:
    rates = compare_rates(result)
    if rates is None:
        return []
    known = np.asarray(np.isfinite(rates.difference_dps).all(axis=1))
    source = samples(rates.optical_s[known], {f"y{i}": rates.difference_dps[known, i] for i in range(3)})
    made: list[figure] = []
    for i, c in enumerate("xyz"):
        panel = panels.panel(f"about {c}, deg/s", height_px=140)
        dots = panel.scatter("t", f"y{i}", source=source, color=INK, size=3)
        tell(
            panel, dots, [("difference", f"@y{i}{{0.00}} deg/s"), ("time", "@t{0.0000} s")], along_time=False
        )
        made.append(panel)
    words = (
        "The gyroscope's mean between two frames, less its offset, less the optical rate, once aligned. What "
        "follows the motion here is a time offset that is left."
    )
    return [(PlotSection("alignment", "Camera and inertial sensor", words), panels.grid(made))]


def _timing(result: RunResult, figures: KeyFigures, panels: TimePanels) -> list[tuple[PlotSection, GridPlot]]:
    axis, made = TimeAxis.of(result), []
    stamps = result.observations.sensor_timestamp_ns
    if len(stamps) > 2:
        off_us, periods = frame_intervals_us(result, figures)
        source = samples(axis.s(stamps[1:]), {"us": off_us, "periods": periods})
        panel = panels.panel("interval, µs", title="Frames: time between stamps, less whole frame periods")
        dots = panel.scatter("t", "us", source=source, color=OPTICAL, size=3.5)
        tell(panel, dots, [("interval", "@periods{0} periods and @us{0.0} µs"), ("time", "@t{0.0000} s")],
             along_time=False)  # fmt: skip
        made.append(panel)
    late_us = imu_lateness_us(result)
    if late_us is not None and result.imu is not None and np.isfinite(late_us).any():
        known = np.isfinite(late_us)
        source = samples(axis.s(result.imu.t_ns[known]), {"ms": late_us[known] / 1000})
        panel = panels.panel("after slot, ms", title="Inertial sensor: sample after its slot")
        dots = panel.scatter("t", "ms", source=source, color=FUSED, size=3)
        tell(panel, dots, [("late", "@ms{0.000} ms"), ("time", "@t{0.0000} s")], along_time=False)
        made.append(panel)
    fit = result.edge_fit
    if fit is not None:
        source = samples(
            axis.s(fit.edges_ns), {"us": fit.residual_ns / 1000, "number": fit.index.astype(float)}
        )
        panel = panels.panel("residual, µs", title="Square wave: edge less fitted line")
        dots = panel.scatter("t", "us", source=source, color=TRUTH, size=2.5)
        tell(panel, dots, [("edge", "@number{0}"), ("residual", "@us{0.00} µs"), ("time", "@t{0.0000} s")],
             along_time=False)  # fmt: skip
        missed_s = axis.s(fit.time_of_index(fit.missed_index))
        if len(missed_s):
            panel.scatter(
                missed_s, np.zeros(len(missed_s)), color=IMPACT, marker="dash", angle=np.pi / 2, size=14
            )
        made.append(panel)
    if not made:
        return []
    return [(PlotSection("timing", "Timing", "Upright red dashes: missed edges."), panels.grid(made))]


def _spectra(result: RunResult) -> list[tuple[PlotSection, GridPlot]]:
    kind = main_kind(result)
    if kind is None:
        return []
    track = result.fused[kind]
    inside = np.asarray(track.flags & int(NOT_MEASURED) == 0)
    values, _ = six_components(result, kind)
    known = inside & np.isfinite(values).all(axis=1)
    if np.count_nonzero(known) < MIN_SAMPLES:
        return []
    spectrum = amplitude_spectrum((track.t_ns[known] - track.t_ns[known][0]) / 1e9, values[known])
    source = samples(spectrum.f_hz, {f"y{i}": spectrum.density[:, i] for i in range(6)})
    half_hz = half_frame_rate_hz(result)
    made = []
    for k, (title, unit) in enumerate((("Displacement", "mm"), ("Rotation", "deg"))):
        panel = styled_panel(f"{unit} / √Hz", title=title, height_px=280, log_y=True)
        panel.xaxis.axis_label = "frequency, Hz"
        marks: dict[str, list[GlyphRenderer]] = {}
        for i, c in enumerate("xyz"):
            line = panel.line("t", f"y{3 * k + i}", source=source, line_color=LED_COLOURS[i], line_width=1.2)
            tell(panel, line, [(c, f"@y{3 * k + i}{{0.00000}} {unit}/√Hz"), ("frequency", "@t{0.00} Hz")],
                 along_time=False)  # fmt: skip
            marks[c] = [line]
        if half_hz is not None:
            panel.vspan(x=[half_hz], line_color=INK, line_width=0.8, line_dash="dotted")
        legend_that_hides(panel, marks)
        made.append(panel)
    words = (
        "Amplitude density of the motion. Dotted: half the mean rate of the frames; beyond it frames alone "
        "tell nothing."
    )
    return [(PlotSection("spectra", "Spectra", words), grid(made, columns=2))]
