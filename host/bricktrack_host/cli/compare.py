"""``bricktrack compare``: what another processing changed."""

from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from bricktrack_host.cli._console import out, print_json
from bricktrack_host.cli._progress import stage_of_counts
from bricktrack_host.cli._units import JsonOption

if TYPE_CHECKING:
    from bricktrack_host.datasets.comparison import Alike

_SHOWN = 20


def compare(
    before: Annotated[
        Path,
        typer.Argument(metavar="BEFORE", help="A run, its results, a combined test, or a folder of runs."),
    ],
    after: Annotated[
        Path | None,
        typer.Argument(
            metavar="AFTER",
            help="Likewise. \\[default: BEFORE as it is now, against what its last processing replaced]",
            show_default=False,
        ),
    ] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="The page to write.")] = Path(
        "comparison.html"
    ),
    csv: Annotated[
        Path | None, typer.Option("--csv", help="Write the whole table there, too.", show_default=False)
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show what another processing changed, per run and axis, against the stated uncertainty, worst first.

    Samples that appear or disappear are counted; changed software, settings, calibrations and problems are
    named. The page also draws the worst.

    For example:

        bricktrack compare runs/b2_9f31c2_0007_shake

        bricktrack compare tests/shake-12/combined --csv changes.csv

        bricktrack compare runs/b2_9f31c2_0007_shake/results_1 runs/b2_9f31c2_0007_shake/results
    """
    from bricktrack_host.datasets.comparison import worst_first
    from bricktrack_host.datasets.comparison_pairs import compare as compare_folders
    from bricktrack_host.datasets.comparison_table import comparison_rows, write_comparison_csv
    from bricktrack_host.reporting.comparison_report import verdict, write_comparison_page

    with stage_of_counts() as progress:
        comparison = compare_folders(before, after, progress=progress)
        write_comparison_page(comparison, output, progress=progress)
    if csv is not None:
        write_comparison_csv(comparison, csv)
    if as_json:
        print_json({"verdict": verdict(comparison)[0], "motions": comparison_rows(comparison)})
        return
    simulated = " (simulated)" if comparison.simulated else ""
    out.print(f"{comparison.title}{simulated}: {verdict(comparison)[0]}", markup=False, soft_wrap=True)
    pairs = worst_first(comparison.pairs)
    out.print(_table(pairs))
    if len(pairs) > _SHOWN:
        out.print(f"and {len(pairs) - _SHOWN} more, less changed", markup=False)
    for change in dict.fromkeys(change for pair in pairs for change in pair.changes):
        out.print(f"  {change.what}: {change.before} -> {change.after}", markup=False, soft_wrap=True)
    if csv is not None:
        out.print(f"table: {csv}", markup=False, soft_wrap=True)
    out.print(f"page:  {output}", markup=False, soft_wrap=True)


def _table(pairs: "list[Alike]") -> Table:
    table = Table(title="Largest change of an axis, the worst first")
    for header in ("motion", "mm", "deg", "in sd", "at, s", "beyond 95 %", "came", "went"):
        table.add_column(header, justify="left" if header == "motion" else "right")
    for pair in pairs[:_SHOWN]:
        figures = ["-"] * 5
        if pair.n:
            figures = [
                f"{pair.largest[:3].max():.3g}",
                f"{pair.largest[3:].max():.3g}",
                f"{pair.in_sd.max():.2g}",
                f"{pair.worst_s:.2f}" if isfinite(pair.worst_s) else "-",
                f"{100 * pair.share_beyond:.1f} %",
            ]
        table.add_row(pair.name, *figures, str(pair.appeared), str(pair.disappeared))
    return table
