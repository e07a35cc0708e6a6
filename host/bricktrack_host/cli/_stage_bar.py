"""The bar of a run being processed: which stage is under way, and how far it is."""

from collections.abc import Iterator
from contextlib import contextmanager

from rich.progress import BarColumn, MofNCompleteColumn, Progress, Task, TaskID, TextColumn, TimeElapsedColumn
from rich.text import Text

from bricktrack_host.cli._console import err


class StageBar:
    """One bar that shows the stage under way and how far it is."""

    def __init__(self, progress: Progress, run_id: str) -> None:
        self._progress = progress
        self._run_id = run_id
        self._task: TaskID = progress.add_task(f"{run_id}: waits for a worker", total=None)

    def stage(self, name: str, total: int | None) -> None:
        """Show that a stage begins."""
        self._progress.reset(self._task, total=total, description=f"{self._run_id}: {name}")
        if total is None:  # which to rich means: the total of the stage before
            [task] = (t for t in self._progress.tasks if t.id == self._task)
            task.total = None

    def advance_to(self, done: int) -> None:
        """Show that so many steps of it are done."""
        self._progress.update(self._task, completed=done)

    def remove(self) -> None:
        """Show nothing any more."""
        self._progress.remove_task(self._task)


class _Count(MofNCompleteColumn):
    """How many steps of how many; nothing where nobody counts."""

    def render(self, task: Task) -> Text:
        return Text() if task.total is None else super().render(task)


def stage_bars() -> Progress:
    """Return bars for several runs side by side, shown while they are entered."""
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        _Count(),
        TimeElapsedColumn(),
    )
    return Progress(*columns, console=err, transient=True)


@contextmanager
def stage_bar(run_id: str) -> Iterator[StageBar]:
    """Show the progress of one run on the terminal while the block runs."""
    with stage_bars() as progress:
        yield StageBar(progress, run_id)
