"""``bricktrack calibrate leds``: what LEDs of a type show, and where they sit, fitted from a recording."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bricktrack_common.errors import CalibrationError, ConfigError

if TYPE_CHECKING:
    from bricktrack_common.arrays import FloatArray
    from bricktrack_common.brick_model import BrickModel
    from bricktrack_host.tracking.led_fit import CollarFit
    from bricktrack_host.tracking.led_positions import PositionsFit

_MUCH_PX = 0.2
"""Of residuals: LEDs at their places leave 0.02 to 0.1 px, those 0.05 mm beside them 0.5 px (simulated)."""


def leds(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run of the brick at rest in several poses.")],
    calibration: Annotated[Path, typer.Option("--calibration", "-c", help="Calibration file of the camera.")],
    layout: Annotated[
        Path,
        typer.Option(
            "--layout", "-l", help="Layout file of the brick; without a profile unless --positions is given."
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Layout file to write, with what was fitted.")
    ],
    positions: Annotated[
        bool, typer.Option("--positions", help="Refine where the LEDs sit too, after their profile.")
    ] = False,
    tolerance_mm: Annotated[
        float,
        typer.Option(min=0.001, max=5.0, help="With --positions: how far off the layout may be, sd."),
    ] = 0.2,
) -> None:
    """Fit the shape that LEDs of this type show, and write it into a copy of the layout file.

    A dome is no point: seen from the side, the middle of its light lies beside the middle of its sphere; how
    far depends on the dome's height or the lit collar under it. The best recording is a sweep: the brick at
    rest at ten or more places that fill the picture, near and far.

    With --positions the LEDs' places are refined from the same frames. Pictures tell the pattern's shape
    only: the first LED stays the origin, and the others as a whole are neither turned about it nor made
    larger.

    An LED that is elsewhere than all the others say, in every frame alike (dirty, half covered, set beside
    its place), is named and left out of the fit; with --positions it counts where it is found.

    For example:

        bricktrack calibrate leds runs/b2_sweep -c b2.json -l brick.toml -o brick-with-leds.toml

        bricktrack calibrate leds runs/b2_sweep -c b2.json -l brick.toml -o brick-refined.toml --positions
    """
    from dataclasses import replace

    from bricktrack_common.brick_model import ProfileEntry, load_brick_model
    from bricktrack_common.run_folder import read_run
    from bricktrack_host.calibration.calibration_file import load_calibration, rays_of_recording
    from bricktrack_host.cli._console import out
    from bricktrack_host.cli._stage_bar import stage_bar
    from bricktrack_host.pipeline import observe_run
    from bricktrack_host.tracking.led_fit import LEAST_SHIFT_SD, fit_collar
    from bricktrack_host.tracking.led_positions import fit_positions

    brick = load_brick_model(layout)
    if brick.led_profile is not None and not positions:
        raise ConfigError(f"{layout}: has a [led_profile] already; take it out to fit another")
    calibrated = load_calibration(calibration)
    rays = calibrated.ray_model
    recording = read_run(run, verify_hashes=True)
    if recording.manifest.camera is not None:
        mode = recording.manifest.camera.mode
        rays = rays_of_recording(calibrated, unit=recording.manifest.unit, sensor_mode=mode)
    with stage_bar(run.name) as bar:
        observations, problems = observe_run(recording, rays, brick, progress=bar)
    for problem in problems:
        if problem not in recording.problems:  # those were said when it was read
            out.print(problem, style="yellow", markup=False, soft_wrap=True)
    simulated = " (simulated)" if recording.manifest.simulated else ""
    text = layout.read_text(encoding="utf-8").rstrip()
    places: PositionsFit | None = None
    if brick.led_profile is not None:
        places = fit_positions(observations, rays, brick, tolerance_mm=tolerance_mm)
    else:
        fit = fit_collar(observations, rays, brick)
        if positions:
            start = replace(
                brick,
                led_profile=ProfileEntry(
                    collar_mm=fit.collar_mm, source="being fitted", shift_sd_per_radius=LEAST_SHIFT_SD
                ),
            )
            places = fit_positions(observations, rays, start, tolerance_mm=tolerance_mm, with_collar=True)
            moved = replace(brick, led_positions_mm=places.positions_mm)
            fit = fit_collar(
                observations, rays, moved, start_mm=places.collar_mm, least_sd_mm=places.collar_sd_mm
            )
        _show_collar(fit, brick, simulated)
        if places is None and fit.cross_validated_rms_px > _MUCH_PX:
            out.print(
                "That is much: 0.05 px is usual. Do the LEDs sit where the layout has them? --positions "
                "finds that out from the same recording.",
                style="yellow", markup=False, soft_wrap=True,
            )  # fmt: skip
        if not fit.is_believable:
            raise CalibrationError(
                f"{run}: the recording does not tell the profile: left-out frames fit no better with it. "
                "Record a sweep that fills the picture, near and far"
            )
        text += (
            f"\n\n[led_profile]\ncollar_mm = {fit.collar_mm:.4f}\n"
            f"shift_sd_per_radius = {fit.shift_sd_per_radius:.5f}\n"
            f'source = "fitted from {recording.manifest.run_id}, {fit.n_frames} frames{simulated}, '
            f'sd {fit.sd_mm:.3f} mm{_without(fit, brick)}"'
        )
    if places is not None:
        _show_positions(places, brick, simulated)
        if not places.is_believable:
            raise CalibrationError(
                f"{run}: the recording does not better the positions: left-out frames fit no better with "
                "them. Keep those of the layout, or record a sweep that fills the picture, near and far"
            )
        text = _with_positions(text, places, layout)
    output.write_text(text + "\n", encoding="utf-8")
    load_brick_model(output)
    out.print(f"layout written: {output}", markup=False, soft_wrap=True)


def _without(fit: "CollarFit", brick: "BrickModel") -> str:
    """Return the names of LEDs left out, for the file."""
    names = [name for name, px in zip(brick.led_names, fit.left_out_px, strict=True) if px > 0]
    return f", without {', '.join(names)}" if names else ""


def _show_left_out(left_out_px: "FloatArray", brick: "BrickModel") -> None:
    from bricktrack_host.cli._console import out
    from bricktrack_host.tracking.sweep_frames import words_on_left_out

    words = words_on_left_out(left_out_px, brick)
    if words:
        out.print(words, style="yellow", markup=False, soft_wrap=True)


def _show_collar(fit: "CollarFit", brick: "BrickModel", simulated: str) -> None:
    from bricktrack_host.cli._console import out

    _show_left_out(fit.left_out_px, brick)
    what = "collar" if fit.collar_mm >= 0 else "no collar, and a dome higher than half a sphere by"
    out.print(
        f"{what}: {abs(fit.collar_mm):.3f} ± {fit.sd_mm:.3f} mm, from {fit.n_leds} LEDs in {fit.n_frames} "
        f"frames{simulated}; the light's middle is then known to {100 * fit.shift_sd_per_radius:.2f} % of "
        "the radius"
    )
    out.print(
        f"residuals of frames left out of the fit: {fit.cross_validated_rms_px:.3f} px; "
        f"{fit.rms_without_px:.3f} px without a profile"
    )


def _show_positions(fit: "PositionsFit", brick: "BrickModel", simulated: str) -> None:
    from rich.table import Table

    from bricktrack_host.cli._console import out

    _show_left_out(fit.left_out_px, brick)
    table = Table(
        title=f"LED positions from {fit.n_frames} frames{simulated}, mm: change from the layout, ± sd"
    )
    for name in ("LED", "x", "y", "z"):
        table.add_column(name, justify="left" if name == "LED" else "right")
    change = fit.positions_mm - brick.led_positions_mm
    table.add_row(brick.led_names[0], "origin", "", "")
    for k in range(1, brick.n_leds):
        told = (f"{m:+.3f} ± {s:.3f}" for m, s in zip(change[k], fit.sd_mm[k], strict=True))
        table.add_row(brick.led_names[k], *(("left out", "", "") if fit.left_out_px[k] > 0 else told))
    out.print(table)
    odd = ", ".join(name for name, px in zip(brick.led_names, fit.odd_px, strict=True) if px > 0)
    if odd:
        out.print(
            f"LED {odd}: not where the layout has it, by all the others. If it is dirty or half covered "
            "rather than misplaced, clean it and record anew: its place here is that of the light as it was",
            style="yellow", markup=False, soft_wrap=True,
        )  # fmt: skip
    out.print(
        f"residuals of frames left out of the fit: {fit.cross_validated_rms_px:.3f} px; "
        f"{fit.rms_before_px:.3f} px with the layout's positions"
    )
    out.print("Pictures tell neither turn nor size of the whole: both were left as in the layout.")


def _with_positions(text: str, fit: "PositionsFit", layout: Path) -> str:
    """Return a layout file's text with other positions in its ``[[led]]`` tables, and all else as it was."""
    head, *tables = re.split(r"(?m)^(?=\[\[?[\w. \"]+\]\]?)", text)
    places = iter(fit.positions_mm.tolist())
    out, n = [head], 0
    for table in tables:
        if table.startswith("[[led]]"):
            x, y, z = next(places, (0.0, 0.0, 0.0))
            table, found = re.subn(
                r"(?m)^(\s*position_mm\s*=\s*)\[[^\]]*\]",
                rf"\g<1>[{x:.4f}, {y:.4f}, {z:.4f}]",
                table,
                count=1,
            )
            n += found
        out.append(table)
    if n != len(fit.positions_mm):
        raise ConfigError(
            f"{layout}: {n} of {len(fit.positions_mm)} positions found in [[led]] tables of their own; write "
            "one table with a position_mm for each LED"
        )
    return "".join(out)
