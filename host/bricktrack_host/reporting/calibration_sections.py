"""The sections of a calibration's report: words, tables and figures, from values."""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from bricktrack_host.calibration.calibration_comparison import CalibrationComparison
from bricktrack_host.calibration.calibration_file import Calibration
from bricktrack_host.calibration.dots.picture_region import ConvexRegion
from bricktrack_host.calibration.rays.board_diagnostics import pixel_shape, print_error
from bricktrack_host.calibration.rays.central_rays import CentralRays
from bricktrack_host.calibration.rays.cross_validation import block_folds, left_out_errors_mm
from bricktrack_host.calibration.rays.pixel_polynomials import COVERAGE_GRID, picture_grid
from bricktrack_host.calibration.rays.ray_calibration import RayCalibration
from bricktrack_host.reporting import calibration_figures as draw
from bricktrack_host.reporting.embedding import embed_figure
from bricktrack_host.reporting.report_sections import Section, SectionTable


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationEvidence:
    """What a calibration's report is made from.

    Attributes
    ----------
    fitted : RayCalibration
    calibration : Calibration
    covered : tuple of ConvexRegion
        What dots surrounded, for each plane where planes count singly.
    leds : ConvexRegion or None
        Where LEDs may be seen.
    leds_covered : float or None
        Share of those places that dots surround.
    comparison : CalibrationComparison or None
    earlier : Calibration or None
        What it is compared with.
    """

    fitted: RayCalibration
    calibration: Calibration
    covered: tuple[ConvexRegion, ...]
    leds: ConvexRegion | None = None
    leds_covered: float | None = None
    comparison: CalibrationComparison | None = None
    earlier: Calibration | None = None

    @property
    def covered_share(self) -> float:
        """Share of the picture that dots surround."""
        model = self.fitted.model
        return float(np.mean(model.is_covered(picture_grid(model.sensor_mode, *COVERAGE_GRID))))


def calibration_sections(evidence: CalibrationEvidence) -> tuple[list[Section], dict[str, Figure]]:
    """Return the sections, and the figures by name; call it inside `plots.style`."""
    figures: dict[str, Figure] = {}
    sections = [
        _residuals(evidence, figures),
        _left_out(evidence, figures),
        _coverage(evidence, figures),
        _uncertainty(evidence, figures),
        _board(evidence),
    ]
    if evidence.comparison is not None and evidence.earlier is not None:
        sections.append(_comparison(evidence.comparison, evidence.earlier, evidence.calibration, figures))
    return sections, figures


def _residuals(e: CalibrationEvidence, figures: dict[str, Figure]) -> Section:
    planes, fit = e.fitted.planes, e.fitted.fit
    section = Section(
        "residuals",
        "Residuals on the planes",
        [
            "Distance on each plane between a dot and where its pixel looks. It tells whether the grid was "
            "read rightly and the board is flat; it says nothing of places without dots."
        ],
    )
    rows = []
    for k, (r, noise) in enumerate(zip(e.fitted.model.residuals, fit.noise, strict=True)):
        d = 1e3 * np.hypot(*fit.residual_mm[k].T)
        stated = np.sqrt(np.mean(np.trace(planes[k][1].cov_px2, axis1=1, axis2=2)) / 2)
        scatter = np.sqrt(noise.scale * stated**2 + noise.added_px**2)
        cells = [r.mean_um, r.rms_um, float(np.quantile(d, 0.95)), r.max_um]
        rows.append(
            [f"{r.z_mm:g} mm", str(r.n_dots), *(f"{x:.2f}" for x in cells), f"{stated:.3f}", f"{scatter:.3f}"]
        )
    head = ["plane", "dots", "mean, µm", "rms, µm", "95 % below, µm", "max, µm", "stated noise, px",
            "found noise, px"]  # fmt: skip
    section.tables.append(SectionTable("", head, rows, 1))
    figures["residual-contours"] = draw.residual_contour_figure(planes, fit.residual_mm)
    figures["residual-surfaces"] = draw.residual_surface_figure(planes, fit.residual_mm)
    figures["residual-arrows"] = draw.residual_arrow_figure(planes, fit.residual_mm)
    section.figures = [
        embed_figure(figures["residual-contours"], "Contours of the residual over each plane",
                     "Residual over each plane; white: the dots."),
        embed_figure(figures["residual-surfaces"], "The residual over each plane as a surface",
                     "The same as surfaces."),
        embed_figure(figures["residual-arrows"], "Residuals as arrows",
                     "Residuals as arrows. Neighbours that point alike are misfit or print; disorder is "
                     "noise."),
    ]  # fmt: skip
    return section


