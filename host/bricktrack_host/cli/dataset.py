"""``bricktrack dataset``: the results of many tests in one place, for queries."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from bricktrack_common.errors import ConfigError
from bricktrack_host.cli._console import out, print_json
from bricktrack_host.cli._progress import stage_of_counts
from bricktrack_host.cli._units import JsonOption

if TYPE_CHECKING:
    from bricktrack_host.datasets.campaign_dataset import UnitEntry

app = typer.Typer(
    help="Keep the results of many tests in one place, for queries over all of them.", no_args_is_help=True
)

DatasetArgument = Annotated[Path, typer.Argument(metavar="DATASET", help="Its folder.")]


@app.command()
def add(
    dataset: DatasetArgument,
    sources: Annotated[
        list[Path], typer.Argument(metavar="TEST|RUN", help="Combined tests, or processed runs.")
    ],
    test: Annotated[
        str | None,
        typer.Option(
            "--test",
            help="What the dataset shall call the test. \\[default: its own name; of a run, its label]",
            show_default=False,
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Add combined tests, or single runs, to a dataset; it is made if there is none.

    Each test is added whole or not at all, however it ends; given again, nothing is added twice. Rows whose
    place others take are kept as earlier ones. A combined test brings the motion of components against
    their base, and sample numbers that its units agree on; a run by itself brings what its camera saw.

    For example:

        bricktrack dataset add campaign tests/shake-*/combined

        bricktrack dataset add campaign runs/b2_9f31c2_0007_shake --test shake-7
    """
    from bricktrack_host.assemblies.combined_summary import TEST_SUMMARY_NAME
    from bricktrack_host.datasets.campaign_dataset import add_units
    from bricktrack_host.datasets.test_sources import source_of_run, sources_of_test

    tests = [source for source in sources if (source / TEST_SUMMARY_NAME).is_file()]
    runs = [source for source in sources if source not in tests]
    if test is not None and len(tests) + bool(runs) > 1:
        raise ConfigError(
            f"--test names one test; {len(sources)} sources of several were given. Add them by turns"
        )
    said = []
    with stage_of_counts() as progress:
        jobs = [(sources_of_test(folder, name=test), True) for folder in tests]
        if runs:
            jobs.append(([source_of_run(run, name=test) for run in runs], False))
        for units, is_whole in jobs:
            said.append(add_units(dataset, units, whole_tests=is_whole, progress=progress))
    if as_json:
        print_json(said)
        return
    for one in said:
        for what, places in (
            ("added", one.added), ("replaced, the earlier rows are kept", one.replaced),
            ("retired, kept among the earlier rows", one.retired), ("there already", one.unchanged),
        ):  # fmt: skip
            if places:
                shown = ", ".join(places[:3]) + (f" and {len(places) - 3} more" if len(places) > 3 else "")
                out.print(f"{len(places)} {what}: {shown}", markup=False, soft_wrap=True)
    out.print(f"dataset: {dataset}", markup=False, soft_wrap=True)


@app.command("list")
def list_(
    dataset: DatasetArgument,
    by_unit: Annotated[
        bool, typer.Option("--units", help="One line a unit, in place of one an assembly.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Say what a dataset holds: tests, assemblies, units, rows, and what of it needs care.

    For example:

        bricktrack dataset list campaign

        bricktrack dataset list campaign --units --json
    """
    from bricktrack_host.datasets.campaign_dataset import list_units

    with stage_of_counts() as progress:
        entries = list_units(dataset, progress=progress)
    if as_json:
        print_json(entries)
        return
    groups: dict[tuple[str, ...], list[UnitEntry]] = {}
    for entry in entries:
        key = (entry.test, entry.assembly or "-", *((entry.unit,) if by_unit else ()))
        groups.setdefault(key, []).append(entry)
    table = Table()
    for header in ("test", "assembly", *(("unit",) if by_unit else ()), "component", "samples"):
        table.add_column(header, overflow="fold")
    for header in (*(() if by_unit else ("units",)), "rows", "problems", "earlier"):
        table.add_column(header, justify="right", no_wrap=True)
    for key, group in groups.items():
        table.add_row(
            *key,
            ", ".join(c for e in group for c in e.components) or "-",
            ", ".join(dict.fromkeys(e.sample_agreement for e in group)),
            *(() if by_unit else (str(len(group)),)),
            str(sum(e.rows for e in group)),
            str(sum(len(e.problems) for e in group)),
            str(sum(e.earlier for e in group)),
        )
    out.print(table)
    counts = (
        (len({entry.test for entry in entries}), "test"),
        (len(entries), "unit"),
        (sum(entry.rows for entry in entries), "row"),
    )
    simulated = sum(entry.simulated for entry in entries)
    out.print(
        ", ".join(f"{n} {what}" if n == 1 else f"{n} {what}s" for n, what in counts)
        + f", {sum(entry.size_bytes for entry in entries) / 1e6:.1f} MB"
        + (f"; {simulated} of the runs simulated" if simulated else ""),
        markup=False,
        soft_wrap=True,
    )
