"""A progress bar for work that is counted: ``3/8`` with the time passed, on standard error."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from bricktrack_host.cli._console import err


@contextmanager
def counting_bar(what: str, total: int) -> Iterator[Callable[[int, int], None]]:
    """Show a bar while the block runs; it is told how much is done, of how much."""
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=err, transient=True) as progress:
        task = progress.add_task(what, total=total)
        yield lambda done, of: progress.update(task, completed=done, total=of)


@contextmanager
def stage_of_counts() -> Iterator[Callable[[str, int, int], None]]:
    """Show a bar while the block runs; it is told what is being done, how much is done, and of how much."""
    columns = TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn()
    with Progress(*columns, console=err, transient=True) as progress:
        task = progress.add_task("", total=None)
        yield lambda what, done, of: progress.update(task, description=what, completed=done, total=of)
