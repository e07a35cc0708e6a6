"""The report of a calibration: one HTML file without other files, and its figures as pictures."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bricktrack_common.brick_model import BrickModel
from bricktrack_common.errors import StorageError
from bricktrack_host.calibration.calibration_comparison import CalibrationComparison, compare_calibrations
from bricktrack_host.calibration.calibration_file import Calibration
from bricktrack_host.calibration.dots.picture_region import ConvexRegion
from bricktrack_host.calibration.led_region import led_pixels, led_region
from bricktrack_host.calibration.rays.irt import TwoPlaneIrt
from bricktrack_host.calibration.rays.pixel_polynomials import picture_grid
from bricktrack_host.calibration.rays.ray_calibration import RayCalibration
from bricktrack_host.calibration.rays.ray_uncertainty import CHI_95
from bricktrack_host.reporting.calibration_sections import CalibrationEvidence, calibration_sections
from bricktrack_host.reporting.page import Key, OriginTable, page_environment
from bricktrack_host.reporting.plots import style

WARN_BELOW_COVERED = 0.8
"""Whole dots that fill the picture surround some 85 % of it: up to a pitch is lost all round."""
_PNG_DPI = 160


def write_calibration_report(
    path: Path | None,
    fitted: RayCalibration,
    calibration: Calibration,
    *,
    brick: BrickModel | None = None,
    earlier: Calibration | None = None,
    pictures_dir: Path | None = None,
) -> None:
    """Write the report of a calibration as one HTML file.

    Parameters
    ----------
    path : Path or None
        Of the page; None writes the figures alone.
    fitted : RayCalibration
    calibration : Calibration
        What was saved of it.
    brick : BrickModel, optional
        Its LEDs' region is drawn into the maps.
    earlier : Calibration, optional
        Of the same unit, to be compared with.
    pictures_dir : Path, optional
        Folder that gets each figure as PNG.

    Raises
    ------
    StorageError
        If a file cannot be written.
    CalibrationError
        If the earlier calibration is of another unit or mode, or no LED is in the picture.
    """
    evidence = gathered_evidence(fitted, calibration, brick=brick, earlier=earlier)
    with style():
        sections, figures = calibration_sections(evidence)
        html = _rendered(evidence, sections)
        try:
            if path is not None:
                path.write_text(html, encoding="utf-8")
            if pictures_dir is not None:
                _save_pictures(pictures_dir, figures)
        except OSError as e:
            raise StorageError(
                f"{e.filename or path}: the report cannot be written: {e.strerror or e}"
            ) from e


def gathered_evidence(
    fitted: RayCalibration,
    calibration: Calibration,
    *,
    brick: BrickModel | None = None,
    earlier: Calibration | None = None,
) -> CalibrationEvidence:
    """Return what the report's sections are made from."""
    model = fitted.model
    covered = (model.region_a, model.region_b) if isinstance(model, TwoPlaneIrt) else (model.region,)
    leds: ConvexRegion | None = None
    leds_covered = None
    if brick is not None:
        leds = led_region(model, brick)
        leds_covered = float(np.mean(model.is_covered(led_pixels(model, brick))))
    comparison: CalibrationComparison | None = None
    if earlier is not None:
        comparison = compare_calibrations(calibration, earlier)
    return CalibrationEvidence(fitted, calibration, covered, leds, leds_covered, comparison, earlier)


def verdict(evidence: CalibrationEvidence) -> tuple[str, list[str]]:
    """Return one line on the calibration, and what to mind."""
    fitted = evidence.fitted
    problems = []
    share = evidence.covered_share
    if share < WARN_BELOW_COVERED:
        problems.append(
            f"Dots surround only {100 * share:.0f} % of the picture; rays outside are extrapolated. Take a "
            "larger "
            "target, or bring the planes nearer."
        )
    if evidence.leds_covered is not None and evidence.leds_covered < 1:
        problems.append(
            f"{100 * (1 - evidence.leds_covered):.0f} % of the places where LEDs may be seen lie outside "
            "the dots."
        )
    problems += [
        f"The pictures contradict the rig: {u.name} by {np.rad2deg(u.value):.3f} ± {np.rad2deg(u.sd):.3f} "
        "degrees. Check the board, or fit with a tolerance for turns."
        for u in fitted.doubts
    ]
    if evidence.comparison is not None and evidence.comparison.explained_share < 0.5:
        problems.append("The lens is not what it was at the earlier calibration, beyond both uncertainties.")
    worst = max(r.mean_um for r in fitted.model.residuals)
    line = f"Dots lie {worst:.1f} µm from the rays on average, at the worse plane; {fitted.choice.reason}."
    return line, problems


