"""One run to be processed: what it needs, whether that was done already, and what came of it in words."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from bricktrack_common.errors import RunFormatError
from bricktrack_common.run_manifest import MANIFEST_NAME, read_manifest
from bricktrack_host.durable_files import require_writable
from bricktrack_host.many_runs.one_at_a_time import alone_with
from bricktrack_host.many_runs.processing_record import (
    ProcessingRecord,
    Stopwatch,
    Took,
    input_sha256,
    read_record,
    write_record,
)
from bricktrack_host.many_runs.workers import RunProgress
from bricktrack_host.pipeline import ProcessedRun, ProcessSettings, find_truth, process_run
from bricktrack_host.results.result_store import RESULTS_FOLDER, SUMMARY_NAME
from bricktrack_host.results.run_summary import key_figures, verdict

if TYPE_CHECKING:
    from bricktrack_host.results.truth import TruthComparison


@dataclass(frozen=True, slots=True)
class RunJob:
    """A run, what belongs to its unit, and how to process it; see `pipeline.process_run`."""

    run: Path
    calibration: Path
    layout: Path
    settings: ProcessSettings
    output: Path | None = None
    truth: Path | None = None

    @property
    def results(self) -> Path:
        """Return the folder that the results are for."""
        return self.output or self.run / RESULTS_FOLDER

    def truth_file(self) -> Path | None:
        """Return the file of true motion that this run is compared with, if there is one.

        Raises
        ------
        ConfigError
            If one was named and is not there.
        """
        return find_truth(self.run, self.truth)

    def recorded_s(self) -> float:
        """Return how long the recording is by its manifest; 0 where that does not tell."""
        try:
            manifest = read_manifest(self.run / MANIFEST_NAME)
        except RunFormatError:  # said of this run alone, when it is read in earnest
            return 0.0
        if manifest.camera is None:
            return 0.0
        return manifest.quality.frames * manifest.camera.frame_duration_us * 1e-6

    def input_sha256(self) -> str:
        """Return a hash of everything that the results depend on; see `processing_record.input_sha256`."""
        files = {"calibration": self.calibration, "layout": self.layout, "truth": self.truth_file()}
        return input_sha256(self.run, files, self.settings)


@dataclass(frozen=True, slots=True, eq=False)
class RunSummary:
    """What processing a run came to, in words and figures small enough to be sent.

    Attributes
    ----------
    verdict : str
    problems : tuple of str
    truth : TruthComparison or None
        Without its series.
    n_frames : int
    timings_s : dict
        Wall time of each stage.
    folder, report : Path
        Of the results.
    earlier : Path or None
        Where results that said something else are kept.
    took : Took or None
    """

    run_id: str
    verdict: str
    problems: tuple[str, ...]
    truth: "TruthComparison | None"
    n_frames: int
    timings_s: dict[str, float]
    folder: Path
    report: Path
    earlier: Path | None = None
    took: Took | None = None


def summarise(processed: ProcessedRun) -> RunSummary:
    """Return what a processed run came to."""
    result = processed.result
    words, problems = verdict(result, key_figures(result))
    return RunSummary(
        run_id=result.manifest.run_id,
        verdict=words,
        problems=tuple(problems),
        truth=None if processed.truth is None else replace(processed.truth, series={}),
        n_frames=len(result.optical.t_ns),
        timings_s=dict(result.timings_s),
        folder=processed.folder,
        report=processed.report,
        earlier=processed.earlier,
    )


def process_job(job: RunJob, input_sha256: str, progress: RunProgress) -> RunSummary:
    """Process a run into its results folder, and note there of what the results were made.

    Raises
    ------
    ConfigError
        If another command is at it.
    StorageError
        If the results folder cannot be written: at once.
    BricktrackError
        As `pipeline.process_run`.
    """
    watch = Stopwatch()
    require_writable(job.results, "Results go there; name another folder with -o")
    with alone_with(job.run):
        processed = process_run(
            job.run, calibration=job.calibration, layout=job.layout, output=job.output, settings=job.settings,
            truth=job.truth, progress=progress,
        )  # fmt: skip
        took = watch.read()
        write_record(processed.folder, ProcessingRecord(input_sha256=input_sha256, took=took))
    return replace(summarise(processed), took=took)


def is_processed(job: RunJob, input_sha256: str) -> bool:
    """Tell whether a run's results are there, and were made of just this input."""
    record = read_record(job.results)
    return (
        record is not None and record.input_sha256 == input_sha256 and (job.results / SUMMARY_NAME).is_file()
    )
