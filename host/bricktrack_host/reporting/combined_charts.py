"""The chart of one component's motion against its base, at the laboratory's samples."""

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_host.assemblies.motion_history import NOT_MEASURED, MotionHistory
from bricktrack_host.quality import PoseFlag
from bricktrack_host.reporting.chart import Chart, panel_grid
from bricktrack_host.reporting.chart_marks import Instants, Spans, band
from bricktrack_host.reporting.plots import FUSED, IMPACT, SHADE, line
from bricktrack_host.reporting.thinning import thinned_band

NAMES = ("dx, mm", "dy, mm", "dz, mm", "drot x, deg", "drot y, deg", "drot z, deg")


def component_chart(history: MotionHistory) -> Chart:
    """Return six time histories of a component with their 95 % bands, dropouts shaded and impacts marked."""
    t, label = lab_time(history)
    values = np.concatenate([history.displacement_mm, history.rotation_deg], axis=1)
    half = 1.96 * np.concatenate([history.displacement_sd_mm, history.rotation_sd_deg], axis=1)
    values[~history.measured] = np.nan
    half[~history.measured] = np.nan
    chart = panel_grid(3, 2, height_in=6.0, legend=True)
    for i, panel in enumerate([row[k] for k in range(2) for row in chart.panels]):
        shaded, struck = dropout_spans(history), impact_instants(history)
        if len(shaded):
            panel.add(Spans(shaded, SHADE, label="dropout in a view of the chain"))
        if len(struck):
            panel.add(Instants(struck, IMPACT, opacity=0.75, label="impact"))
        promised = thinned_band(t, values[:, i] - half[:, i], values[:, i] + half[:, i])
        panel.add(
            band(*promised, colour=FUSED, opacity=0.22, label="95 % band"),
            line(t, values[:, i], colour=FUSED, width_pt=0.9, label="motion from rest"),
        )
        panel.y_label = NAMES[i]
    for panel in chart.panels[-1]:
        panel.x_label = label
    return chart


def lab_time(history: MotionHistory) -> tuple[FloatArray, str]:
    """Return the laboratory's time, or the sample's number where the wave's frequency is not told."""
    if np.isfinite(history.t_s).all():
        return history.t_s, "laboratory's time: sample over the wave's frequency, s"
    return history.sample, "laboratory's sample"


def dropout_spans(history: MotionHistory) -> FloatArray:
    """Return where a view of the chain had no optical pose or the motion is not known, shape (k, 2)."""
    t, _ = lab_time(history)
    return spans(t, history.flagged(PoseFlag.DROPOUT | NOT_MEASURED))


def impact_instants(history: MotionHistory) -> FloatArray:
    """Return the middle of each stretch that is flagged as an impact."""
    t, _ = lab_time(history)
    return np.asarray(spans(t, history.flagged(PoseFlag.IMPACT)).mean(axis=1))


def spans(t: FloatArray, mask: BoolArray) -> FloatArray:
    """Return first and last instant of each stretch of set samples, shape (k, 2)."""
    edges = np.diff(mask.astype(np.int8), prepend=0, append=0)
    first, last = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    return np.stack([t[first], t[last]], axis=1)
