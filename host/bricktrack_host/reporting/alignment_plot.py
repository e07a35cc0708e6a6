"""One page on the clocks of a recording: both angular rates, their correlation, and the offsets."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from bricktrack_common.arrays import FloatArray
from bricktrack_host.fusion.alignment_report import AlignmentReport
from bricktrack_host.reporting.plots import FUSED, IMPACT, INK, OPTICAL, style

_NEAR_MS = 60.0
_SHOWN_S = 3.0
_SHOWN_SHARE = 0.3  # of a short run, so that it is closer than the whole


def save_alignment_plot(report: AlignmentReport, path: Path, *, title: str) -> None:
    """Write the page as PNG, PDF or SVG, by the file's ending."""
    with style():
        figure = Figure(figsize=(9.0, 6.4), layout="constrained")
        figure.suptitle(title, x=0.01, ha="left", fontsize=10, fontweight="bold")
        rows = figure.subplots(2, 2, width_ratios=[1.5, 1.0])
        whole, close, over, near = rows[0, 0], rows[1, 0], rows[0, 1], rows[1, 1]
        optical, gyro = np.rad2deg(report.optical_radps), np.rad2deg(report.gyro_radps)
        start, end = _liveliest(report.t_s, report.optical_radps)
        for ax in (whole, close):
            ax.plot(*_broken(report.t_s, gyro), color=FUSED, lw=1.0, label="gyro, at the offset found")
            ax.plot(report.t_s, optical, "o", color=OPTICAL, ms=2.2, label="camera, frame to frame")
            ax.set_ylabel("angular speed, deg/s")
            ax.set_xlabel("time since the first pose, s")
        whole.set_title("Both angular speeds")
        whole.set_ylim(top=1.3 * whole.get_ylim()[1])  # room for the legend
        whole.legend(loc="upper right")
        close.set_title("Where it turned most")
        close.set_xlim(start, end)
        found_ms = report.alignment.offset_ns / 1e6
        lags_ms = report.correlation.lags_s * 1e3
        for ax in (over, near):
            ax.plot(lags_ms, report.correlation.vector, color=FUSED, label="angular rates")
            ax.plot(lags_ms, report.correlation.speed, color=OPTICAL, lw=0.8, label="their sizes")
            ax.axvline(found_ms, color=IMPACT, lw=1.0, label="offset found")
            ax.set_xlabel("IMU time less camera time, ms")
            ax.set_ylabel("correlation")
            ax.xaxis.set_major_locator(MaxNLocator(5))
        over.set_title("Correlation over offsets")
        # The coarse search needs no sample clock, which moves what is found by up to a period.
        near.set_title("Near the offset")
        near.set_xlim(found_ms - _NEAR_MS, found_ms + _NEAR_MS)
        for k in (-2, 2):
            edge_ms = (report.prior_offset_ns + k * report.prior_sd_ns) / 1e6
            near.axvline(edge_ms, color=INK, lw=0.9, ls="--", label="stamps, 95 %" if k < 0 else "_")
        near.set_ylim(-1.0, 1.05)
        near.legend(loc="lower right")
        figure.savefig(path, dpi=150)


def _broken(t_s: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a line that is broken where frames are missing."""
    dt = np.diff(t_s)
    gap = np.flatnonzero(dt > 2.5 * np.median(dt)) + 1 if len(dt) else np.zeros(0, dtype=np.int64)
    return np.insert(t_s, gap, np.nan), np.insert(values, gap, np.nan)


def _liveliest(t_s: FloatArray, speed: FloatArray) -> tuple[float, float]:
    """Return where the stretch shown close begins and ends, s: about the greatest speed."""
    if len(t_s) < 2:
        return 0.0, _SHOWN_S
    length_s = min(_SHOWN_S, _SHOWN_SHARE * float(t_s[-1]))
    start = float(np.clip(t_s[int(np.argmax(speed))] - length_s / 2, 0.0, t_s[-1] - length_s))
    return start, start + length_s
