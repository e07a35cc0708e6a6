"""``bricktrack combine``: the runs of one shake into the motion of assemblies."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from bricktrack_common.errors import ConfigError
from bricktrack_common.run_manifest import MANIFEST_NAME, RUN_ID_PATTERN, read_manifest
from bricktrack_host.campaign.test_plan import PLAN_NAME
from bricktrack_host.cli._console import out, print_json
from bricktrack_host.cli._progress import stage_of_counts
from bricktrack_host.cli._units import FleetOption, JsonOption, fleet_path
from bricktrack_host.transfer.fleet_config import load_fleet

if TYPE_CHECKING:
    from bricktrack_host.assemblies.combined_summary import TestSummary


def combine(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN", help="Processed runs of one shake, one a unit.")
    ],
    name: Annotated[str, typer.Option("--name", "-n", help="Name of the test.")],
    fleet: FleetOption = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder to write. \\[default: tests/NAME beside the fleet file]"),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare the units of one shake, and write how each component of an assembly moved against its base.

    The fleet file's assemblies say which unit watches which component. A unit that missed the first edge of
    the square wave is found and its sample numbers are put right, or it is said that nothing can tell.

    For example:

        bricktrack combine runs/b7-*_shake-12 --name shake-12

        bricktrack combine runs/*_shake-12 --name shake-12 --fleet lab/fleet.toml --json
    """
    from bricktrack_host.assemblies.combined_test import combine_test
    from bricktrack_host.reporting.combined_report import REPORT_NAME, write_combined_report
    from bricktrack_host.results.result_store import results_of

    path = fleet_path(fleet)
    config = load_fleet(path)
    if re.fullmatch(RUN_ID_PATTERN, name) is None:
        raise ConfigError(f"--name {name!r}: expected letters, digits, '.', '-' and '_', as 'shake-12'")
    folder = output or path.resolve().parent / "tests" / name
    if (folder / PLAN_NAME).exists():
        raise ConfigError(
            f"{folder} is a planned test's: 'bricktrack test report {name}' combines its runs. For others "
            "give another --name, or --output"
        )
    results: dict[str, Path] = {}
    for run in runs:
        unit = read_manifest(run / MANIFEST_NAME).unit
        if unit in results:
            raise ConfigError(
                f"{run}: unit {unit!r} has another run here, {results[unit].parent}; give one of them"
            )
        results[unit] = results_of(run)
    with stage_of_counts() as progress:
        summary = combine_test(
            name, results, config.assembly, folder, also=write_combined_report, progress=progress
        )
    if as_json:
        print_json(summary)
        return
    say_test(summary)
    out.print(f"results: {folder}", markup=False, soft_wrap=True)
    out.print(f"report:  {folder / REPORT_NAME}", markup=False, soft_wrap=True)


def say_test(summary: "TestSummary") -> None:
    """Print what a test amounts to: components, loops, and what is wrong."""
    simulated = " (simulated)" if summary.simulated else ""
    agree = sum(unit.edges in ("agrees", "corrected") for unit in summary.units)
    units = "1 unit" if len(summary.units) == 1 else f"{len(summary.units)} units"
    solved = "1 assembly" if len(summary.assemblies) == 1 else f"{len(summary.assemblies)} assemblies"
    out.print(
        f"{summary.name}{simulated}: {units}, {agree} on the same samples, {solved}",
        markup=False,
        soft_wrap=True,
    )
    for problem in summary.problems:
        out.print(f"  {problem}", style="yellow", markup=False, soft_wrap=True)
    if summary.assemblies:
        table = Table(title="Largest motion from rest, seen from the base")
        for header in ("assembly", "base", "component", "seen by"):
            table.add_column(header)
        table.add_column("mm", justify="right")
        table.add_column("deg", justify="right")
        for entry in summary.assemblies:
            for component, chain in entry.chains.items():
                mm, deg = entry.peak_mm.get(component), entry.peak_deg.get(component)
                table.add_row(
                    entry.name,
                    entry.base,
                    component,
                    " then ".join(chain),
                    "-" if mm is None else f"{mm:.3f}",
                    "-" if deg is None else f"{deg:.3f}",
                )
        out.print(table)
    loops = [(entry, loop) for entry in summary.assemblies for loop in entry.loops]
    for entry, loop in loops:
        rms_mm, rms_deg = loop["rms_mm"], loop["rms_deg"]
        gap = "no sample in common" if rms_mm is None else f"gapes by {rms_mm:.3f} mm, {rms_deg:.3f} deg rms"
        out.print(f"loop of {entry.name} closed by {loop['unit']}: {gap}", markup=False)
