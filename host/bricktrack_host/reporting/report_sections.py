"""The sections of a run's report: words, tables and embedded figures, ready for the template."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from bricktrack_host.quality import PoseFlag
from bricktrack_host.reporting import quality_plots
from bricktrack_host.reporting.embedding import EmbeddedFigure, embed_chart, embed_overlay
from bricktrack_host.reporting.fusion_check import (
    CHECK_PREFIX,
    TwoFusions,
    fusion_check_chart,
    fusion_check_words,
)
from bricktrack_host.reporting.plots import (
    CalibrationPicture,
    FrameOverlay,
    TimeAxis,
    motion_chart,
    spectrum_chart,
)
from bricktrack_host.results.result_store import DetailValue, RunResult
from bricktrack_host.results.run_summary import KeyFigures, main_track
from bricktrack_host.results.truth import COMPONENTS, GroupErrors, TruthComparison, groups_to_show


@dataclass(frozen=True, slots=True)
class ReportExtras:
    """What the results on disk do not hold and the report can show.

    Attributes
    ----------
    overlays : sequence of FrameOverlay
    calibration : CalibrationPicture or None
    truth : TruthComparison or None
        For simulated runs.
    fusions : TwoFusions or None
        The motion fused LED by LED, and pose by pose as the check.
    """

    overlays: Sequence[FrameOverlay] = ()
    calibration: CalibrationPicture | None = None
    truth: TruthComparison | None = None
    fusions: TwoFusions | None = None


@dataclass(frozen=True, slots=True)
class SectionTable:
    """A table of text; the first ``n_words`` columns are words, the others numbers."""

    title: str
    head: list[str]
    rows: list[list[str]]
    n_words: int


@dataclass(slots=True)
class Section:
    """One section of the report."""

    id: str
    title: str
    words: list[str] = field(default_factory=list)
    figures: list[EmbeddedFigure] = field(default_factory=list)
    tables: list[SectionTable] = field(default_factory=list)
    overlays: bool = False


def report_sections(result: RunResult, figures: KeyFigures, extras: ReportExtras) -> list[Section]:
    """Return what there is to show of a run, in order."""
    sections = []
    if figures.n_poses:
        sections.append(_motion_section(result, figures))
    if extras.truth is not None:
        sections.append(_truth_section(result, figures, extras.truth))
    if figures.n_poses:
        sections.append(_residual_section(result))
    if extras.overlays:
        words = "Rings: where an LED was seen. Crosses: where the pose puts it."
        shown = [embed_overlay(o) for o in extras.overlays]
        sections.append(Section("pictures", "LEDs in the pictures", [words], shown, overlays=True))
    timing = embed_chart(
        quality_plots.timing_chart(result, figures),
        "Frame intervals, lateness of inertial slots, residuals of the square wave's edges",
    )
    sections.append(Section("timing", "Timing", _timing_words(result, figures), [timing]))
    sections += _alignment_section(result)
    sections += _fusion_check_section(result, figures, extras)
    calibration = Section("calibration", "Calibration")
    if result.calibration:
        rows = [[in_words(name), value_text(value)] for name, value in result.calibration.items()]
        calibration.tables.append(SectionTable("", ["", ""], rows, 2))
    if extras.calibration is not None:
        picture = quality_plots.calibration_chart(extras.calibration, result.observations.uv_px)
        caption = (
            "Rays outside the covered region are extrapolated; poses that use one are flagged uncovered."
        )
        calibration.figures.append(
            embed_chart(picture, "Region covered by calibration dots", caption, half=True)
        )
    if calibration.tables or calibration.figures:
        sections.append(calibration)
    return sections


def _motion_section(result: RunResult, figures: KeyFigures) -> Section:
    if result.rest is not None:
        seconds = (result.rest.interval_ns[1] - result.rest.interval_ns[0]) / 1e9
        source = "given" if result.rest.source == "given" else "found by stillness"
        words = (
            "Displacement of the first LED, and rotation vector, from rest, in the brick's axes at rest. "
            f"The rest pose is the mean of {result.rest.n_frames} frames over {seconds:.2f} s ({source})"
            + (", of the fused motion its own mean there." if result.fused_rest is not None else ".")
        )
    else:
        words = "No rest pose: position of the first LED and rotation vector in the camera frame."
    whole = embed_chart(
        motion_chart(result, figures), "Time histories of three displacements and three rotations",
        "Line: fused motion, 95 % band. Dots: optical poses. Shaded: no optical pose used. Red: impacts.",
    )  # fmt: skip
    section = Section("motion", "Motion", [words], [whole])
    span = _closeup(result, figures)
    if span is not None:
        section.figures.append(
            embed_chart(motion_chart(result, figures, span_s=span), "Close-up of the time histories",
                   "Close-up around the highest speed. Bars: 95 % of each optical pose.")
        )  # fmt: skip
    inertial = quality_plots.inertial_chart(result, figures)
    if inertial is not None:
        section.figures.append(
            embed_chart(
                inertial,
                "Specific force and angular rate over time",
                "Specific force and angular rate as the inertial sensor measured them, in brick axes, with "
                "gravity and bias. Interrupted where samples are missing or rejected.",
            )
        )
    spectrum = spectrum_chart(result)
    if spectrum is not None:
        section.figures.append(
            embed_chart(
                spectrum,
                "Spectra of displacement and rotation",
                "Amplitude density of the fused motion. Dotted: half the mean rate of the frames.",
            )
        )
    return section


def _closeup(result: RunResult, figures: KeyFigures) -> tuple[float, float] | None:
    track = main_track(result)
    if track is None:
        return None
    speed = np.linalg.norm(track.v_camera_mmps, axis=1)
    speed[track.flags & int(PoseFlag.EXTRAPOLATED | PoseFlag.NO_POSE) != 0] = np.nan
    if not np.isfinite(speed).any() or figures.duration_s < 1.0:
        return None
    origin_ns = TimeAxis.of(result).origin_ns
    middle_s = float((track.t_ns[int(np.nanargmax(speed))] - origin_ns) / 1e9)
    return middle_s - 0.3, middle_s + 0.3


def _residual_section(result: RunResult) -> Section:
    section = Section("residuals", "Residuals of the LEDs", [
        "Where each LED was seen less where the pose puts it. A single LED that stays off hints at the "
        "layout or a reflection; all of them off together near the picture's edge hint at the calibration."
    ])  # fmt: skip
    rows = []
    for i, name in enumerate(result.led_names):
        residual = result.optical.residual_px[:, i]
        used = residual[np.isfinite(residual).all(axis=1)]
        mean = used.mean(axis=0) if len(used) else np.full(2, np.nan)
        rms = np.sqrt(np.mean(used**2, axis=0)) if len(used) else np.full(2, np.nan)
        largest = np.linalg.norm(used, axis=1).max() if len(used) else np.nan
        cells = [str(len(used)), *(f"{x:z.3f}" for x in (*mean, *rms, largest))]
        rows.append([name, *cells])
    head = ["LED", "frames used", "mean u, px", "mean v, px", "rms u, px", "rms v, px", "largest, px"]
    section.tables.append(SectionTable("", head, rows, 1))
    section.figures = [
        embed_chart(quality_plots.residual_time_chart(result), "Residuals of each LED over time",
                     "Crosses at the border: beyond the axis."),
        embed_chart(quality_plots.residual_picture_chart(result),
                     "LEDs in the picture with their mean residuals",
                     "Where the LEDs were in the picture; arrows: mean residual of each, enlarged.",
                     half=True),
    ]  # fmt: skip
    return section


def _timing_words(result: RunResult, figures: KeyFigures) -> list[str]:
    words = [
        f"{figures.n_frames} frames, median interval {figures.frame_period_ns / 1e6:.4f} ms "
        f"({1e9 / figures.frame_period_ns:.4f} a second), {figures.n_frames_dropped} missing between them."
        if figures.n_frames > 1
        else f"{figures.n_frames} frames."
    ]
    fit = result.edge_fit
    if fit is not None:
        rate = "" if fit.nominal_hz is None else (
            f"; the period is {fit.rate_ppm:+.2f} ± {1.96 * fit.rate_sd_ppm:.2f} ppm longer by this clock "
            f"than that of {fit.nominal_hz:g} Hz"
        )  # fmt: skip
        words.append(
            f"{fit.n_edges} edges of the square wave, {fit.missed_index.size} missed, "
            f"{int(fit.is_extra.sum())} extra{rate}; residual {fit.residual_rms_ns / 1000:.1f} µs rms, "
            f"{fit.residual_max_ns / 1000:.1f} µs at most."
        )
    return words


def _alignment_section(result: RunResult) -> list[Section]:
    figure = quality_plots.alignment_chart(result)
    if figure is None and not result.alignment:
        return []
    section = Section("alignment", "Camera and inertial sensor")
    if result.alignment:
        rows = [
            [in_words(name), value_text(value)]
            for name, value in result.alignment.items()
            if not name.startswith(CHECK_PREFIX)
        ]
        section.tables.append(SectionTable("", ["", ""], rows, 2))
    if figure is not None:
        section.figures.append(embed_chart(
            figure, "Angular rates of gyroscope and optics",
            "Above: the second in which the brick turns fastest. Below: the gyroscope's mean between two "
            "frames, less bias, less the optical rate; what follows the motion there is a time offset.",
        ))  # fmt: skip
    return [section]


def _fusion_check_section(result: RunResult, figures: KeyFigures, extras: ReportExtras) -> list[Section]:
    words = fusion_check_words(result.alignment)
    if not words:
        return []
    section = Section("fusion-check", "Fused in two ways", words)
    if extras.fusions is not None:
        section.figures.append(
            embed_chart(
                fusion_check_chart(result, figures, extras.fusions),
                "Difference between the motions fused LED by LED and pose by pose",
                "LED by LED less pose by pose, camera axes (above) and brick axes (below).",
            )
        )
    return [section]


def _truth_section(result: RunResult, figures: KeyFigures, truth: TruthComparison) -> Section:
    section = Section("truth", "Errors against the simulated truth", [
        "Root mean square / largest magnitude: position in mm, rotation vector of the error in degrees about "
        "the brick's axes. Honest covariances give a NEES/6 of 1, and 95 % of poses in their 95 % region."
    ])  # fmt: skip
    units = ["mm", "mm", "mm", "deg", "deg", "deg"]
    head = ["track", "instants", "n", "no pose"]
    names = [f"{c}, {u}" for c, u in zip(COMPONENTS, units, strict=True)]

    def cells(g: GroupErrors) -> list[str]:
        pairs = [f"{r:.3f} / {m:.3f}" if g.n else "–" for r, m in zip(g.rms, g.largest, strict=True)]
        return [g.source, g.group, str(g.n), str(g.n_without), *pairs]

    def honesty(g: GroupErrors) -> list[str]:
        known = np.isfinite(g.nees_mean)
        return [f"{g.nees_mean:.2f}", f"{100 * g.nees_within_95:.0f} %"] if known else ["–", "–"]

    for title, groups in (
        ("Camera frame, nothing zeroed", truth.groups),
        ("From rest, brick axes at rest", truth.from_rest),
    ):
        if groups:
            rows = [[*cells(g), *honesty(g)] for g in groups_to_show(groups)]
            section.tables.append(SectionTable(title, [*head, *names, "NEES/6", "in 95 %"], rows, 2))
    section.figures.append(
        embed_chart(quality_plots.truth_chart(result, figures, truth), "Errors against the truth over time",
               "Band: what the fused covariances promise, 95 %. The tables hold errors beyond the axes.")
    )  # fmt: skip
    return section


_UNITS = dict.fromkeys(("ms", "ns", "s", "ppm", "mm", "px", "deg")) | {
    "us": "µs", "um": "µm", "hz": "Hz", "mps2": "m/s²", "radps": "rad/s", "dps": "deg/s",
}  # fmt: skip
_IN_FULL = {
    "acc_lag": "accelerometer behind gyroscope",
    "acc_bias": "accelerometer's bias",
    "gyro_bias": "gyroscope's bias",
    "gravity_camera": "gravity in camera axes",
    "mean_nis": "innovation squared over its variance, mean (2 for LEDs, 6 for poses)",
    "offset": "IMU time less camera time",
    "offset_sd": "... standard deviation",
    "skew": "rate of IMU time against camera time",
    "skew_sd": "... standard deviation",
    "smoothed_offset": "IMU time less camera time, by the fusion",
    "smoothed_offset_sd": "... standard deviation",
    "smoothed_skew": "rate of IMU time against camera time, by the fusion",
}


def in_words(name: str) -> str:
    """Return a key as words, its unit behind a comma: ``table_bias_mps2`` as ``table bias, m/s²``."""
    words, _, unit = name.rpartition("_")
    if not words or unit not in _UNITS:
        return _IN_FULL.get(name, name.replace("_", " "))
    return f"{_IN_FULL.get(words, words.replace('_', ' '))}, {_UNITS[unit] or unit}"


def value_text(value: DetailValue) -> str:
    """Return a value as people read it; a vector's parts to the same place, the largest with four digits."""
    if value is None or value == "":
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        numbers = [v for v in value if isinstance(v, float) and math.isfinite(v)]
        if value and len(numbers) == len(value):
            largest = max(abs(v) for v in numbers)
            decimals = max(0, 3 - math.floor(math.log10(largest))) if largest else 0
            return ", ".join(f"{v:z.{decimals}f}" for v in numbers)
        return ", ".join(value_text(v) for v in value)
    return str(value)