def _left_out(e: CalibrationEvidence, figures: dict[str, Figure]) -> Section:
    planes, fit, choice = e.fitted.planes, e.fitted.fit, e.fitted.choice
    section = Section(
        "held-out",
        "Error at dots left out, and the choice of model",
        [
            "Blocks of neighbouring dots are left out of the fit and predicted by it. Noise over the "
            "picture is what the covariance says of all rays, those far from dots included.",
            f"Taken: {choice.reason}.",
        ],
    )
    rows = []
    for c in choice.candidates:
        taken = (c.model, c.order, c.held) == (choice.model, choice.order, choice.held)
        figures_um = [c.rms_um, c.max_um, c.picture_noise_um, c.expected_um]
        rows.append([c.name, "taken" if taken else "", *(f"{x:.2f}" for x in figures_um)])
    head = ["model", "", "rms, µm", "max, µm", "noise over the picture, µm", "expected error, µm"]
    section.tables.append(SectionTable("", head, rows, 2))
    ends = np.cumsum([len(d) for _, d in planes])[:-1]
    errors = np.split(left_out_errors_mm(fit, block_folds(planes)), ends)
    figures["left-out-errors"] = draw.left_out_figure(planes, errors)
    section.figures.append(
        embed_figure(figures["left-out-errors"], "Error at each dot as predicted without its neighbourhood")
    )
    return section


def _coverage(e: CalibrationEvidence, figures: dict[str, Figure]) -> Section:
    model = e.fitted.model
    words = [f"Dots surround {100 * e.covered_share:.0f} % of the picture"
             + ("." if isinstance(model, CentralRays) else " at both planes.")
             + " Rays outside are extrapolated, and samples that use one are flagged."]  # fmt: skip
    if e.leds_covered is not None:
        words.append(
            f"Dots surround {100 * e.leds_covered:.0f} % of the places where the layout's LEDs are seen "
            "with the "
            "brick on the axis, from the near plane to the far one, and 5 mm off to either side."
        )
    figures["coverage"] = draw.coverage_figure(model.sensor_mode, e.fitted.planes, e.covered, e.leds)
    shown = embed_figure(figures["coverage"], "Dots, what they surround, and the LEDs' region", half=True)
    return Section("coverage", "Coverage", words, [shown])


def _uncertainty(e: CalibrationEvidence, figures: dict[str, Figure]) -> Section:
    model = e.fitted.model
    a, b = model.plane_a_mm, model.plane_b_mm
    figures["uncertainty"] = draw.uncertainty_figure(
        model, model.sensor_mode, (a, (a + b) / 2, b), e.covered, e.leds
    )
    words = [
        "Half the longer axis of the region in which a ray meets the plane with 95 % probability: noise of "
        "the dots, smooth misfit of the polynomials, and what the rig's tolerance leaves open."
    ]
    shown = embed_figure(
        figures["uncertainty"],
        "95 % half-axis of the rays over the picture at three depths",
        "White: what dots surround" + ("; dashed: the LEDs' region." if e.leds is not None else "."),
    )
    return Section("uncertainty", "Uncertainty of the rays", words, [shown])


