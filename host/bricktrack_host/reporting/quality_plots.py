"""The figures that tell how good a run is: residuals, timing, alignment, calibration, errors."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from bricktrack_common.arrays import FloatArray
from bricktrack_common.imu_records import UNUSABLE
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.reporting.figure_layout import figure_legend, panel_grid, picture_axes
from bricktrack_host.reporting.figure_marks import band, dots, line
from bricktrack_host.reporting.plots import (
    FUSED,
    IMPACT,
    INK,
    LED_COLOURS,
    OPTICAL,
    TRUTH,
    CalibrationPicture,
    TimeAxis,
    mark_events,
)
from bricktrack_host.results.result_store import RunResult
from bricktrack_host.results.run_summary import KeyFigures
from bricktrack_host.results.truth import COMPONENTS, TruthComparison


def residual_time_figure(result: RunResult) -> Figure:
    """Return the distance between each LED as seen and as predicted, over time."""
    axis = TimeAxis.of(result)
    fig, ((upper,), (lower,)) = panel_grid(2, height_in=3.4, legend=True)
    axes = upper, lower
    t_s = axis.s(result.optical.t_ns)
    residual = result.optical.residual_px
    limit = _limit(residual, 0.25)
    size = float(np.clip(60 / np.sqrt(max(len(t_s), 1)), 2.4, 4.5))
    for i, name in enumerate(result.led_names):
        colour = LED_COLOURS[i % len(LED_COLOURS)]
        for k in (0, 1):
            y = residual[:, i, k]
            dots(axes[k], t_s, y, size_pt=0.55 * size, color=colour, label=name)
            beyond = np.abs(y) > limit
            if beyond.any():
                axes[k].plot(t_s[beyond], np.sign(y[beyond]) * limit * 0.97, "x", ms=4, color=colour)
    for k, name in ((0, "u, px"), (1, "v, px")):
        axes[k].set_ylim(-limit, limit)
        axes[k].set_ylabel(f"residual {name}")
    figure_legend(fig, axes[:1])
    axes[1].set_xlabel(axis.label)
    return fig


def residual_picture_figure(result: RunResult) -> Figure:
    """Return where in the picture the LEDs were, and their mean residual there as arrows."""
    camera = result.manifest.camera
    width, height = (camera.mode.width, camera.mode.height) if camera else (1920, 1080)
    fig, ax = picture_axes(width, height)
    uv, residual = result.observations.uv_px, result.optical.residual_px
    means = []
    for i, name in enumerate(result.led_names):
        colour = LED_COLOURS[i % len(LED_COLOURS)]
        dots(ax, uv[:, i, 0], uv[:, i, 1], size_pt=0.75, color=colour, alpha=0.5)
        used = np.isfinite(residual[:, i]).all(axis=1)
        if used.any():
            at = np.median(uv[used, i], axis=0)
            mean = residual[used, i].mean(axis=0)
            means.append((*at, *mean))
            ax.annotate(
                name, (at[0], at[1]), xytext=(9, 7), textcoords="offset points", color=colour, weight="bold"
            )
    if means:
        u, v, du, dv = np.array(means).T
        longest = max(float(np.hypot(du, dv).max()), 1e-6)
        scale = longest / 90  # the longest arrow is 90 px of the picture
        ax.quiver(u, v, du, dv, angles="xy", scale_units="xy", scale=scale, width=0.004, color=INK, zorder=3)
        ax.set_title(f"longest arrow: mean residual of {longest:.3f} px")
    return fig


def timing_figure(result: RunResult, figures: KeyFigures) -> Figure:
    """Return frame intervals, lateness of the inertial slots, and residuals of the edges."""
    axis = TimeAxis.of(result)
    fig, axes = panel_grid(3, height_in=5.4, legend=True, titles=True)
    axes = axes[:, 0]
    stamps = result.observations.sensor_timestamp_ns
    axes[0].set_title("Frames: time between stamps, less whole frame periods")
    if len(stamps) > 2:
        steps_ns = np.diff(stamps)
        periods = np.rint(steps_ns / figures.frame_period_ns)
        off_us = (steps_ns - periods * figures.frame_period_ns) / 1000
        whole = periods == 1
        dots(axes[0], axis.s(stamps[1:])[whole], off_us[whole], size_pt=1.8, color=OPTICAL)
        gaps_s = axis.s(stamps[1:])[periods > 1]
        if len(gaps_s):
            axes[0].plot(gaps_s, off_us[periods > 1], "x", color=IMPACT, ms=5, label="after dropped frames")
        limit = max(20.0, 1.2 * float(np.abs(off_us).max()))
        axes[0].set_ylim(-limit, limit)
        axes[0].set_ylabel("interval, us")
    else:
        _say(axes[0], "fewer than three frames")
    late_us = imu_lateness_us(result)
    axes[1].set_title("Inertial sensor: sample after its slot")
    if late_us is None or result.imu is None:
        _say(axes[1], "no inertial samples")
    else:
        dots(axes[1], axis.s(result.imu.t_ns), late_us / 1000, size_pt=1.2, color=FUSED)
        axes[1].set_ylabel("after slot, ms")
        if np.nanmin(late_us, initial=0.0) >= 0:
            axes[1].set_ylim(bottom=0)
    axes[2].set_title("Square wave: edge less fitted line")
    fit = result.edge_fit
    if fit is None:
        _say(axes[2], "no edges, or no line through them")
    else:
        dots(axes[2], axis.s(fit.edges_ns), fit.residual_ns / 1000, size_pt=1.1, color=TRUTH)
        missed_s = axis.s(fit.time_of_index(fit.missed_index))
        if len(missed_s):
            axes[2].plot(missed_s, np.zeros(len(missed_s)), "|", color=IMPACT, ms=9, label="missed edge")
        extra_s = axis.s(fit.edges_ns[fit.is_extra])
        if len(extra_s):
            axes[2].plot(extra_s, np.zeros(len(extra_s)), "x", color=IMPACT, ms=5, label="extra edge")
        axes[2].set_ylabel("residual, us")
    figure_legend(fig, axes)
    axes[2].set_xlabel(axis.label)
    return fig


def imu_lateness_us(result: RunResult) -> FloatArray | None:
    """Return how long after its slot each inertial sample was taken, us; NaN in gaps."""
    if result.imu is None or not result.manifest.imus or not len(result.imu.t_ns):
        return None
    chosen = result.provenance.settings.get("imu")
    grid = next((i for i in result.manifest.imus if i.name == chosen), result.manifest.imus[0])
    after_ns = (result.imu.t_ns - grid.latency_ns - grid.t0_ns) % grid.period_ns
    if result.manifest.origin == "import":  # the grid was made from the stamps: half of them come before it
        after_ns = np.where(after_ns > grid.period_ns // 2, after_ns - grid.period_ns, after_ns)
    usable = result.imu.flags & int(UNUSABLE) == 0
    return np.asarray(np.where(usable, after_ns / 1000.0, np.nan))


def alignment_figure(result: RunResult, *, imu_minus_camera_ns: int = 0) -> Figure | None:
    """Return the angular rates of gyroscope and optics where they are fastest; `None` without both.

    The optical rate is the turn from one frame to the next over the time between; the gyroscope is averaged
    over the same time, so that what is left is misalignment.
    """
    imu, optical = result.imu, result.optical
    if imu is None:
        return None
    usable = np.isfinite(imu.gyro_radps).all(axis=1)
    good = np.isfinite(optical.R_camera_brick).all(axis=(1, 2))
    if np.count_nonzero(usable) < 10 or np.count_nonzero(good) < 10:
        return None
    axis = TimeAxis.of(result)
    t_ns, R = optical.t_ns[good], optical.R_camera_brick[good]
    step_s = np.diff(t_ns) / 1e9
    turn = rvec_from_matrix(np.swapaxes(R[:-1], -1, -2) @ R[1:])
    close = step_s < 2.5 * np.median(step_s)
    optical_dps = np.rad2deg(turn / step_s[:, None])
    optical_dps[~close] = np.nan
    middle_s = axis.s(t_ns[:-1] + np.diff(t_ns) // 2)
    gyro_s = axis.s(imu.t_ns[usable] - imu_minus_camera_ns)
    gyro_dps = np.rad2deg(imu.gyro_radps[usable])
    bounds = np.stack([axis.s(t_ns[:-1]), axis.s(t_ns[1:])], axis=1)
    mean_dps = _means_over(gyro_s, gyro_dps, bounds)
    offset = np.nanmedian(mean_dps - optical_dps, axis=0) if np.isfinite(optical_dps).any() else np.zeros(3)
    fastest = middle_s[np.nanargmax(np.nansum(optical_dps**2, axis=1))]
    fig, axes = panel_grid(2, 3, height_in=3.9, legend=True, titles=True, share_x="row",
                           labelled_columns=False, heights=[1.5, 1])  # fmt: skip
    near = (gyro_s > fastest - 0.5) & (gyro_s < fastest + 0.5)
    near_frames = (middle_s > fastest - 0.5) & (middle_s < fastest + 0.5)
    difference = mean_dps - offset - optical_dps
    limit = _limit(difference, 1.0)
    for i in range(3):
        top, low = axes[0, i], axes[1, i]
        top.set_title(f"about brick {'xyz'[i]}")
        top.plot(gyro_s[near], gyro_dps[near, i] - offset[i], color=FUSED, label="gyroscope less bias")
        top.plot(middle_s[near_frames], optical_dps[near_frames, i], "o", ms=3, mew=0, color=OPTICAL,
                 label="optical, frame to frame")  # fmt: skip
        dots(low, middle_s, difference[:, i], size_pt=1.1, color=INK)
        low.set_ylim(-limit, limit)
        low.set_xlabel("time, s")
    axes[0, 0].set_ylabel("rate, deg/s")
    axes[1, 0].set_ylabel("difference, deg/s")
    figure_legend(fig, axes[0, :1])
    return fig


def calibration_figure(calibration: CalibrationPicture, uv_px: FloatArray | None = None) -> Figure:
    """Return the region that calibration dots covered, their residuals, and where the LEDs were."""
    fig, ax = picture_axes(calibration.width_px, calibration.height_px, below_in=0.25)
    for n, outline in enumerate(calibration.covered_uv_px):
        ax.add_patch(Polygon(outline, closed=True, fc="#dce8dd", ec=TRUTH, lw=0.9, alpha=0.8, zorder=0,
                             label="covered by dots" if n == 0 else None))  # fmt: skip
    on_target = calibration.dots_uv_px
    if len(on_target):
        dots(ax, on_target[:, 0], on_target[:, 1], size_pt=1.0, color=INK, label="dots")
    residual = calibration.residual_um
    if residual is not None and np.isfinite(residual).any():
        size = np.hypot(residual[:, 0], residual[:, 1])
        typical = float(np.nanmedian(size))
        if typical > 0:
            ax.quiver(*on_target.T, *residual.T, angles="xy", scale_units="xy",
                      scale=typical / 28, width=0.0018, color=OPTICAL, zorder=3)  # fmt: skip
            ax.set_title(f"dots and their residuals, median {typical:.1f} um on the target")
    if uv_px is not None:
        uv = uv_px.reshape(-1, 2)
        dots(ax, uv[:, 0], uv[:, 1], size_pt=0.75, color=FUSED, label="LEDs of this run")
    fig.legend(loc="lower center", ncols=3, markerscale=4, borderaxespad=0.1)
    return fig


def truth_figure(result: RunResult, figures: KeyFigures, comparison: TruthComparison) -> Figure:
    """Return the errors against the truth over time, with the 95 % band that the covariances promise."""
    axis = TimeAxis.of(result)
    fig, axes = panel_grid(6, height_in=7.4, legend=True)
    axes = axes[:, 0]
    for i, ax in enumerate(axes):
        mark_events(ax, axis, result, figures)
        for source, colour in (("optical", OPTICAL), ("fused", FUSED)):
            series = comparison.series.get(source)  # type: ignore[call-overload]
            if series is None:
                continue
            t_s = axis.s(series.t_ns)
            if source == "fused":
                half = 1.96 * series.sd[:, i]
                band(ax, t_s, -half, half, color=FUSED, alpha=0.18, label="promised 95 %")
                line(ax, t_s, series.error[:, i], color=colour, lw=0.8, label="fused")
            else:
                dots(ax, t_s, series.error[:, i], size_pt=1.4, color=colour, label="optical")
        ax.set_ylabel(f"{COMPONENTS[i]}, {'deg' if i > 2 else 'mm'}")
        errors = [s.error[:, i] for s in comparison.series.values()]
        limit = _limit(np.concatenate(errors), 0.02)
        ax.set_ylim(-limit, limit)
    figure_legend(fig, axes)
    axes[-1].set_xlabel(axis.label)
    return fig


def _means_over(t_s: FloatArray, values: FloatArray, bounds_s: FloatArray) -> FloatArray:
    """Return the mean of a piecewise linear signal over intervals, shape (k, columns)."""
    step = np.diff(t_s)[:, None]
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * step * (values[1:] + values[:-1]), axis=0)])
    out = np.empty((len(bounds_s), values.shape[1]))
    for c in range(values.shape[1]):
        ends = np.interp(bounds_s, t_s, integral[:, c], left=np.nan, right=np.nan)
        out[:, c] = (ends[:, 1] - ends[:, 0]) / (bounds_s[:, 1] - bounds_s[:, 0])
    return out


def _limit(values: FloatArray, least: float) -> float:
    """Return a symmetric axis limit that shows all but rare outliers."""
    known = np.abs(values[np.isfinite(values)])
    return max(least, 1.25 * float(np.percentile(known, 99.5))) if known.size else least


def _say(ax: Axes, words: str) -> None:
    ax.text(0.5, 0.5, words, transform=ax.transAxes, ha="center", va="center", color="#5b616b")
    ax.set_yticks([])
