"""The charts that tell how good a run is: residuals, timing, alignment, calibration, errors."""

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.imu_records import UNUSABLE
from bricktrack_host.reporting.chart import Chart, panel_grid, picture_chart
from bricktrack_host.reporting.chart_marks import Area, Arrows, Scatter, Signs, Words, band
from bricktrack_host.reporting.plots import (
    FUSED,
    IMPACT,
    INK,
    LED_COLOURS,
    OPTICAL,
    TRUTH,
    CalibrationPicture,
    TimeAxis,
    line,
    mark_events,
)
from bricktrack_host.reporting.rate_comparison import compare_rates
from bricktrack_host.reporting.thinning import thinned_band
from bricktrack_host.results.result_store import RunResult
from bricktrack_host.results.run_summary import KeyFigures, imu_camera_time_ns
from bricktrack_host.results.truth import COMPONENTS, TruthComparison


def residual_time_chart(result: RunResult) -> Chart:
    """Return the distance between each LED as seen and as predicted, over time."""
    axis = TimeAxis.of(result)
    chart = panel_grid(2, height_in=3.4, legend=True)
    t_s = axis.s(result.optical.t_ns)
    residual = result.optical.residual_px
    limit = _limit(residual, 0.25)
    size_pt = 0.55 * float(np.clip(60 / np.sqrt(max(len(t_s), 1)), 2.4, 4.5))
    for k, (panel,) in enumerate(chart.panels):
        for i, name in enumerate(result.led_names):
            colour, y = LED_COLOURS[i % len(LED_COLOURS)], residual[:, i, k]
            beyond = np.abs(y) > limit
            panel.add(
                Scatter(t_s, y, colour, size_pt, label=name),
                Signs(t_s[beyond], np.sign(y[beyond]) * limit * 0.97, colour, size_pt=4.0),
            )
        panel.y_limits, panel.y_label = (-limit, limit), f"residual {'uv'[k]}, px"
    panel.x_label = axis.label
    return chart


def residual_picture_chart(result: RunResult) -> Chart:
    """Return where in the picture the LEDs were, and their mean residual there as arrows."""
    camera = result.manifest.camera
    width, height = (camera.mode.width, camera.mode.height) if camera else (1920, 1080)
    chart, panel = picture_chart(width, height)
    uv, residual = result.observations.uv_px, result.optical.residual_px
    means = []
    for i, name in enumerate(result.led_names):
        colour = LED_COLOURS[i % len(LED_COLOURS)]
        panel.add(Scatter(uv[:, i, 0], uv[:, i, 1], colour, 0.75, opacity=0.5))
        used = np.isfinite(residual[:, i]).all(axis=1)
        if used.any():
            at = np.median(uv[used, i], axis=0)
            means.append((*at, *residual[used, i].mean(axis=0)))
            panel.add(Words(float(at[0]), float(at[1]), name, colour))
    if means:
        u, v, du, dv = np.array(means).T
        longest = max(float(np.hypot(du, dv).max()), 1e-6)
        enlarged = 90 / longest  # the longest arrow is 90 px of the picture
        panel.add(Arrows(u, v, enlarged * du, enlarged * dv, INK, 1.6))
        panel.title = f"longest arrow: mean residual of {longest:.3f} px"
    return chart


