"""The stages in order: read, decode and find the LEDs, solve the poses, align the clocks, fuse, write.

Each stage is a function of values in its own module, under `stages`. This one hands the values on, times the
stages, and refuses a run without poses.
"""

import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from bricktrack_common.brick_model import BrickModel, load_brick_model
from bricktrack_common.checksums import sha256_file
from bricktrack_common.errors import ConfigError, TrackingError
from bricktrack_common.run_folder import Run, read_run
from bricktrack_common.run_manifest import MANIFEST_NAME, TRUTH_NAME
from bricktrack_host.calibration.calibration_file import load_calibration, rays_of_recording
from bricktrack_host.quality import PoseFlag
from bricktrack_host.reporting.fusion_check import TwoFusions
from bricktrack_host.reporting.report import ReportExtras, render_report
from bricktrack_host.reporting.report_pictures import PICTURES_NAME, save_pictures
from bricktrack_host.results.result_store import (
    RESULTS_FOLDER,
    Provenance,
    RunResult,
    software_version,
    write_results,
)
from bricktrack_host.results.true_motion import read_true_motion
from bricktrack_host.results.truth import TruthComparison, compare_with_truth
from bricktrack_host.stages.clocks import align, choose_imu, fit_square_wave, rest_pose, unsure_stamps
from bricktrack_host.stages.details import alignment_details, calibration_details, calibration_picture
from bricktrack_host.stages.motion import fuse_run, output_grid, retime, with_unsure_times
from bricktrack_host.stages.pictures import FIND, RunPictures, observe_run, require_video
from bricktrack_host.stages.progress import ProcessProgress, Silent, Stages
from bricktrack_host.stages.settings import ProcessSettings
from bricktrack_host.tracking.centroid_noise import with_measured_noise
from bricktrack_host.tracking.finite import all_finite
from bricktrack_host.tracking.led_fit import with_profile_of_run
from bricktrack_host.tracking.odd_leds import with_odd_leds_doubted, words_on_odd_leds
from bricktrack_host.tracking.optical_track import solve_poses, start_poses
from bricktrack_host.tracks import OpticalTrack

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

REPORT_NAME = "report.html"


@dataclass(frozen=True, slots=True, eq=False)
class ProcessedRun:
    """What processing a run gave: values, the report's extras, and where it all is on disk.

    ``earlier`` is where the results of before are kept, if they said something else.
    """

    result: RunResult
    folder: Path
    report: Path
    truth: TruthComparison | None
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
    with stages(FIND, frames.n_frames):
        observations = pictures.observe(rays, brick, settings.segmentation, stages.progress)
    problems += pictures.problems()
    with stages("solve poses"):
        first = start_poses(observations, rays, brick, form=settings.prsoi_form)
        brick = with_profile_of_run(
            observations, first, rays, brick, rolling_shutter=settings.rolling_shutter
        )
        observations = with_odd_leds_doubted(
            observations, first, rays, brick, rolling_shutter=settings.rolling_shutter
        )
        problems += words_on_odd_leds(observations, brick)
        observations = with_measured_noise(
            observations, first, rays, brick, rolling_shutter=settings.rolling_shutter
        )
        optical = solve_poses(
            observations, rays, brick, rolling_shutter=settings.rolling_shutter, first=first
        )
    _require_poses(optical, run, brick)
    with stages("align clocks"):
        edge_fit = fit_square_wave(run, problems)
        imu = choose_imu(run, brick, settings, problems)
        inertial = None if imu is None else align(optical, imu, run, brick, edge_fit, settings, problems)
        time_sd_ns = unsure_stamps(observations.sensor_timestamp_ns, optical, inertial, problems)
        rest = rest_pose(optical, inertial, problems)
    with stages("fuse"):
        if settings.rolling_shutter:
            optical = retime(observations, first, optical, inertial, rays, brick)
            _require_poses(optical, run, brick)
        grid = output_grid(optical, inertial, edge_fit)
        seen = (observations, rays) if settings.rolling_shutter else None
        fused, fusion = fuse_run(optical, inertial, brick, grid, problems, seen=seen)
        optical, fused = with_unsure_times(optical, fused, time_sd_ns)
    result = RunResult(
        manifest=run.manifest,
        led_names=brick.led_names,
        observations=observations,
        optical=optical,
        fused=fused,
        edge_index=grid.edge_index,
        edge_fit=edge_fit,
        imu=imu,
        rest=rest,
        alignment=alignment_details(inertial, fusion, optical),
        calibration=calibration_details(calibrated),
        problems=tuple(problems),
        provenance=Provenance(
            manifest_sha256=sha256_file(folder / MANIFEST_NAME),
            calibration_sha256=sha256_file(calibration),
            layout_sha256=sha256_file(layout),
            software_version=software_version(),
            settings=settings.facts(),
        ),
        timings_s=stages.seconds,
    )
    results_folder = output or folder / RESULTS_FOLDER
    overlays, covered = pictures.overlays(observations, optical), calibration_picture(calibrated)

    def report() -> tuple[str, TruthComparison | None]:
        comparison, two = _compare(result, folder, truth), None
        if fusion is not None and fusion.pose_level is not None:
            two = TwoFusions(fusion.track, fusion.pose_level)
        extras = ReportExtras(overlays=overlays, calibration=covered, truth=comparison, fusions=two)
        return render_report(result, extras), comparison

    with stages("write report and tables"), ThreadPoolExecutor(1) as beside:
        # Tables are packed without the interpreter's lock, and wait for the disk: the page is made meanwhile.
        reported = beside.submit(report)

        def write_page(partial: Path) -> None:
            save_pictures(partial / PICTURES_NAME, overlays, covered)
            (partial / REPORT_NAME).write_text(reported.result()[0], encoding="utf-8")

        earlier = write_results(result, results_folder, also=write_page)
    comparison = reported.result()[1]
    logger.info("%s: processed in %.1f s", folder.name, sum(stages.seconds.values()))
    return ProcessedRun(result, results_folder, results_folder / REPORT_NAME, comparison, earlier)


def _require_poses(optical: OpticalTrack, run: Run, brick: BrickModel) -> None:
    """Refuse a run without a pose, or without one that five LEDs agree on: four fit many a wrong layout."""
    posed = all_finite(optical.t_camera_brick_mm)
    n = len(optical.t_ns)
    if not posed.any():
        raise TrackingError(
            f"{run.folder.name}: none of {n} frames gave a pose. Look at a picture: "
            f"are at least 5 of the {brick.n_leds} LEDs lit, sharp and inside it, and is this their layout?"
        )
    if (optical.flags[posed] & PoseFlag.UNVERIFIED != 0).all():
        raise TrackingError(
            f"{run.folder.name}: in none of {n} frames do five or more LEDs agree on a pose, and four "
            f"fit many a wrong layout: no pose is believed. Is this the layout of these LEDs?"
        )


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


def _compare(result: RunResult, folder: Path, truth: Path | None) -> TruthComparison | None:
    path = find_truth(folder, truth)
    return None if path is None else compare_with_truth(result, read_true_motion(path))
