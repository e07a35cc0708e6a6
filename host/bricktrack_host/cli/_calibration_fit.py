"""What ``bricktrack calibrate fit`` does once its options are read: measure, fit, save and report."""

import string
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from bricktrack_common.camera_model import SensorMode
from bricktrack_host.calibration.calibration_file import (
    Target,
    TargetImage,
    make_calibration,
    save_calibration,
)
from bricktrack_host.calibration.plane_pictures import merged_planes, n_left_out
from bricktrack_host.calibration.ray_calibration import ModelWish, RayCalibration, calibrate_rays
from bricktrack_host.cli._calibration_inputs import FitJob, observe_job

WARN_BELOW_COVERED = 0.8
"""Whole dots that fill the picture surround some 85 % of it: up to a pitch is lost all round."""


def run_fit(
    job: FitJob,
    *,
    mode: SensorMode,
    model: ModelWish,
    order: int | None,
    unit: str,
    focus_note: str,
    output: Path,
) -> None:
    """Measure, fit, save and report."""
    pictures = observe_job(job, mode)
    planes = [(z_mm, merged.dots) for z_mm, merged in merged_planes(pictures)]
    fitted = calibrate_rays(
        planes, sensor_mode=mode, model=model, order=order, dot_diameter_mm=job.dot_diameter_mm
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
    _report(fitted, names=names, simulated=job.simulated)
    Console().print(f"Calibration of unit {unit} in mode {mode.name} written to {output}")


def _report(fitted: RayCalibration, *, names: list[str], simulated: bool) -> None:
    """Print what was found and how good it is."""
    console = Console()
    model, choice = fitted.model, fitted.choice
    mode = model.sensor_mode
    u, v = np.meshgrid((np.arange(64) + 0.5) / 64 * mode.width, (np.arange(36) + 0.5) / 36 * mode.height)
    everywhere = np.stack([u.ravel(), v.ravel()], axis=1) - 0.5
    covered = model.is_covered(everywhere)

    table = Table(title="Calibration" + (" (simulated pictures)" if simulated else ""))
    table.add_column("")
    for letter, name in zip(string.ascii_uppercase, names, strict=False):
        table.add_column(f"plane {letter}: {name}", justify="right")
    rs = model.residuals
    sd_um = [1e3 * model.point_sd_mm(everywhere, r.z_mm) for r in rs]
    table.add_row("depth, mm", *(f"{r.z_mm:.3f}" for r in rs))
    table.add_row("dots used", *(str(r.n_dots) for r in rs))
    table.add_row("dots left out", *(str(n) for n in fitted.n_left_out))
    table.add_row("mean residual, um", *(f"{r.mean_um:.2f}" for r in rs))
    table.add_row("rms residual, um", *(f"{r.rms_um:.2f}" for r in rs))
    table.add_row("max residual, um", *(f"{r.max_um:.2f}" for r in rs))
    table.add_row(
        "noise of the fit where dots are, um, at most", *(f"{sd[covered].max():.2f}" for sd in sd_um)
    )
    table.add_row("... over the whole picture, um, at most", *(f"{sd.max():.2f}" for sd in sd_um))
    console.print(table)

    candidates = Table(title="Error at dots left out of the fit")
    for heading in ("model", "order", "rms um", "max um", "noise over the picture um", ""):
        candidates.add_column(heading, justify="left" if heading in ("model", "") else "right")
    for c in choice.candidates:
        taken = (c.model, c.order) == (choice.model, choice.order)
        candidates.add_row(
            c.model,
            str(c.order),
            f"{c.rms_um:.2f}",
            f"{c.max_um:.2f}",
            f"{c.picture_noise_um:.2f}",
            "taken" if taken else "",
        )
    console.print(candidates)
    console.print(f"Model: {choice.reason}")
    share = float(np.mean(covered))
    both = " at both planes" if choice.model == "two-plane" else ""
    console.print(f"Dots surround {share:.0%} of the picture{both}.")
    if share < WARN_BELOW_COVERED:
        console.print(
            "Warning: rays outside are extrapolated. Take a larger target, or bring the planes nearer.",
            style="yellow",
        )
