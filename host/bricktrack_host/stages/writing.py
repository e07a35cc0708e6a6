"""The stage of writing: the tables and, beside them, the page."""

from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from pathlib import Path

from bricktrack_host.calibration.calibration_file import Calibration
from bricktrack_host.reporting.fusion_check import TwoFusions
from bricktrack_host.reporting.plots import FrameOverlay
from bricktrack_host.reporting.report import ReportExtras, render_report
from bricktrack_host.reporting.report_pictures import PICTURES_NAME, save_pictures
from bricktrack_host.results.result_store import REPORT_NAME, RunResult, write_results
from bricktrack_host.results.true_motion import read_true_motion
from bricktrack_host.results.truth import TruthComparison, compare_with_truth
from bricktrack_host.stages.details import calibration_picture


def write_run(
    result: RunResult,
    folder: Path,
    *,
    overlays: list[FrameOverlay],
    calibration: Calibration,
    fusions: TwoFusions | None,
    truth: Path | None,
) -> tuple[TruthComparison | None, Path | None]:
    """Write a run's tables and page into a folder; ``truth`` is the file of true motion, if there is one.

    Returns
    -------
    comparison : TruthComparison or None
        With the true motion.
    earlier : Path or None
        Where results of before that say something else are kept.

    Raises
    ------
    StorageError
        If they cannot be written.
    RunFormatError
        If the file of true motion cannot be read.
    """
    covered = calibration_picture(calibration)

    def report() -> tuple[str, TruthComparison | None]:
        comparison = None if truth is None else compare_with_truth(result, read_true_motion(truth))
        extras = ReportExtras(overlays=overlays, calibration=covered, truth=comparison, fusions=fusions)
        return render_report(result, extras), comparison

    with ThreadPoolExecutor(1) as beside:
        # Tables are packed without the interpreter's lock, and wait for the disk: the page is made meanwhile.
        reported = beside.submit(copy_context().run, report)  # whose large arrays lie where others do

        def write_page(partial: Path) -> None:
            save_pictures(partial / PICTURES_NAME, overlays, covered)
            (partial / REPORT_NAME).write_text(reported.result()[0], encoding="utf-8")

        earlier = write_results(result, folder, also=write_page)
    return reported.result()[1], earlier
