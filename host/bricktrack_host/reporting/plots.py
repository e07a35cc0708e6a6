"""The charts of a run's motion, each made from values; no state is shared."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.quality import PoseFlag
from bricktrack_host.reporting.chart import INK as INK
from bricktrack_host.reporting.chart import Chart, Panel, panel_grid
from bricktrack_host.reporting.chart_marks import Instants, Line, Scatter, Spans, band
from bricktrack_host.reporting.page_picture import PagePicture
from bricktrack_host.reporting.thinning import thinned, thinned_band
from bricktrack_host.results.rest_pose import FromRest
from bricktrack_host.results.result_store import RunResult
from bricktrack_host.results.result_tables import FusedKind
from bricktrack_host.results.run_summary import KeyFigures, main_kind
from bricktrack_host.results.spectra import MIN_SAMPLES, amplitude_spectrum

FUSED = "#1f5f8b"
OPTICAL = "#c8651b"
TRUTH = "#2f7d4f"
SHADE = "#e6e2da"
IMPACT = "#b3261e"
# Seven hues that stay apart for colour-blind readers (after P. Tol's "bright" scheme), in LED order.
LED_COLOURS = ("#4477aa", "#ee6677", "#228833", "#b89b1e", "#2fa6c2", "#aa3377", "#777777")

STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titley": 1.0,  # given, it is not looked for
    "axes.labelsize": 8.5,
    "axes.edgecolor": "#8a8f98",
    "axes.labelcolor": INK,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.xmargin": 0.01,
    "grid.color": "#e3e5e8",
    "grid.linewidth": 0.6,
    "xtick.color": "#5b616b",
    "ytick.color": "#5b616b",
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "text.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.0,
    "svg.fonttype": "path",
    "svg.hashsalt": "bricktrack",
    "path.simplify_threshold": 0.2,
}
"""For `matplotlib.rc_context` around making *and* saving matplotlib's figures."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameOverlay:
    """A decoded frame with the LEDs as seen and as predicted.

    Attributes
    ----------
    title : str
    picture : PagePicture
    detected_uv_px, predicted_uv_px : ndarray, shape (n, 2), px
        In the camera's picture; NaN where there is none.
    """

    title: str
    picture: PagePicture
    detected_uv_px: FloatArray
    predicted_uv_px: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationPicture:
    """Where the calibration's dots were.

    Attributes
    ----------
    width_px, height_px : int
    covered_uv_px : sequence of ndarray, shape (k, 2), px
        Outlines of the region that dots surrounded, one for each plane or for all.
    dots_uv_px : ndarray, shape (n, 2), px
    residual_um : ndarray, shape (n, 2), um, or None
        On the target, along u and v: dot seen less fitted.
    """

    width_px: int
    height_px: int
    covered_uv_px: Sequence[FloatArray]
    dots_uv_px: FloatArray
    residual_um: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class TimeAxis:
    """Seconds from the trigger, or from the first frame where no trigger came."""

    origin_ns: int
    label: str

    @classmethod
    def of(cls, result: RunResult) -> "TimeAxis":
        """Return the time axis of a run."""
        if result.t0_ns is not None:
            return cls(result.t0_ns, "time since the trigger, s")
        stamps = result.observations.sensor_timestamp_ns
        return cls(int(stamps[0]) if len(stamps) else 0, "time since the first frame, s (no trigger)")

    def s(self, t_ns: IntArray) -> FloatArray:
        """Return times as seconds of this axis."""
        return np.asarray((t_ns - self.origin_ns) / 1e9)


def style() -> Any:
    """Return the context in which matplotlib's figures are made and saved."""
    import matplotlib as mpl  # takes half a second, and the charts of a run do without it

    return mpl.rc_context(STYLE)


def line(x: FloatArray, y: FloatArray, *, colour: str, width_pt: float = 1.0, label: str = "") -> Line:
    """Return a line through samples, no more of them than a page can show."""
    index = thinned(x, y)
    return Line(x[index], y[index], colour, width_pt, label)


