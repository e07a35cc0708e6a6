"""``bricktrack calibrate leds``: what the LEDs of a type show, fitted from a recording of them."""

from pathlib import Path
from typing import Annotated

import typer

from bricktrack_common.errors import CalibrationError, ConfigError


def leds(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run of the brick at rest in several poses.")],
    calibration: Annotated[Path, typer.Option("--calibration", "-c", help="Calibration file of the camera.")],
    layout: Annotated[
        Path, typer.Option("--layout", "-l", help="Layout file of the brick, without a profile.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Layout file to write, with the profile.")],
) -> None:
    """Fit the shape that LEDs of this type show, and write it into a copy of the layout file.

    A dome is no point: seen from the side, the middle of its light lies beside the middle of its sphere; how
    far depends on the lit collar under the dome. The best recording is a sweep: the brick at rest at ten or
    more places that fill the picture, near and far.

    For example:

        bricktrack calibrate leds runs/b2_sweep -c b2.json -l brick.toml -o brick-with-leds.toml
    """
    from bricktrack_common.brick_model import load_brick_model
    from bricktrack_common.run_folder import read_run
    from bricktrack_host.calibration.calibration_file import load_calibration, require_match
    from bricktrack_host.cli._console import out
    from bricktrack_host.cli.process import stage_bar
    from bricktrack_host.pipeline import observe_run
    from bricktrack_host.tracking.led_fit import fit_collar

    brick = load_brick_model(layout)
    if brick.led_profile is not None:
        raise ConfigError(f"{layout}: has a [led_profile] already; take it out to fit another")
    rays = load_calibration(calibration)
    recording = read_run(run, verify_hashes=True)
    if recording.manifest.camera is not None:
        require_match(rays, unit=recording.manifest.unit, sensor_mode=recording.manifest.camera.mode)
    with stage_bar(run.name) as bar:
        observations, problems = observe_run(recording, rays.ray_model, brick, progress=bar)
    for problem in problems:
        out.print(problem, style="yellow", markup=False)
    fit = fit_collar(observations, rays.ray_model, brick)
    simulated = " (simulated)" if recording.manifest.simulated else ""
    out.print(
        f"collar: {fit.collar_mm:.3f} +- {fit.sd_mm:.3f} mm, from {fit.n_leds} LEDs in {fit.n_frames} "
        f"frames{simulated}"
    )
    out.print(
        f"residuals of frames left out of the fit: {fit.cross_validated_rms_px:.3f} px; "
        f"{fit.rms_without_px:.3f} px without a profile"
    )
    if not fit.is_believable:
        raise CalibrationError(
            f"{run}: the recording does not tell the profile: left-out frames fit no better with it. "
            "Record a sweep that fills the picture, near and far"
        )
    source = (
        f"fitted from {recording.manifest.run_id}, {fit.n_frames} frames{simulated}, sd {fit.sd_mm:.3f} mm"
    )
    text = layout.read_text(encoding="utf-8").rstrip()
    output.write_text(
        f'{text}\n\n[led_profile]\ncollar_mm = {fit.collar_mm:.4f}\nsource = "{source}"\n', encoding="utf-8"
    )
    load_brick_model(output)
    out.print(f"layout with profile: {output}", markup=False, soft_wrap=True)
