"""What processing a run came to, said on the terminal."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from bricktrack_host.cli._console import out

# What computes is imported where it is used: `--help` and the units' commands need none of it.
if TYPE_CHECKING:
    from bricktrack_host.many_runs.run_job import RunJob, RunSummary
    from bricktrack_host.pipeline import ProcessedRun
    from bricktrack_host.results.truth import TruthComparison

TruthOption = Annotated[
    Path | None,
    typer.Option("--truth", help="True motion of a simulated run: a file, or a folder that holds one."),
]


def say_stands(jobs: "list[RunJob]") -> None:
    """Say that results of before stand, because they are of the same input."""
    if len(jobs) > 1:
        out.print(f"{len(jobs)} runs are processed already, of the same input; --again does them anew")
        return
    out.print(
        f"{jobs[0].run.name}: processed already, of the same input; --again does it anew",
        markup=False,
        soft_wrap=True,
    )
    out.print(f"results: {jobs[0].results}", markup=False, soft_wrap=True)


def say_processed(processed: "ProcessedRun", *, budget: bool = True) -> None:
    """Print what a processed run came to."""
    from bricktrack_host.many_runs.run_job import summarise

    say_summary(summarise(processed), budget=budget)


def say_summary(summary: "RunSummary", *, budget: bool = True) -> None:
    """Print the verdict and where it all is; with ``budget`` the times and the errors against truth too."""
    out.print(f"{summary.run_id}: {summary.verdict}", markup=False, soft_wrap=True)
    for problem in summary.problems:
        out.print(f"  {problem}", style="yellow", markup=False, soft_wrap=True)
    if budget:
        say_truth(summary.truth)
        _say_budget(summary.timings_s, summary.n_frames)
    out.print(f"results: {summary.folder}", markup=False, soft_wrap=True)
    out.print(f"report:  {summary.report}", markup=False, soft_wrap=True)
    if summary.earlier is not None:
        out.print(
            f"earlier: {summary.earlier} (kept; what changed: 'bricktrack compare {summary.folder.parent}')",
            markup=False,
            soft_wrap=True,
        )


def _say_budget(timings_s: dict[str, float], n_frames: int) -> None:
    table = Table(title="Time budget")
    table.add_column("stage")
    table.add_column("s", justify="right")
    table.add_column("ms a frame", justify="right")
    for name, seconds in timings_s.items():
        table.add_row(name, f"{seconds:.2f}", f"{1000 * seconds / n_frames:.2f}")
    total = sum(timings_s.values())
    table.add_row("all", f"{total:.2f}", f"{1000 * total / n_frames:.2f}", style="bold")
    out.print(table)


def say_truth(comparison: "TruthComparison | None") -> None:
    """Print the errors against simulated truth, absolute and as displacements from rest."""
    from bricktrack_host.results.truth import comparison_table

    if comparison is None:
        return
    out.print(comparison_table(comparison))
    out.print()
    if comparison.from_rest:
        out.print(comparison_table(comparison, from_rest=True))
        out.print()