def _rendered(evidence: CalibrationEvidence, sections: list[Any]) -> str:
    calibration = evidence.calibration
    line, problems = verdict(evidence)
    return (
        page_environment()
        .get_template("report.html.j2")
        .render(
            run_id=f"Calibration of {calibration.unit}",
            unit=calibration.unit,
            label=calibration.focus_note,
            simulated=calibration.simulated,
            date=calibration.created_utc.strftime("%d %B %Y, %H:%M:%S UTC").lstrip("0"),
            provenance={"software_version": calibration.software.removeprefix("bricktrack ")},
            verdict=line,
            mood="care" if problems else "good",
            problems=problems,
            key=_key_figures(evidence),
            sections=sections,
            flag_tables=[],
            origin_tables=_origin_tables(calibration),
        )
    )


def _key_figures(evidence: CalibrationEvidence) -> list[Key]:
    fitted, model = evidence.fitted, evidence.fitted.model
    choice = fitted.choice
    chosen = next(
        c
        for c in choice.candidates
        if (c.model, c.order, c.held) == (choice.model, choice.order, choice.held)
    )
    uv = picture_grid(model.sensor_mode)
    middle = (model.plane_a_mm + model.plane_b_mm) / 2
    sd_um = 1e3 * CHI_95 * model.point_sd_mm(uv, middle)
    keys = [
        Key("Model", choice.model, f"{'degrees held up to' if choice.held else 'order'} {choice.order}"),
        Key("Mean residual", " · ".join(f"{r.mean_um:.2f}" for r in model.residuals) + " µm", "each plane"),
        Key("Maximum residual", " · ".join(f"{r.max_um:.1f}" for r in model.residuals) + " µm",
             "each plane"),
        Key("Dots", " · ".join(str(r.n_dots) for r in model.residuals),
             f"{sum(fitted.n_left_out)} left out as contradicting"),
        Key("Error at left-out dots", f"{chosen.rms_um:.2f} µm", f"rms; {chosen.max_um:.1f} µm at most"),
        Key("Picture covered", f"{100 * evidence.covered_share:.0f} %", "by dots around"),
        Key("Rays known to", f"{np.median(sd_um[model.is_covered(uv)]):.2f} µm",
             "95 %, median where covered, midway"),
    ]  # fmt: skip
    if evidence.leds is not None:
        inside = evidence.leds.contains(uv)
        if inside.any():
            keys.append(Key("... at the LEDs", f"{sd_um[inside].max():.2f} µm", "95 %, at most, midway"))
    return keys


def _origin_tables(calibration: Calibration) -> list[OriginTable]:
    mode = calibration.sensor_mode
    images = [
        (f"{image.name}, z = {image.z_mm:g} mm, {image.n_dots_found} dots", image.sha256)
        for image in calibration.images
    ]
    t = calibration.target
    made = [
        ("software", calibration.software),
        ("method", calibration.method),
        ("sensor mode", f"{mode.name}, {mode.width} x {mode.height} px"),
        ("focus", calibration.focus_note or "not noted"),
        ("target", f"{t.columns} x {t.rows} dots of {t.dot_diameter_mm:.3f} mm, {t.pitch_mm:g} mm apart"),
    ]
    return [
        OriginTable("Pictures, SHA-256", images, True),
        OriginTable("How it was made", made, False),
    ]


def _save_pictures(folder: Path, figures: dict[str, Figure]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png", dpi=_PNG_DPI, metadata={"Software": None})