def motion_chart(
    result: RunResult, figures: KeyFigures, *, span_s: tuple[float, float] | None = None
) -> Chart:
    """Return six time histories: from rest where there is a rest pose, else in the camera frame.

    ``span_s`` limits the time axis, for a close-up.
    """
    axis = TimeAxis.of(result)
    if span_s is None:
        chart = panel_grid(6, height_in=9.6, legend=True)
        panels = [row[0] for row in chart.panels]
    else:
        chart = panel_grid(3, 2, height_in=6.0, legend=True)
        panels = [row[k] for k in range(2) for row in chart.panels]
    kind = main_kind(result)
    optical_s = axis.s(result.optical.t_ns)
    optical_y, optical_sd = six_components(result, "optical")
    chosen = np.ones(len(optical_s), dtype=bool)
    if span_s is not None:
        chosen = (optical_s >= span_s[0]) & (optical_s <= span_s[1])
    if kind is not None:
        track = result.fused[kind]
        fused_s = axis.s(track.t_ns)
        inside = track.flags & int(PoseFlag.EXTRAPOLATED) == 0
        if span_s is not None:
            inside &= (fused_s >= span_s[0]) & (fused_s <= span_s[1])
        fused_y, fused_sd = six_components(result, kind)
        fused_s, fused_y, fused_sd = fused_s[inside], fused_y[inside], fused_sd[inside]
    d = "d" if result.rest is not None else ""
    names = [f"{d}x, mm", f"{d}y, mm", f"{d}z, mm", f"{d}rot x, deg", f"{d}rot y, deg", f"{d}rot z, deg"]
    for i, panel in enumerate(panels):
        mark_events(panel, axis, result, figures)
        if kind is not None:
            y, half = fused_y[:, i], 1.96 * fused_sd[:, i]
            promised = thinned_band(fused_s, y - half, y + half)
            panel.add(
                band(*promised, colour=FUSED, opacity=0.22, label="95 % band"),
                line(fused_s, y, colour=FUSED, width_pt=0.9, label="fused"),
            )
        seen_s, seen = optical_s[chosen], optical_y[chosen, i]
        if span_s is None:
            panel.add(Scatter(seen_s, seen, OPTICAL, 1.9, label="optical"))
        else:
            half = 1.96 * optical_sd[chosen, i]
            panel.add(Scatter(seen_s, seen, OPTICAL, 3.0, half=half, label="optical, 95 %"))
        panel.y_label = names[i]
        panel.x_limits = span_s
    for panel in chart.panels[-1]:
        panel.x_label = axis.label
    return chart


def spectrum_chart(result: RunResult) -> Chart | None:
    """Return amplitude spectra of the motion at inertial slots; `None` where it is too short."""
    kind = main_kind(result)
    if kind is None:
        return None
    track = result.fused[kind]
    inside = track.flags & int(PoseFlag.EXTRAPOLATED | PoseFlag.NO_POSE) == 0
    inside &= np.isfinite(track.t_camera_brick_mm).all(axis=1)
    if np.count_nonzero(inside) < MIN_SAMPLES:
        return None
    values, _ = six_components(result, kind)
    spectrum = amplitude_spectrum((track.t_ns[inside] - track.t_ns[inside][0]) / 1e9, values[inside])
    nyquist_hz = half_frame_rate_hz(result)
    chart = panel_grid(1, 2, height_in=2.9, titles=True, share_x="none")
    (panels,) = chart.panels
    for panel, title, unit in zip(panels, ("Displacement", "Rotation"), ("mm", "deg"), strict=True):
        panel.title, panel.y_label, panel.x_label = title, f"{unit} / sqrt(Hz)", "frequency, Hz"
        panel.x_limits, panel.log_y, panel.legend = (0.0, float(spectrum.f_hz[-1])), True, True
    for i in range(6):
        panels[i // 3].add(
            Line(spectrum.f_hz, spectrum.density[:, i], LED_COLOURS[i % 3], label="xyz"[i % 3])
        )
    if nyquist_hz is not None:
        for panel in panels:
            panel.add(Instants(np.array([nyquist_hz]), INK, 0.7, dashes_pt=(0.8, 1.4)))
    return chart


def half_frame_rate_hz(result: RunResult) -> float | None:
    """Return the frequency up to which frames alone can tell motion: half their mean rate, drops included."""
    stamps_ns = result.observations.sensor_timestamp_ns
    return 0.5e9 * (len(stamps_ns) - 1) / float(stamps_ns[-1] - stamps_ns[0]) if len(stamps_ns) > 1 else None


def six_components(result: RunResult, kind: Literal["optical"] | FusedKind) -> tuple[FloatArray, FloatArray]:
    """Return x, y, z, mm, and rotation vector, deg, from rest if there is one, with their deviations."""
    track = result.optical if kind == "optical" else result.fused[kind]
    seen = result.from_rest.get(kind) or FromRest(
        track.R_camera_brick, track.t_camera_brick_mm, track.covariance
    )
    sd = np.sqrt(np.diagonal(seen.covariance, axis1=1, axis2=2))
    return (
        np.concatenate([seen.t_mm, np.rad2deg(rvec_from_matrix(seen.R))], axis=1),
        np.concatenate([sd[:, 3:], np.rad2deg(sd[:, :3])], axis=1),
    )


def mark_events(panel: Panel, axis: TimeAxis, result: RunResult, figures: KeyFigures) -> None:
    """Shade the dropouts, and mark trigger and impacts."""
    if len(figures.dropouts_ns):
        panel.add(Spans(axis.s(figures.dropouts_ns), SHADE, label="no optical pose used"))
    if len(figures.impacts_ns):
        panel.add(Instants(axis.s(figures.impacts_ns), IMPACT, opacity=0.75, label="impact"))
    if result.t0_ns is not None:
        at_s = axis.s(np.array([result.t0_ns]))
        panel.add(Instants(at_s, INK, 0.7, dashes_pt=(2.8, 2.1), label="trigger"))
