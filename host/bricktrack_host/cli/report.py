"""``bricktrack report``: the pages of a processed run or a combined test, written again."""

from pathlib import Path
from typing import Annotated

import typer

from bricktrack_common.errors import ConfigError
from bricktrack_host.cli._console import err, out
from bricktrack_host.cli._processed import TruthOption, say_truth


def report(
    source: Annotated[
        Path, typer.Argument(metavar="RUN|TEST", help="A processed run, its results, or a combined test.")
    ],
    interactive: Annotated[
        bool,
        typer.Option(
            "--interactive", "-i", help="Write the page to zoom and point in, in place of the static one."
        ),
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="The page to write. \\[default: report.html or interactive.html there]"
        ),
    ] = None,
    truth: TruthOption = None,
) -> None:
    """Write the report of a processed run or a combined test again, and print what it amounts to.

    The interactive page is one file too and needs no network: plots to zoom, pan and point at.

    For example:

        bricktrack report runs/b2_9f31c2_0007_shake

        bricktrack report runs/b2_9f31c2_0007_shake --interactive

        bricktrack report tests/shake-12 --interactive

        bricktrack report runs/sample_motion --truth tests/data/path-traced/truth
    """
    from bricktrack_host.assemblies.combined_summary import TEST_SUMMARY_NAME

    if (source / TEST_SUMMARY_NAME).is_file():
        if truth is not None:
            raise ConfigError(f"{source} is a test; --truth is for runs")
        page = _report_test(source, output, interactive=interactive)
    elif interactive:
        page = _interactive_run(source, output)
    else:
        page = _report_run(source, output, truth)
    out.print(f"report: {page}", markup=False, soft_wrap=True)


def _report_test(folder: Path, output: Path | None, *, interactive: bool) -> Path:
    from bricktrack_host.assemblies.combined_summary import read_test
    from bricktrack_host.cli.combine import say_test
    from bricktrack_host.reporting.combined_report import write_combined_report

    if interactive:
        from bricktrack_host.reporting.combined_interactive import write_interactive_test

        with err.status("drawing"):
            page = write_interactive_test(folder, output)
    else:
        page = write_combined_report(folder, output)
    say_test(read_test(folder))
    return page


def _interactive_run(run: Path, output: Path | None) -> Path:
    from bricktrack_host.reporting.interactive_report import INTERACTIVE_NAME, write_interactive_report
    from bricktrack_host.results.result_store import read_result, results_of
    from bricktrack_host.results.run_summary import key_figures, verdict

    folder = results_of(run)
    page = output or folder / INTERACTIVE_NAME
    with err.status("drawing"):
        result = read_result(folder)
        write_interactive_report(result, page)
    _say_verdict(result.manifest.run_id, *verdict(result, key_figures(result)))
    return page


def _report_run(run: Path, output: Path | None, truth: Path | None) -> Path:
    from bricktrack_host.pipeline import REPORT_NAME, find_truth
    from bricktrack_host.reporting.report import ReportExtras, write_report
    from bricktrack_host.reporting.report_pictures import PICTURES_NAME, load_pictures
    from bricktrack_host.results.result_store import read_result, results_of
    from bricktrack_host.results.run_summary import key_figures, verdict
    from bricktrack_host.results.true_motion import read_true_motion
    from bricktrack_host.results.truth import compare_with_truth

    folder = results_of(run)
    result = read_result(folder)
    path = find_truth(run, truth)
    comparison = None if path is None else compare_with_truth(result, read_true_motion(path))
    page = output or folder / REPORT_NAME
    overlays, covered = load_pictures(folder / PICTURES_NAME)
    write_report(result, page, ReportExtras(overlays=overlays, calibration=covered, truth=comparison))
    _say_verdict(result.manifest.run_id, *verdict(result, key_figures(result)))
    say_truth(comparison)
    return page


def _say_verdict(run_id: str, line: str, problems: list[str]) -> None:
    out.print(f"{run_id}: {line}", markup=False, soft_wrap=True)
    for problem in problems:
        out.print(f"  {problem}", style="yellow", markup=False, soft_wrap=True)
