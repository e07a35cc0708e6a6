"""``bricktrack target``: a dot target to print, of the size that the camera needs."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from bricktrack_common.errors import CalibrationError, ConfigError


def target(
    output: Annotated[Path, typer.Option("--output", "-o", help="PDF to write; a .toml is put beside it.")],
    fov_deg: Annotated[
        tuple[float, float],
        typer.Option(
            help="The camera's angles of view, across and down. \\[default: IMX219, 1920 x 1080 crop]",
            metavar="H V",
            show_default=False,
        ),
    ] = (38.9, 22.5),
    planes_mm: Annotated[
        tuple[float, float], typer.Option(help="Depths of the near and the far plane, mm.", metavar="A B")
    ] = (101.117, 161.111),
    width_px: Annotated[int, typer.Option(min=16, help="Width of the camera's picture, px.")] = 1920,
    columns: Annotated[
        int | None, typer.Option(min=2, max=400, help="Columns; as many as fill the picture by default.")
    ] = None,
    rows: Annotated[int | None, typer.Option(min=2, max=400, help="Rows; likewise.")] = None,
    pitch_mm: Annotated[
        float | None, typer.Option(min=0.2, help="Distance of neighbouring dots; chosen by default.")
    ] = None,
    diameter_mm: Annotated[
        float | None, typer.Option(min=0.1, help="Diameter of the dots; half the pitch by default.")
    ] = None,
    polarity: Annotated[
        Literal["white-on-black", "black-on-white"], typer.Option(help="Dots on background.")
    ] = "white-on-black",
    plain: Annotated[
        bool, typer.Option("--plain", help="All dots alike, as in the paper: the origin must be nominated.")
    ] = False,
    paper: Annotated[
        str | None, typer.Option(help="A5, A4, letter, A3, ... A0; the smallest that holds it by default.")
    ] = None,
) -> None:
    """Draw a dot target as a PDF at true scale, large enough to fill the picture at both planes.

    One dot in four is larger, in an order that tells each part of the target from every other: the camera
    need not see all of it, nor upright. The .toml beside the PDF says what was drawn; capture, fit and check
    read it.

    For example:

        bricktrack target -o target.pdf

        bricktrack target -o wide.pdf --fov-deg 59 35.4 --pitch-mm 4

        bricktrack target -o paper.pdf --plain --columns 32 --rows 18 --pitch-mm 4 --diameter-mm 2
    """
    import msgspec
    from rich.table import Table

    from bricktrack_host.calibration.target.printed_target import target_toml
    from bricktrack_host.calibration.target.target_drawing import draw_target, title_of
    from bricktrack_host.calibration.target.target_size import GOOD_DOT_PX, field_of_angles, filling_target
    from bricktrack_host.cli._console import out

    a_mm, b_mm = planes_mm
    if not 0 < a_mm < b_mm:
        raise ConfigError(f"--planes-mm {a_mm:g} {b_mm:g}: expected 0 < A < B")
    if output.suffix.lower() != ".pdf":
        raise ConfigError(f"{output}: expected a name that ends in .pdf")
    fields = [field_of_angles(fov_deg, z_mm=z, width_px=width_px) for z in planes_mm]
    board = filling_target(
        fields[0],
        fields[1],
        pitch_mm=pitch_mm,
        diameter_mm=diameter_mm,
        polarity=polarity,
        coded=not plain,
    )
    board = msgspec.structs.replace(board, columns=columns or board.columns, rows=rows or board.rows)
    taken = draw_target(board, output, paper=paper)
    beside = output.with_suffix(".toml")
    try:
        beside.write_text(f"# {title_of(board)}\n{target_toml(board)}", encoding="utf-8")
    except OSError as e:
        raise CalibrationError(f"{beside}: {e.strerror or e}") from e

    table = Table(title=f"{title_of(board)}, on {taken}")
    for heading in ("plane", "picture, mm", "dots in view", "dots fill", "a dot, px"):
        table.add_column(heading, justify="right")
    dot_px = [f.px_per_mm * board.diameter_mm for f in fields]
    for letter, field, px in zip("AB", fields, dot_px, strict=True):
        seen = field.dots_seen(board)
        table.add_row(
            f"{letter}, {field.z_mm:g} mm",
            f"{field.width_mm:.0f} x {field.height_mm:.0f}",
            f"{seen[0]} x {seen[1]}",
            f"{100 * field.share_filled(board):.0f} %",
            f"{px:.0f}",
        )
    out.print(table)
    if min(dot_px) < GOOD_DOT_PX[0] or max(dot_px) > GOOD_DOT_PX[1]:
        out.print(
            f"Dots of {min(dot_px):.0f} to {max(dot_px):.0f} px: {GOOD_DOT_PX[0]:g} to {GOOD_DOT_PX[1]:g} px "
            "are measured best. Change --pitch-mm.",
            style="yellow",
        )
    if min(f.share_filled(board) for f in fields) < 1:
        out.print(
            "The target does not fill the picture at both planes: beyond its dots rays are extrapolated.",
            style="yellow",
        )
    out.print(f"{output} and {beside} written. Print at 100 %, then measure the rulers.", markup=False)