def timing_chart(result: RunResult, figures: KeyFigures) -> Chart:
    """Return frame intervals, lateness of the inertial slots, and residuals of the edges."""
    axis = TimeAxis.of(result)
    chart = panel_grid(3, height_in=5.4, legend=True, titles=True)
    frames, samples, edges = (row[0] for row in chart.panels)
    stamps = result.observations.sensor_timestamp_ns
    frames.title = "Frames: time between stamps, less whole frame periods"
    if len(stamps) > 2:
        off_us, periods = frame_intervals_us(result, figures)
        at_s, whole, gap = axis.s(stamps[1:]), periods == 1, periods > 1
        frames.add(Scatter(at_s[whole], off_us[whole], OPTICAL, 1.8))
        if gap.any():
            frames.add(Signs(at_s[gap], off_us[gap], IMPACT, label="after dropped frames"))
        limit = max(20.0, 1.2 * float(np.abs(off_us).max()))
        frames.y_limits, frames.y_label = (-limit, limit), "interval, µs"
    else:
        frames.note, frames.y_ticks = "fewer than three frames", False
    samples.title = "Inertial sensor: sample after its slot"
    late_us = imu_lateness_us(result)
    if late_us is None or result.imu is None:
        samples.note, samples.y_ticks = "no inertial samples", False
    else:
        samples.add(Scatter(axis.s(result.imu.t_ns), late_us / 1000, FUSED, 1.2))
        samples.y_label = "after slot, ms"
        if np.nanmin(late_us, initial=0.0) >= 0:
            samples.y_from = 0.0
    edges.title = "Square wave: edge less fitted line"
    fit = result.edge_fit
    if fit is None:
        edges.note, edges.y_ticks = "no edges, or no line through them", False
    else:
        edges.add(Scatter(axis.s(fit.edges_ns), fit.residual_ns / 1000, TRUTH, 1.1))
        missed_s = axis.s(fit.time_of_index(fit.missed_index))
        if len(missed_s):
            edges.add(Signs(missed_s, np.zeros(len(missed_s)), IMPACT, "|", 9.0, "missed edge"))
        extra_s = axis.s(fit.edges_ns[fit.is_extra])
        if len(extra_s):
            edges.add(Signs(extra_s, np.zeros(len(extra_s)), IMPACT, label="extra edge"))
        edges.y_label = "residual, µs"
    edges.x_label = axis.label
    return chart


def frame_intervals_us(result: RunResult, figures: KeyFigures) -> tuple[FloatArray, FloatArray]:
    """Return the times between frame stamps less whole frame periods, us, and how many periods each is."""
    steps_ns = np.diff(result.observations.sensor_timestamp_ns)
    periods = np.rint(steps_ns / figures.frame_period_ns)
    return np.asarray((steps_ns - periods * figures.frame_period_ns) / 1000), np.asarray(periods)


