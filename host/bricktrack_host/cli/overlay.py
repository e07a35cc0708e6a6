"""``bricktrack overlay``: a run's video with everything found drawn on it."""

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from bricktrack_common.errors import ConfigError
from bricktrack_host.cli._console import err, out


def overlay(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A processed run.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="MP4 to write. \\[default: RUN_overlay.mp4, here]"),
    ] = None,
    results: Annotated[
        Path | None, typer.Option("--results", help="Results elsewhere. \\[default: RUN/results]")
    ] = None,
    slow: Annotated[
        float, typer.Option("--slow", min=0.1, max=1000, help="How many times slower than it was.")
    ] = 1.0,
    scale: Annotated[float, typer.Option("--scale", min=0.1, max=1.0, help="Of the picture's size.")] = 1.0,
    frames: Annotated[
        str | None, typer.Option("--frames", help="Only these, as 200:260.", show_default=False)
    ] = None,
) -> None:
    """Write a film of a run: LEDs found, residuals magnified, pose, flags, and the motion below.

    For example:

        bricktrack overlay runs/b2_9f31c2_0007_shake

        bricktrack overlay runs/b2_9f31c2_0007_shake --frames 200:260 --slow 20 -o impact.mp4
    """
    from bricktrack_host.results.result_store import results_of
    from bricktrack_host.viewing.overlay_video import write_overlay

    path = output or Path(f"{run.resolve().name}_overlay.mp4")
    if path.suffix.lower() != ".mp4":
        raise ConfigError(f"--output {path}: the film is an MP4; name it {path.stem}.mp4")
    columns = TextColumn("drawing"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=err, transient=True) as bar:
        task = bar.add_task("")
        n = write_overlay(
            run, results or results_of(run), path, slow=slow, scale=scale, frames=_range(frames),
            progress=lambda done, of: bar.update(task, completed=done, total=of),
        )  # fmt: skip
    out.print(f"{n} frames: {path}", markup=False, soft_wrap=True)


def _range(words: str | None) -> tuple[int, int] | None:
    if words is None:
        return None
    first, colon, stop = words.partition(":")
    if not colon or not first.isdigit() or not stop.isdigit():
        raise ConfigError(f"--frames {words!r}: expected first:after-last, as 200:260")
    return int(first), int(stop)
