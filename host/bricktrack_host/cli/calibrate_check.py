"""``bricktrack calibrate check``: does a calibration still hold? New pictures decide."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bricktrack_common.errors import ConfigError
from bricktrack_host.cli._console import out

# With OpenCV and SciPy behind it: not for `--help`.
if TYPE_CHECKING:
    from bricktrack_host.calibration.calibration_check import BoardCheck
    from bricktrack_host.calibration.calibration_file import Calibration
    from bricktrack_host.cli._calibration_inputs import FitJob

EXIT_DOES_NOT_HOLD = 3


def check(
    calibration: Annotated[Path, typer.Argument(help="Calibration file, as `calibrate fit` wrote it.")],
    captured: Annotated[
        Path | None, typer.Option(help="Folder of pictures that `calibrate capture` took.")
    ] = None,
    board: Annotated[Path | None, typer.Option(help="Target file, as `bricktrack target` wrote it.")] = None,
    picture: Annotated[
        list[str] | None,
        typer.Option(
            help="Picture of that target, with its depth in mm where that is known; may be given again.",
            metavar="[Z=]FILE",
        ),
    ] = None,
    origin_near: Annotated[
        tuple[float, float] | None,
        typer.Option(help="A pixel near the origin, for a plain target.", metavar="U V"),
    ] = None,
    board_um: Annotated[
        float, typer.Option(min=0, help="How well the board is made: standard deviation of its dots, µm.")
    ] = 10.0,
    depth_mm: Annotated[
        float, typer.Option("--depth-tolerance-mm", min=0, help="How well the depths given are known, mm.")
    ] = 0.3,
) -> None:
    """Compare a calibration with new pictures of a target; exits with 3 if it does not hold.

    The board may stand anywhere and at any slant: its pose is fitted, and what is left is compared with the
    stated uncertainty of dots, rays and board. A lens that was turned shows as another depth, so give the
    depths where the rig tells them.

    For example:

        bricktrack calibrate check b1.json --captured pictures-b1-today

        bricktrack calibrate check b1.json --board target.toml --picture 101.117=near.png

        bricktrack calibrate check b1.json --board target.toml --picture by-hand.png
    """
    from bricktrack_host.calibration.calibration_file import load_calibration

    stored = load_calibration(calibration)
    job, known = _job(captured, board, picture, origin_near)
    pages = _checked(stored, job, board_um=board_um)
    names = [path.name for _, path in job.pictures]
    depths = [z if k else None for (z, _), k in zip(job.pictures, known, strict=True)]
    problems = [
        f"{name}: {problem}"
        for name, z, page in zip(names, depths, pages, strict=True)
        for problem in _problems(page, z, depth_mm)
    ]
    _report(stored, names, depths, pages, simulated=job.simulated)
    for problem in problems:
        out.print(problem, style="yellow", markup=False, soft_wrap=True)
    if problems:
        out.print("The calibration does not hold: calibrate again.", style="bold red")
        raise typer.Exit(EXIT_DOES_NOT_HOLD)
    out.print("The calibration holds.", style="green")
    if None in depths:
        out.print("Without a depth, a change of focus cannot be told from the board being farther away.")


def _job(
    captured: Path | None,
    board: Path | None,
    picture: list[str] | None,
    origin_near: tuple[float, float] | None,
) -> "tuple[FitJob, list[bool]]":
    """Return what to check with, and of which pictures the depth is known."""
    import msgspec

    from bricktrack_host.calibration.dots.dot_grid import GridOrigin
    from bricktrack_host.cli._calibration_inputs import (
        FitJob,
        depth_and_file,
        job_of_capture,
        job_of_pictures,
    )

    if (captured is None) == (board is None):
        raise ConfigError("give either --captured, or --board with --picture")
    if captured is not None:
        if picture or origin_near:
            raise ConfigError("--picture or --origin-near given together with --captured; give one of them")
        job: FitJob = job_of_capture(captured)
        return job, [True] * len(job.pictures)
    if not picture or board is None:
        raise ConfigError("--picture not given; give one or more, as --picture 101.117=near.png")
    known = ["=" in p for p in picture]
    origin = GridOrigin(origin_near) if origin_near else None
    # A depth that is not known still keeps the pictures apart.
    pictures = tuple(
        depth_and_file(p) if k else (float(i + 1), Path(p))
        for i, (p, k) in enumerate(zip(picture, known, strict=True))
    )
    return msgspec.structs.replace(job_of_pictures(board, [], origin), pictures=pictures), known


def _checked(stored: "Calibration", job: "FitJob", *, board_um: float) -> "list[BoardCheck]":
    from bricktrack_common.errors import CalibrationError
    from bricktrack_host.calibration.calibration_check import check_board
    from bricktrack_host.calibration.calibration_file import require_match
    from bricktrack_host.calibration.dots.plane_pictures import observe_pictures
    from bricktrack_host.cli._progress import counting_bar

    if job.mode is not None:
        require_match(stored, unit=job.unit, sensor_mode=job.mode)
    added_px = max((noise.added_px for noise in stored.noise), default=0.0)
    pages = []
    with counting_bar("pictures", len(job.pictures)) as progress:
        for i, picture in enumerate(job.pictures):
            # One by one: boards held by hand need not be turned alike.
            (found,) = observe_pictures(
                [picture], job.target, origin=job.origin, polarity=job.polarity, mode=stored.sensor_mode
            )
            try:
                page = check_board(
                    stored.ray_model,
                    found.placed,
                    dot_diameter_mm=job.target.diameter_mm,
                    added_px=added_px,
                    board_um=board_um,
                )
            except CalibrationError as e:
                raise CalibrationError(f"{found.path}: {e}") from e
            pages.append(page)
            progress(i + 1, len(job.pictures))
    return pages


def _problems(page: "BoardCheck", z_mm: float | None, tolerance_mm: float) -> list[str]:
    """Return in words what speaks against the calibration."""
    from bricktrack_host.calibration.calibration_check import MAX_RATIO

    words = []
    if page.ratio > MAX_RATIO:
        words.append(
            f"residuals of {page.rms_um:.1f} µm rms are {page.ratio:.1f} times what is stated "
            f"({page.stated_um:.1f} µm); up to {MAX_RATIO:g} times is usual"
        )
    if z_mm is not None:
        off, allowed = page.depth_mm - z_mm, tolerance_mm + 3 * page.depth_sd_mm
        if abs(off) > allowed:
            words.append(
                f"the board seems to be at {page.depth_mm:.2f} mm, not {z_mm:g} mm ({off:+.2f} mm, up to "
                f"{allowed:.2f} mm is usual): was the focus turned, or the rig moved?"
            )
    return words


def _report(
    stored: "Calibration",
    names: list[str],
    depths: list[float | None],
    pages: "list[BoardCheck]",
    *,
    simulated: bool,
) -> None:
    from rich.table import Table

    title = f"Calibration of unit {stored.unit}, {stored.created_utc:%Y-%m-%d}"
    table = Table(title=title + (" (simulated)" if simulated or stored.simulated else ""))
    table.add_column("")
    for name in names:
        table.add_column(name, justify="right")
    table.add_row("dots", *(str(len(p.uv_px)) for p in pages))
    table.add_row("dots left out", *(str(p.n_outliers) for p in pages))
    table.add_row("mean residual, µm", *(f"{p.mean_um:.2f}" for p in pages))
    table.add_row("rms residual, µm", *(f"{p.rms_um:.2f}" for p in pages))
    table.add_row("max residual, µm", *(f"{p.max_um:.2f}" for p in pages))
    table.add_row("stated rms, µm", *(f"{p.stated_um:.2f}" for p in pages))
    table.add_row("residual by stated", *(f"{p.ratio:.2f}" for p in pages))
    table.add_row("depth found, mm", *(f"{p.depth_mm:.3f} ± {p.depth_sd_mm:.3f}" for p in pages))
    table.add_row("depth given, mm", *("" if z is None else f"{z:.3f}" for z in depths))
    table.add_row("tilt, degrees", *(f"{p.tilt_deg:.2f}" for p in pages))
    table.add_row("dots that the calibration covers", *(f"{100 * p.covered:.0f} %" for p in pages))
    out.print(table)