def imu_lateness_us(result: RunResult) -> FloatArray | None:
    """Return how long after its slot each inertial sample was taken, us; NaN in gaps."""
    if result.imu is None or not result.manifest.imus or not len(result.imu.t_ns):
        return None
    settings = result.provenance.settings
    chosen, other = settings.get("imu"), settings.get("camera_sensor_imu")
    if settings.get("camera_sensor_source"):
        other = None  # it is in another unit's run
    grids = [i for i in result.manifest.imus if i.name != other] or result.manifest.imus
    grid = next((i for i in grids if i.name == chosen), grids[0])
    after_ns = (result.imu.t_ns - grid.latency_ns - grid.t0_ns) % grid.period_ns
    if result.manifest.origin == "import":  # the grid was made from the stamps: half of them come before it
        after_ns = np.where(after_ns > grid.period_ns // 2, after_ns - grid.period_ns, after_ns)
    usable = result.imu.flags & int(UNUSABLE) == 0
    return np.asarray(np.where(usable, after_ns / 1000.0, np.nan))


def alignment_chart(result: RunResult) -> Chart | None:
    """Return the angular rates of gyroscope and optics where they are fastest; `None` without both."""
    rates = compare_rates(result)
    if rates is None or not np.isfinite(rates.optical_dps).any():
        return None
    fastest_s = rates.optical_s[np.nanargmax(np.nansum(rates.optical_dps**2, axis=1))]
    chart = panel_grid(2, 3, height_in=3.9, legend=True, titles=True, share_x="row",
                       labelled_columns=False, heights=(1.5, 1.0))  # fmt: skip
    near = np.abs(rates.gyro_s - fastest_s) < 0.5
    near_frames = np.abs(rates.optical_s - fastest_s) < 0.5
    limit = _limit(rates.difference_dps, 1.0)
    for i, (top, low) in enumerate(zip(*chart.panels, strict=True)):
        top.title = f"about brick {'xyz'[i]}"
        top.add(
            line(rates.gyro_s[near], rates.gyro_dps[near, i], colour=FUSED, label="gyroscope less bias"),
            Scatter(rates.optical_s[near_frames], rates.optical_dps[near_frames, i], OPTICAL, 3.0,
                 label="optical, frame to frame"),
        )  # fmt: skip
        low.add(Scatter(rates.optical_s, rates.difference_dps[:, i], INK, 1.1))
        low.y_limits, low.x_label = (-limit, limit), "time, s"
    chart.panels[0][0].y_label, chart.panels[1][0].y_label = "rate, deg/s", "difference, deg/s"
    return chart


def inertial_chart(result: RunResult, figures: KeyFigures) -> Chart | None:
    """Return what the inertial sensor measured over the run, on the camera's time; `None` without it."""
    imu = result.imu
    if imu is None or not len(imu.t_ns):
        return None
    axis = TimeAxis.of(result)
    t_s = axis.s(imu_camera_time_ns(result))
    chart = panel_grid(3, 2, height_in=4.6, legend=True)
    for k, (what, values, unit) in enumerate(
        (("force", imu.acc_mps2, "m/s²"), ("rate", np.rad2deg(imu.gyro_radps), "deg/s"))
    ):
        chart.panels[-1][k].x_label = axis.label
        for i in range(3):
            panel = chart.panels[i][k]
            mark_events(panel, axis, result, figures)
            panel.add(line(t_s, values[:, i], colour=FUSED, width_pt=0.9, label="inertial sensor"))
            panel.y_label = f"{what} {'xyz'[i]}, {unit}"
    return chart


def calibration_chart(calibration: CalibrationPicture, uv_px: FloatArray | None = None) -> Chart:
    """Return the region that calibration dots covered, their residuals, and where the LEDs were."""
    chart, panel = picture_chart(calibration.width_px, calibration.height_px, legend=True)
    for n, outline in enumerate(calibration.covered_uv_px):
        label = "" if n else "covered by dots"
        panel.add(Area([(outline[:, 0], outline[:, 1])], "#dce8dd", 0.8, TRUTH, label))
    on_target = calibration.dots_uv_px
    if len(on_target):
        panel.add(Scatter(on_target[:, 0], on_target[:, 1], INK, 1.0, label="dots"))
    residual = calibration.residual_um
    if residual is not None and np.isfinite(residual).any():
        typical = float(np.nanmedian(np.hypot(residual[:, 0], residual[:, 1])))
        known = np.isfinite(residual).all(axis=1)
        if typical > 0:
            enlarged = 28 / typical  # a typical one is 28 px of the picture
            (u, v), (du, dv) = on_target[known].T, enlarged * residual[known].T
            panel.add(Arrows(u, v, du, dv, OPTICAL))
            panel.title = f"dots and their residuals, median {typical:.1f} µm on the target"
    if uv_px is not None:
        uv = uv_px.reshape(-1, 2)
        panel.add(Scatter(uv[:, 0], uv[:, 1], FUSED, 0.75, label="LEDs of this run"))
    return chart


def truth_chart(result: RunResult, figures: KeyFigures, comparison: TruthComparison) -> Chart:
    """Return the errors against the truth over time, with the 95 % band that the covariances promise."""
    axis = TimeAxis.of(result)
    chart = panel_grid(6, height_in=7.4, legend=True)
    for i, (panel,) in enumerate(chart.panels):
        mark_events(panel, axis, result, figures)
        fused, optical = comparison.series.get("fused"), comparison.series.get("optical")
        if optical is not None:
            panel.add(Scatter(axis.s(optical.t_ns), optical.error[:, i], OPTICAL, 1.4, label="optical"))
        if fused is not None:
            t_s, half = axis.s(fused.t_ns), 1.96 * fused.sd[:, i]
            promised = thinned_band(t_s, -half, half)
            panel.add(
                band(*promised, colour=FUSED, opacity=0.18, label="promised 95 %"),
                line(t_s, fused.error[:, i], colour=FUSED, width_pt=0.8, label="fused"),
            )
        panel.y_label = f"{COMPONENTS[i]}, {'deg' if i > 2 else 'mm'}"
        limit = _limit(np.concatenate([s.error[:, i] for s in comparison.series.values()]), 0.02)
        panel.y_limits = (-limit, limit)
    panel.x_label = axis.label
    return chart


def _limit(values: FloatArray, least: float) -> float:
    """Return a symmetric axis limit that shows all but rare outliers."""
    known = np.abs(values[np.isfinite(values)])
    return max(least, 1.25 * float(np.percentile(known, 99.5))) if known.size else least
