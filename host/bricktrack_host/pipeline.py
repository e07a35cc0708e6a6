"""The stages in order: read, decode and find the LEDs, solve the poses, align the clocks, fuse, write.

Each stage is a function of values in its own module, under `stages`. This one hands the values on, and times
the stages.
"""

import logging
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from bricktrack_common.brick_model import load_brick_model
from bricktrack_common.errors import ConfigError
from bricktrack_common.run_folder import read_run
from bricktrack_common.run_manifest import TRUTH_NAME
from bricktrack_host.calibration.calibration_file import load_calibration, rays_of_recording
from bricktrack_host.results.result_store import REPORT_NAME, RESULTS_FOLDER, RunResult
from bricktrack_host.stages.pictures import FIND, RunPictures, observe_run, require_video
from bricktrack_host.stages.progress import ProcessProgress, Silent, Stages
from bricktrack_host.stages.settings import ProcessSettings

if TYPE_CHECKING:
    from bricktrack_host.results.truth import TruthComparison

__all__ = [
    "REPORT_NAME",
    "RESULTS_FOLDER",
    "ProcessProgress",
    "ProcessSettings",
    "ProcessedRun",
    "find_truth",
    "observe_run",
    "process_run",
]

logger = logging.getLogger(__name__)

_LONG_FRAMES = 900
"""Half a minute: of fewer frames no array is large, and to be ready for those takes a third of a second."""
LOADED_MEANWHILE = ("bricktrack_host.stages.solution", "bricktrack_host.stages.writing")


@dataclass(frozen=True, slots=True, eq=False)
class ProcessedRun:
    """What processing a run gave: values, the report's extras, and where it all is on disk.

    ``earlier`` is where the results of before are kept, if they said something else.
    """

    result: RunResult
    folder: Path
    report: Path
    truth: "TruthComparison | None"
    earlier: Path | None = None


def process_run(
    folder: Path,
    *,
    calibration: Path,
    layout: Path,
    output: Path | None = None,
    settings: ProcessSettings | None = None,
    truth: Path | None = None,
    progress: ProcessProgress | None = None,
) -> ProcessedRun:
    """Turn one run folder into poses, tables and a report.

    Parameters
    ----------
    folder : Path
        A run folder, as pulled or imported.
    calibration, layout : Path
        Of this unit's camera in this sensor mode, and of the brick that it looks at.
    output : Path, optional
        Folder of the results; ``<run folder>/results`` if not given. Earlier results that say something else
        are kept beside it, as ``<run folder>/results_1``.
    settings : ProcessSettings, optional
    truth : Path, optional
        True motion of a simulated run; its own ``truth.npz`` is found without being named.
    progress : ProcessProgress, optional

    Raises
    ------
    RunFormatError, VideoError, CalibrationError, ConfigError, TrackingError, StorageError
        If the run, its calibration or its layout cannot give poses; what is only missing in part becomes a
        line of the results' ``problems`` and flags of the samples instead.
    """
    settings = settings or ProcessSettings()
    stages = Stages(progress or Silent())
    with stages("read"):
        run = read_run(folder, verify_hashes=True)
        calibrated = load_calibration(calibration)
        brick = load_brick_model(layout)
        frames = require_video(run)
        rays = calibrated.ray_model
        if run.manifest.camera is not None:
            mode = run.manifest.camera.mode
            rays = rays_of_recording(calibrated, unit=run.manifest.unit, sensor_mode=mode)
    problems = list(run.problems)
    pictures = RunPictures(run, frames)
    results_folder = output or folder / RESULTS_FOLDER
    with _memory(results_folder, frames.n_frames):
        with stages(FIND, frames.n_frames):
            with ThreadPoolExecutor(1, "load") as beside:
                # What comes later takes a second to load, SciPy most of it: meanwhile pictures are decoded.
                beside.map(import_module, LOADED_MEANWHILE)
                lights = pictures.lights(rays, brick, settings.segmentation, stages.progress)
            from bricktrack_host.stages.solution import solve_run
            from bricktrack_host.stages.writing import write_run

            observations = pictures.observations(lights, rays, brick, settings.segmentation)
            del lights  # a third of a megabyte for each second recorded, which nobody needs any more
        problems += pictures.problems()
        result, fusions = solve_run(
            run, observations, calibration=calibrated, rays=rays, brick=brick, settings=settings,
            problems=problems, stages=stages, files=(calibration, layout),
        )  # fmt: skip
        with stages("write report and tables"):
            comparison, earlier = write_run(
                result, results_folder, overlays=pictures.overlays(result.observations, result.optical),
                calibration=calibrated, fusions=fusions, truth=find_truth(folder, truth),
            )  # fmt: skip
    logger.info("%s: processed in %.1f s", folder.name, sum(stages.seconds.values()))
    return ProcessedRun(result, results_folder, results_folder / REPORT_NAME, comparison, earlier)


def _memory(results: Path, n_frames: int) -> AbstractContextManager[None]:
    """Return what keeps the memory that a long recording takes from growing with its length."""
    if n_frames < _LONG_FRAMES:
        return nullcontext()
    from bricktrack_host.scratch_arrays import large_arrays_on_disk

    return large_arrays_on_disk(next(folder for folder in results.absolute().parents if folder.is_dir()))


def find_truth(folder: Path, truth: Path | None) -> Path | None:
    """Return the file of true motion: the one named, the densest in the folder named, or the run's own.

    Raises
    ------
    ConfigError
        If a path was named and holds none.
    """
    if truth is None:
        own = folder / TRUTH_NAME
        return own if own.is_file() else None
    if truth.is_file():
        return truth
    for name in (TRUTH_NAME, "motion_dense.csv", "motion_poses.csv", "static_poses.csv"):
        if (truth / name).is_file():
            return truth / name
    raise ConfigError(f"{truth}: no file of true motion; expected {TRUTH_NAME} or a truth CSV of a sample")
