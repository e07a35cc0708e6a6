"""Draw a dot target as a PDF at true scale: vector dots, rulers to check the printer, words."""

from pathlib import Path

from reportlab.lib import pagesizes
from reportlab.lib.units import mm
from reportlab.pdfgen.canvas import Canvas

from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.target.printed_target import LARGE_RATIO, DotTarget, check_target

PAPERS_MM: dict[str, tuple[float, float]] = {
    name: (round(max(size) / mm, 1), round(min(size) / mm, 1))
    for name, size in {
        "A5": pagesizes.A5,
        "A4": pagesizes.A4,
        "letter": pagesizes.LETTER,
        "A3": pagesizes.A3,
        "tabloid": pagesizes.TABLOID,
        "A2": pagesizes.A2,
        "A1": pagesizes.A1,
        "A0": pagesizes.A0,
    }.items()
}
"""Long and short side, mm, from small to large."""

SIDE_MM, FOOT_MM = 12.0, 37.0
"""Left free around the dots' sheet: what printers do not reach, ticks, rulers and text."""
RULER_MM = 100
_WORDS_MM = 130  # about the width of the longest line of text


def smallest_paper(target: DotTarget) -> str | None:
    """Return the name of the smallest paper that holds the target with its rulers, if any does."""
    width, height = target.size_mm
    for name, (long, short) in PAPERS_MM.items():
        if width + 2 * SIDE_MM <= long and height + SIDE_MM + FOOT_MM <= short:
            return name
    return None


def draw_target(target: DotTarget, path: Path, *, paper: str | None = None) -> str:
    """Write a target as a PDF of one page, its middle in the middle between the margins.

    Parameters
    ----------
    target : DotTarget
    path : Path
    paper : str, optional
        A name of `PAPERS_MM`; the smallest that holds the target where not given.

    Returns
    -------
    paper : str
        The paper taken.

    Raises
    ------
    CalibrationError
        If the target does not fit the paper, its dots touch, or the file cannot be written.
    """
    check_target(target)
    width, height = target.size_mm
    smallest = smallest_paper(target)
    what = f"the target's {width:g} x {height:g} mm, with {SIDE_MM:g} mm around and {FOOT_MM:g} mm below,"
    if smallest is None:
        raise CalibrationError(
            f"{what} fit no paper up to {list(PAPERS_MM)[-1]}; take fewer columns and rows or a smaller pitch"
        )
    paper = paper or smallest
    if paper not in PAPERS_MM:
        raise CalibrationError(f"paper {paper!r}: expected one of {', '.join(PAPERS_MM)}")
    long, short = PAPERS_MM[paper]
    if width + 2 * SIDE_MM > long or height + SIDE_MM + FOOT_MM > short:
        raise CalibrationError(
            f"{what} do not fit {paper} ({long:g} x {short:g} mm); take {smallest}, or fewer columns and rows"
        )
    # Points have their origin at the bottom left; everything below is in mm from there.
    left, bottom = (long - width) / 2, FOOT_MM + (short - FOOT_MM - SIDE_MM - height) / 2
    try:
        canvas = Canvas(str(path), pagesize=(long * mm, short * mm), invariant=1)
        canvas.setTitle(title_of(target))
        canvas.scale(mm, mm)
        _draw_dots(canvas, target, left, bottom)
        _draw_ticks(canvas, left, bottom, width, height)
        foot = (long - _WORDS_MM) / 2
        _draw_rulers(canvas, foot, left - 7, bottom)
        _draw_words(canvas, target, foot, bottom, paper)
        canvas.save()
    except OSError as e:
        raise CalibrationError(f"{path}: {e.strerror or e}") from e
    return paper


def title_of(target: DotTarget) -> str:
    """Return what the target is, in one line.

    Examples
    --------
    >>> title_of(DotTarget(columns=32, rows=20, pitch_mm=4.0, diameter_mm=2.0))
    'bricktrack target: 32 x 20 dots, pitch 4 mm, diameter 2 mm (large 2.8 mm), white on black, coded'
    """
    large = f" (large {target.diameter_mm * LARGE_RATIO:g} mm)" if target.coded else ""
    return (
        f"bricktrack target: {target.columns} x {target.rows} dots, pitch {target.pitch_mm:g} mm, diameter "
        f"{target.diameter_mm:g} mm{large}, {target.polarity.replace('-', ' ')}, "
        + ("coded" if target.coded else "plain")
    )


def _draw_dots(canvas: Canvas, target: DotTarget, left: float, bottom: float) -> None:
    width, height = target.size_mm
    paper, ink = (0, 1) if target.polarity == "white-on-black" else (1, 0)
    canvas.setFillGray(paper)
    canvas.rect(left, bottom, width, height, stroke=0, fill=1)
    canvas.setFillGray(ink)
    middle_x, middle_y = left + width / 2, bottom + height / 2
    for (x, y), diameter in zip(
        target.centres_mm().reshape(-1, 2).tolist(), target.diameters_mm().ravel().tolist(), strict=True
    ):
        canvas.circle(middle_x + x, middle_y - y, diameter / 2, stroke=0, fill=1)


def _draw_ticks(canvas: Canvas, left: float, bottom: float, width: float, height: float) -> None:
    """Draw ticks that point at the middle, to set the target on the rig, and mark which edge is the top."""
    canvas.setFillGray(0)
    canvas.setStrokeGray(0)
    canvas.setLineWidth(0.2)
    x, y, gap, tick = left + width / 2, bottom + height / 2, 1.0, 5.0
    right, top = left + width, bottom + height
    canvas.line(x, top + gap, x, top + gap + tick)
    canvas.line(x, bottom - gap, x, bottom - gap - tick)
    canvas.line(left - gap, y, left - gap - tick, y)
    canvas.line(right + gap, y, right + gap + tick, y)
    canvas.setFont("Helvetica", 3)
    canvas.drawString(x + 1.5, top + gap + 1, "top")


def _draw_rulers(canvas: Canvas, left: float, side: float, bottom: float) -> None:
    """Draw rulers along the foot and at the side: a printer may scale the two directions differently."""
    canvas.setFont("Helvetica", 2.5)
    canvas.setLineWidth(0.15)
    y = bottom - 17
    canvas.line(left, y, left + RULER_MM, y)
    for k in range(RULER_MM + 1):
        canvas.line(left + k, y, left + k, y + (3.5 if k % 10 == 0 else 2.5 if k % 5 == 0 else 1.5))
        if k % 10 == 0:
            canvas.drawCentredString(left + k, y - 3, str(k))
    x, high = side, 50
    canvas.line(x, bottom, x, bottom + high)
    for k in range(high + 1):
        canvas.line(x, bottom + k, x - (3.5 if k % 10 == 0 else 2.5 if k % 5 == 0 else 1.5), bottom + k)


def _draw_words(canvas: Canvas, target: DotTarget, left: float, bottom: float, paper: str) -> None:
    canvas.setFont("Helvetica", 3)
    lines = (
        title_of(target),
        f"Print on {paper} at 100 %, not fitted to the page. Rulers: {RULER_MM} mm above, 50 mm at the left.",
        "Measure over many dots; if the printer errs, say the true pitch. Glue to something flat.",
    )
    for k, line in enumerate(lines):
        canvas.drawString(left, bottom - 24 - 4 * k, line)
