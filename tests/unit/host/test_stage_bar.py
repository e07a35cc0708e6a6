"""The bar of a run being processed, as a terminal shows it."""

import io

from rich.console import Console

from bricktrack_host.cli._stage_bar import StageBar, stage_bars


def shown(progress) -> str:
    console = Console(file=io.StringIO(), width=120)
    console.print(progress.get_renderable())
    return console.file.getvalue()


def test_a_stage_that_nobody_counts_does_not_keep_the_count_of_the_one_before():
    progress = stage_bars()
    bar = StageBar(progress, "run-1")
    assert "waits for a worker" in shown(progress)
    assert "/" not in shown(progress)
    bar.stage("decode and find LEDs", 48)
    bar.advance_to(12)
    assert "12/48" in shown(progress)
    bar.stage("align clocks", None)
    assert "run-1: align clocks" in shown(progress)
    assert "/" not in shown(progress)
    bar.stage("fuse", 3)
    assert "0/3" in shown(progress)
