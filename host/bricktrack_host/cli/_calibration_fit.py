"""What ``bricktrack calibrate fit`` does once its options are read: measure, fit, save and report."""

import string
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from bricktrack_common.brick_model import load_brick_model
from bricktrack_common.camera_model import SensorMode
from bricktrack_common.errors import CalibrationError, ConfigError
from bricktrack_host.calibration.calibration_file import (
    Target,
    TargetImage,
    load_calibration,
    make_calibration,
    require_match,
    save_calibration,
)
from bricktrack_host.calibration.dots.plane_pictures import merged_planes, n_left_out
from bricktrack_host.calibration.rays.pixel_polynomials import COVERAGE_GRID, picture_grid
from bricktrack_host.calibration.rays.ray_calibration import (
    ModelWish,
    OrderWish,
    RayCalibration,
    calibrate_rays,
)
from bricktrack_host.calibration.rays.ray_uncertainty import CHI_95
from bricktrack_host.calibration.rays.rig_tolerance import RigTolerance
from bricktrack_host.cli._calibration_inputs import FitJob, observe_job
from bricktrack_host.cli._console import err
from bricktrack_host.durable_files import require_writable

MAX_ORDER = 15
WARN_BELOW_COVERED = 0.8
"""Whole dots that fill the picture surround some 85 % of it: up to a pitch is lost all round."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitOptions:
    """How to fit, and what to write beside the calibration.

    Attributes
    ----------
    model, order
        As for `bricktrack_host.calibration.rays.ray_calibration.calibrate_rays`.
    shift_tolerance_mm, turn_tolerance_deg, bend_tolerance_mm : float
        How well the rig is known; 0 is exactly.
    report : bool
        Write the page.
    figures : Path or None
        Folder for the page's figures as PNG.
    layout, earlier : Path or None
        Layout file, and earlier calibration, for the page.
    """

    model: ModelWish = "auto"
    order: OrderWish | None = None
    shift_tolerance_mm: float = 0.0
    turn_tolerance_deg: float = 0.0
    bend_tolerance_mm: float = 0.0
    report: bool = True
    figures: Path | None = None
    layout: Path | None = None
    earlier: Path | None = None


def order_wish(text: str | None) -> OrderWish | None:
    """Return what ``--order`` says.

    Raises
    ------
    ConfigError
        If it is neither a whole number from 1 to 15 nor one of the words.
    """
    if text is None or text == "held" or text == "cross-validated":
        return text  # type: ignore[return-value]
    if text.isdecimal() and 1 <= int(text) <= MAX_ORDER:
        return int(text)
    raise ConfigError(
        f"--order {text}: expected a whole number from 1 to {MAX_ORDER}, 'held' or 'cross-validated'"
    )


def run_fit(
    job: FitJob, options: FitOptions, *, mode: SensorMode, unit: str, focus_note: str, output: Path
) -> None:
    """Measure, fit, save and report."""
    # Looked at first: a wrong name is told before the work.
    if not output.parent.is_dir():
        raise ConfigError(f"{output}: there is no folder {output.parent}. Make it, or name another with -o")
    require_writable(output.parent, "The calibration goes there; name another folder with -o")
    earlier = load_calibration(options.earlier) if options.earlier is not None else None
    brick = load_brick_model(options.layout) if options.layout is not None else None
    if earlier is not None:
        try:
            require_match(earlier, unit=unit, sensor_mode=mode)
        except CalibrationError as e:
            raise CalibrationError(f"{options.earlier}: cannot be compared with these pictures: {e}") from e
    pictures = observe_job(job, mode)
    planes = [(z_mm, merged.dots) for z_mm, merged in merged_planes(pictures)]
    with err.status("fit") as status:
        fitted = calibrate_rays(
            planes,
            sensor_mode=mode,
            model=options.model,
            order=options.order,
            dot_diameter_mm=job.dot_diameter_mm,
            tolerance=RigTolerance(
                options.shift_tolerance_mm,
                float(np.deg2rad(options.turn_tolerance_deg)),
                options.bend_tolerance_mm,
            ),
            progress=lambda stage: status.update(f"fit: {stage}"),
        )
    calibration = make_calibration(
        fitted,
        unit=unit,
        target=Target(
            columns=job.target.columns,
            rows=job.target.rows,
            pitch_mm=job.target.pitch_mm,
            dot_diameter_mm=fitted.dot_diameter_mm,
        ),
        images=tuple(
            TargetImage(
                name=picture.path.name,
                sha256=picture.sha256,
                z_mm=picture.z_mm,
                n_dots_found=len(picture.placed),
                n_dots_left_out=n_left_out(picture, fitted.planes),
            )
            for picture in pictures
        ),
        focus_note=focus_note,
        simulated=job.simulated,
    )
    save_calibration(output, calibration)
    names = [" + ".join(p.path.name for p in pictures if p.z_mm == z) for z, _ in fitted.planes]
    _print(fitted, names=names, simulated=job.simulated)
    Console().print(f"Calibration of unit {unit} in mode {mode.name} written to {output}")
    if options.report or options.figures is not None:
        # Matplotlib, a second to load: not without need.
        from bricktrack_host.reporting.calibration_report import write_calibration_report

        page = output.with_suffix(".html")
        with err.status("report"):
            write_calibration_report(
                page if options.report else None,
                fitted,
                calibration,
                brick=brick,
                earlier=earlier,
                pictures_dir=options.figures,
            )
        Console().print(f"Report written to {page if options.report else options.figures}")


def _print(fitted: RayCalibration, *, names: list[str], simulated: bool) -> None:
    """Print what was found and how good it is."""
    console = Console()
    model, choice = fitted.model, fitted.choice
    everywhere = picture_grid(model.sensor_mode, *COVERAGE_GRID)
    covered = model.is_covered(everywhere)

    table = Table(title="Calibration" + (" (simulated pictures)" if simulated else ""))
    table.add_column("", no_wrap=True)
    for letter, name in zip(string.ascii_uppercase, names, strict=False):
        table.add_column(f"plane {letter}: {name}", justify="right", overflow="fold")
    rs = model.residuals
    sd_um = [1e3 * CHI_95 * model.point_sd_mm(everywhere, r.z_mm) for r in rs]
    table.add_row("depth, mm", *(f"{r.z_mm:.3f}" for r in rs))
    table.add_row("dots used", *(str(r.n_dots) for r in rs))
    table.add_row("dots left out", *(str(n) for n in fitted.n_left_out))
    table.add_row("mean residual, µm", *(f"{r.mean_um:.2f}" for r in rs))
    table.add_row("rms residual, µm", *(f"{r.rms_um:.2f}" for r in rs))
    table.add_row("max residual, µm", *(f"{r.max_um:.2f}" for r in rs))
    table.add_row("rays known to at dots (95 %), µm", *(f"{sd[covered].max():.2f}" for sd in sd_um))
    table.add_row("... over the whole picture, µm", *(f"{sd.max():.2f}" for sd in sd_um))
    console.print(table)

    candidates = Table(title="Error at dots left out of the fit")
    for heading in ("model", "rms µm", "max µm", "noise over the picture µm", ""):
        text = heading in ("model", "")
        candidates.add_column(heading, justify="left" if text else "right", no_wrap=heading == "model")
    for c in choice.candidates:
        taken = (c.model, c.order, c.held) == (choice.model, choice.order, choice.held)
        candidates.add_row(
            c.name,
            f"{c.rms_um:.2f}",
            f"{c.max_um:.2f}",
            f"{c.picture_noise_um:.2f}",
            "taken" if taken else "",
        )
    console.print(candidates)
    console.print(f"Model: {choice.reason}")
    share = float(np.mean(covered))
    both = " at both planes" if choice.model == "two-plane" else ""
    console.print(f"Dots surround {100 * share:.0f} % of the picture{both}.")
    if share < WARN_BELOW_COVERED:
        console.print(
            "Warning: rays outside are extrapolated. Take a larger target, or bring the planes nearer.",
            style="yellow",
        )
    for found in fitted.fit.rig:
        scale, unit = (np.rad2deg(1.0), "degrees") if found.unit == "rad" else (1.0, "mm")
        told = "" if found.is_observed else "; the pictures do not tell, the tolerance stands"
        console.print(f"{found.name}: {scale * found.value:+.4f} ± {scale * found.sd:.4f} {unit}{told}")
    for doubt in fitted.doubts:
        console.print(
            f"Warning: the pictures contradict the rig: {doubt.name} by {np.rad2deg(doubt.value):+.3f} ± "
            f"{np.rad2deg(doubt.sd):.3f} degrees. Check the board, or give --turn-tolerance-deg.",
            style="yellow",
        )