def _board(e: CalibrationEvidence) -> Section:
    fitted, model = e.fitted, e.fitted.model
    section = Section("board", "Board, print and rig")
    found = print_error(fitted.planes, fitted.fit.residual_mm)
    if found is None:
        section.words.append("Too few dots were seen at both planes to tell the print from noise.")
    elif found.sd_um > 0:
        section.words.append(
            f"Print: {found.n_common} dots seen at both planes are off their places by {found.sd_um:.1f} µm "
            "in x and in y (standard deviation), the same at both. It averages out over many dots."
        )
    else:
        section.words.append(
            f"Print: {found.n_common} dots seen at both planes show no error of their own; more than "
            f"{found.limit_um:.1f} µm would have been seen. What is smooth over the board would not."
        )
    shape = pixel_shape(model)
    section.words.append(
        f"Stretch: if the lens is round, pixels are {1e2 * shape.stretch:+.3f} % longer along x than along "
        f"y and out of square by {np.rad2deg(shape.shear_rad):+.3f} degrees; less than "
        f"{1e2 * shape.doubt:.2f} % or {np.rad2deg(shape.doubt):.2f} degrees says nothing, because this lens "
        "is no rounder. Pixels are square: more is the print's. Measure the target's rulers."
    )
    if isinstance(model, CentralRays) and model.walks:
        a, b = model.plane_a_mm, model.plane_b_mm
        edge = max(float(np.abs(d.xy_mm).max()) for _, d in fitted.planes)
        bend = model.walk_mm * edge**2 / (a * b)
        section.words.append(
            f"The pupil walks by {model.walk_mm:.2f} mm at slope 1. With two planes a board bent by "
            f"{abs(bend):.2f} mm at {edge:.0f} mm from its middle would look the same: check that it is "
            "flat, or take a picture at a third plane."
        )
    if fitted.fit.rig:
        rows = []
        for u in fitted.fit.rig:
            scale, unit = (np.rad2deg(1.0), "deg") if u.unit == "rad" else (1.0, "mm")
            values = [f"{scale * x:.4f}" for x in (u.value, u.sd, u.prior_sd)]
            rows.append([u.name, unit, "yes" if u.is_observed else "no: the tolerance stands", *values])
        head = ["", "", "told by the pictures", "found", "standard deviation", "tolerance"]
        section.tables.append(SectionTable("Found within the rig's tolerance", head, rows, 3))
    elif fitted.doubts:
        rows = [[u.name, f"{np.rad2deg(u.value):+.4f}", f"{np.rad2deg(u.sd):.4f}"] for u in fitted.doubts]
        section.tables.append(
            SectionTable("Turns of planes taken as exact, deg", ["", "found", "standard deviation"], rows, 1)
        )
    elif fitted.choice.model != "two-plane":
        section.words.append("Rig: taken as exact, and no turn of a plane contradicts that.")
    return section


def _comparison(
    c: CalibrationComparison, earlier: Calibration, now: Calibration, figures: dict[str, Figure]
) -> Section:
    size, left = (1e3 * np.sqrt(np.mean(np.sum(d**2, axis=1))) for d in (c.moved_mm, c.left_mm))
    turn, shift = np.rad2deg(c.turn_rad), c.shift_mm
    section = Section(
        "earlier",
        "Against the earlier calibration",
        [
            f"Earlier: {earlier.created_utc:%d %B %Y %H:%M} UTC, {earlier.choice.model}, focus "
            f"“{earlier.focus_note or 'not noted'}”. Where both are covered, rays differ by {size:.1f} µm "
            f"rms at z = {c.z_mm:.1f} mm.",
            f"A motion of the camera on the rig by ({shift[0]:+.3f}, {shift[1]:+.3f}, {shift[2]:+.3f}) mm "
            f"and ({turn[0]:+.4f}, {turn[1]:+.4f}, {turn[2]:+.4f}) degrees leaves {left:.1f} µm rms; of the "
            f"pixels, {100 * c.explained_share:.0f} % are then within both calibrations' 95 % uncertainty. "
            "What is "
            "left is the lens's.",
        ],
    )
    figures["earlier"] = draw.comparison_figure(c, now.sensor_mode)
    section.figures.append(embed_figure(figures["earlier"], "How rays moved since the earlier calibration"))
    return section
