"""The stages in order: read, decode and find the LEDs, solve the poses, align the clocks, fuse, write.

Each stage is a function of values in its own module. This one hands the values on, times the stages, and puts
what is missing into words where something can still be had.
"""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

import msgspec
import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel, load_brick_model
from bricktrack_common.camera_model import RayModel
from bricktrack_common.checksums import sha256_file
from bricktrack_common.errors import ConfigError, ShapeError, TrackingError, VideoError
from bricktrack_common.frame_times import FrameTimes
from bricktrack_common.imu_records import STANDARD_GRAVITY_MPS2, ImuDescription, ImuSamples
from bricktrack_common.run_folder import Run, read_run
from bricktrack_common.run_manifest import MANIFEST_NAME, TRUTH_NAME
from bricktrack_host.calibration.calibration_file import (
    Calibration,
    CentralRaysRecord,
    load_calibration,
    require_match,
)
from bricktrack_host.fusion.estimate import FusionResult, fuse
from bricktrack_host.fusion.moving_camera import NOT_OBSERVABLE
from bricktrack_host.fusion.optical_smoothing import smooth_optical
from bricktrack_host.fusion.tight import fuse_tight
from bricktrack_host.fusion.time_alignment import TimeAlignment, align_times
from bricktrack_host.quality import PoseFlag
from bricktrack_host.recordings.video_frames import decode_run_video
from bricktrack_host.reporting.plots import CalibrationPicture, FrameOverlay
from bricktrack_host.reporting.report import ReportExtras, render_report
from bricktrack_host.reporting.report_pictures import PICTURES_NAME, save_pictures
from bricktrack_host.results.daq_clock import EdgeFit, EdgeFitError, fit_edges
from bricktrack_host.results.rest_pose import RestPose, tare
from bricktrack_host.results.result_store import (
    Details,
    Provenance,
    RunResult,
    software_version,
    write_results,
)
from bricktrack_host.results.result_tables import FusedKind
from bricktrack_host.results.true_motion import read_true_motion
from bricktrack_host.results.truth import TruthComparison, compare_with_truth
from bricktrack_host.tracking.finite import all_finite
from bricktrack_host.tracking.first_poses import FirstPoses
from bricktrack_host.tracking.optical_track import (
    SegmentMethod,
    led_motion,
    observe_leds,
    solve_poses,
    start_poses,
)
from bricktrack_host.tracking.segment import Picture, Plane
from bricktrack_host.tracks import FusedTrack, ImuTrack, LedObservations, OpticalTrack
from bricktrack_host.transfer.fleet_config import CameraMount

logger = logging.getLogger(__name__)

RESULTS_FOLDER = "results"
REPORT_NAME = "report.html"
_FIND = "decode and find LEDs"
_N_OVERLAYS = 4
_RETIME_PASSES = 1


class ProcessSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What can be chosen about the processing of a run; stored with its results.

    Attributes
    ----------
    segmentation : "default" or "paper"
        Grey-weighted sub-pixel centroids, or the paper's thresholds, plain means and rules of identity.
    prsoi_form : "safe" or "printed"
        The form that is defined for every layout, or the paper's equations 6 and 20 as printed.
    rolling_shutter : bool
        Whether each LED is taken at the time of its own row.
    imu : str or None
        Name of the inertial sensor on the LED component; `None`: the run's first.
    use_imu : bool
        False: smooth the optical poses alone.
    camera : "static", "imu" or "table"
        What the camera moves with. Unless it is static the poses are smoothed alone: one sensor on the LED
        component cannot tell the camera's acceleration from the brick's.
    max_clock_offset_s : float
        How far apart the stamps of camera and IMU may be: recordings made elsewhere have clocks of their own.
    """

    segmentation: Literal["default", "paper"] = "default"
    prsoi_form: Literal["safe", "printed"] = "safe"
    rolling_shutter: bool = True
    imu: str | None = None
    use_imu: bool = True
    camera: CameraMount = "static"
    max_clock_offset_s: float = 0.25


class ProcessProgress(Protocol):
    """Hears how far the processing of one run is."""

    def stage(self, name: str, total: int | None) -> None:
        """Hear that a stage begins; ``total`` steps are expected, if that is known."""
        ...

    def advance_to(self, done: int) -> None:
        """Hear that so many steps of the stage are done."""
        ...


class _Silent:
    def stage(self, name: str, total: int | None) -> None: ...

    def advance_to(self, done: int) -> None: ...


@dataclass(frozen=True, slots=True, eq=False)
class ProcessedRun:
    """What processing a run gave: values, the report's extras, and where it all is on disk."""

    result: RunResult
    folder: Path
    report: Path
    truth: TruthComparison | None


@dataclass(slots=True)
class _Stages:
    progress: ProcessProgress
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, name: str, total: int | None = None) -> Iterator[None]:
        self.progress.stage(name, total)
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = time.perf_counter() - start


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
        Folder of the results; ``<run folder>/results`` if not given.
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
    stages = _Stages(progress or _Silent())
    with stages("read"):
        run = read_run(folder, verify_hashes=True)
        rays = load_calibration(calibration)
        brick = load_brick_model(layout)
        frames = _require_video(run)
        if run.manifest.camera is not None:
            require_match(rays, unit=run.manifest.unit, sensor_mode=run.manifest.camera.mode)
    problems = list(run.problems)
    pictures = _Pictures(run, frames)
    with stages(_FIND, frames.n_frames):
        observations = pictures.observe(rays.ray_model, brick, settings.segmentation, stages.progress)
    problems += pictures.problems()
    with stages("solve poses"):
        first = start_poses(observations, rays.ray_model, brick, form=settings.prsoi_form)
        optical = solve_poses(
            observations, rays.ray_model, brick, rolling_shutter=settings.rolling_shutter, first=first
        )
    _require_poses(optical, run, brick)
    with stages("align clocks"):
        edge_fit = _fit_square_wave(run, problems)
        imu = _choose_imu(run, brick, settings, problems)
        alignment = None if imu is None else _align(optical, imu, run, settings, problems)
        rest = _rest_pose(optical, imu, alignment, problems)
    with stages("fuse"):
        if settings.rolling_shutter:
            optical = _retime(observations, first, optical, imu, alignment, rays.ray_model, brick)
            _require_poses(optical, run, brick)
        grid = _output_grid(optical, imu, alignment, edge_fit)
        seen = (observations, rays.ray_model) if settings.rolling_shutter else None
        fused, fusion = _fuse(optical, imu, alignment, brick, grid, problems, seen=seen)
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
        alignment=_alignment_details(alignment, fusion),
        calibration=_calibration_details(rays),
        problems=tuple(problems),
        provenance=Provenance(
            manifest_sha256=sha256_file(folder / MANIFEST_NAME),
            calibration_sha256=sha256_file(calibration),
            layout_sha256=sha256_file(layout),
            software_version=software_version(),
            settings=msgspec.to_builtins(settings),
        ),
        timings_s=stages.seconds,
    )
    results_folder = output or folder / RESULTS_FOLDER
    with stages("write report"):
        comparison = _compare(result, folder, truth)
        overlays, covered = pictures.overlays(observations, optical), _calibration_picture(rays)
        page = render_report(result, ReportExtras(overlays=overlays, calibration=covered, truth=comparison))
    with stages("write tables"):

        def write_page(partial: Path) -> None:
            save_pictures(partial / PICTURES_NAME, overlays, covered)
            (partial / REPORT_NAME).write_text(page, encoding="utf-8")

        write_results(result, results_folder, also=write_page)
    logger.info("%s: processed in %.1f s", folder.name, sum(stages.seconds.values()))
    return ProcessedRun(result, results_folder, results_folder / REPORT_NAME, comparison)


def observe_run(
    run: Run, rays: RayModel, brick: BrickModel, *, progress: ProcessProgress | None = None
) -> tuple[LedObservations, list[str]]:
    """Return the LEDs seen in a run, and what was wrong with its video, in words.

    Raises
    ------
    VideoError
        If the run has no video with frame times.
    """
    frames = _require_video(run)
    pictures = _Pictures(run, frames)
    progress = progress or _Silent()
    progress.stage(_FIND, frames.n_frames)
    observations = pictures.observe(rays, brick, "default", progress)
    return observations, [*run.problems, *pictures.problems()]


def _require_video(run: Run) -> FrameTimes:
    if run.video is None or run.frames is None or run.manifest.camera is None:
        raise VideoError(f"{run.folder}: the run has no video with frame times; there is nothing to track")
    if run.frames.n_frames == 0:
        raise VideoError(f"{run.folder}: the run holds no frames")
    return run.frames


class _Pictures:
    """The pictures of a run on their way to the tracker: counts the lost ones, keeps a few for the report."""

    def __init__(self, run: Run, frames: FrameTimes) -> None:
        if run.video is None:
            raise VideoError(f"{run.folder}: the run has no video")
        self._video = run.video
        self._frames = frames
        self._keep = set(np.linspace(0, frames.n_frames - 1, _N_OVERLAYS).round().astype(int).tolist())
        self._kept: dict[int, Plane] = {}
        self._lost: dict[str, list[int]] = {}

    def stream(self) -> Iterator[tuple[int, Picture]]:
        for frame in decode_run_video(self._video, self._frames):
            if frame.picture is None:
                self._lost.setdefault(frame.lost_because, []).append(frame.index)
                continue
            if frame.index in self._keep:
                self._kept[frame.index] = frame.picture.luma.copy()
            yield frame.index, frame.picture

    def observe(
        self, rays: RayModel, brick: BrickModel, method: SegmentMethod, progress: ProcessProgress
    ) -> LedObservations:
        return observe_leds(
            self.stream(),
            rays,
            brick,
            sensor_timestamp_ns=self._frames.sensor_timestamp_ns,
            exposure_ns=self._frames.exposure_us * 1000,
            method=method,
            progress=progress.advance_to,
        )

    def problems(self) -> list[str]:
        return [
            f"{len(frames)} frame{'s' if len(frames) > 1 else ''} lost (first: {frames[0]}): {reason}"
            for reason, frames in self._lost.items()
        ]

    def overlays(self, observations: LedObservations, optical: OpticalTrack) -> list[FrameOverlay]:
        """Return the kept frames with the LEDs as seen and as the pose predicts them."""
        out = []
        for i, luma in self._kept.items():
            predicted = observations.uv_px[i] - optical.residual_px[i]
            seconds = (optical.t_ns[i] - optical.t_ns[0]) / 1e9
            out.append(FrameOverlay(f"frame {i}, {seconds:.2f} s", luma, observations.uv_px[i], predicted))
        return out


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


def _fit_square_wave(run: Run, problems: list[str]) -> EdgeFit | None:
    try:
        fit = fit_edges(run.edges_ns, run.manifest.trigger.nominal_hz)
    except EdgeFitError as e:
        problems.append(f"square wave: {e}; results are not on the laboratory's samples")
        return None
    problems.extend(f"square wave: {p}" for p in fit.problems())
    return fit


def _choose_imu(
    run: Run, brick: BrickModel, settings: ProcessSettings, problems: list[str]
) -> ImuTrack | None:
    """Return the samples of the sensor on the LED component in brick axes, or `None` and why."""
    if not settings.use_imu:
        return None
    if settings.camera != "static":
        problems.append(
            f"the camera moves (camera = {settings.camera!r}): optical poses alone. {NOT_OBSERVABLE}"
        )
        return None
    if settings.imu is not None and settings.imu not in run.imus:
        raise ConfigError(f"the run has no IMU '{settings.imu}'; it has: {', '.join(run.imus) or 'none'}")
    if not run.imus:
        problems.append("no inertial samples: the motion is smoothed from the optical poses alone")
        return None
    if brick.R_brick_imu is None:
        problems.append(
            "the layout file has no [imu], so the inertial samples cannot be used; optical poses alone"
        )
        return None
    description, samples = run.imus[settings.imu or next(iter(run.imus))]
    return imu_in_brick_axes(description, samples, brick.R_brick_imu)


def imu_in_brick_axes(description: ImuDescription, samples: ImuSamples, R_brick_imu: FloatArray) -> ImuTrack:
    """Return inertial samples turned from the sensor's axes to the brick's."""
    return ImuTrack(
        t_ns=samples.t_ns,
        acc_mps2=samples.acc_mps2 @ R_brick_imu.T,
        gyro_radps=samples.gyro_radps @ R_brick_imu.T,
        flags=samples.flags,
        acc_range_mps2=description.acc_range_g * STANDARD_GRAVITY_MPS2,
    )


def _align(
    optical: OpticalTrack, imu: ImuTrack, run: Run, settings: ProcessSettings, problems: list[str]
) -> TimeAlignment | None:
    # The daemon's stamps are of one clock and promise milliseconds; recordings from elsewhere nothing.
    prior_sd_ns = 5e6 if run.manifest.origin == "bricktrackd" else settings.max_clock_offset_s * 1e9
    try:
        alignment = align_times(
            optical, imu, max_offset_s=settings.max_clock_offset_s, prior_sd_ns=prior_sd_ns
        )
    except ShapeError as e:
        problems.append(f"the inertial samples cannot be used: {e}")
        return None
    if alignment.reason:
        problems.append(f"time alignment of camera and IMU: {alignment.reason}")
    return alignment


def _rest_pose(
    optical: OpticalTrack, imu: ImuTrack | None, alignment: TimeAlignment | None, problems: list[str]
) -> RestPose | None:
    offset_ns = 0 if alignment is None else round(alignment.offset_ns)
    try:
        return tare(optical, imu if alignment is not None else None, imu_minus_camera_ns=offset_ns)
    except TrackingError as e:
        problems.append(f"no rest pose, so no displacements from rest: {e}")
        return None


@dataclass(frozen=True, slots=True, eq=False)
class _Grid:
    """The instants at which the motion is wanted, camera time, by kind."""

    t_ns: dict[FusedKind, IntArray]
    edge_index: IntArray


def _output_grid(
    optical: OpticalTrack, imu: ImuTrack | None, alignment: TimeAlignment | None, edge_fit: EdgeFit | None
) -> _Grid:
    """Return every IMU slot, frame and sample of the square wave from the first frame to the last."""
    first, last = int(optical.t_ns[0]), int(optical.t_ns[-1])
    t_ns: dict[FusedKind, IntArray] = {}
    if imu is not None and alignment is not None:
        # The stamps are IMU time; the offset's own change over it (skew x offset) is below a nanosecond.
        shift_ns = alignment.imu_time_ns(imu.t_ns) - imu.t_ns
        slots = imu.t_ns - shift_ns
        t_ns["imu"] = slots[(slots >= first) & (slots <= last)]
    t_ns["frame"] = optical.t_ns
    index = np.empty(0, dtype=np.int64)
    if edge_fit is not None:
        index = np.arange(edge_fit.last_index + 1)
        edges = edge_fit.time_of_index(index)
        inside = (edges >= first) & (edges <= last)
        index = index[inside]
        t_ns["edge"] = edges[inside]
    return _Grid(t_ns, index)


def _retime(
    observations: LedObservations,
    first: FirstPoses,
    optical: OpticalTrack,
    imu: ImuTrack | None,
    alignment: TimeAlignment | None,
    rays: RayModel,
    brick: BrickModel,
) -> OpticalTrack:
    """Solve the poses again with each LED carried to its frame's instant by the fused motion.

    Splines through 30 frames a second cannot follow a motion above 15 Hz, and read-out takes 20 ms: the IMU
    knows what the brick did meanwhile.
    """
    if imu is None or alignment is None or brick.imu_lever_arm_mm is None:
        return optical
    n = len(optical.t_ns)
    for _ in range(_RETIME_PASSES):
        wanted = np.concatenate([optical.t_ns, optical.led_t_ns.ravel()])
        try:
            track = fuse(
                optical, imu, lever_arm_mm=brick.imu_lever_arm_mm, output_t_ns=wanted, alignment=alignment
            ).track
        except (ShapeError, TrackingError):
            return optical  # the fusion itself will say why
        motion = led_motion(_rows(track, slice(0, n)), _rows(track, slice(n, None)))
        optical = solve_poses(observations, rays, brick, motion=motion, first=first)
        if not np.isfinite(optical.t_camera_brick_mm).any():
            break
    return optical


def _fuse(
    optical: OpticalTrack,
    imu: ImuTrack | None,
    alignment: TimeAlignment | None,
    brick: BrickModel,
    grid: _Grid,
    problems: list[str],
    *,
    seen: tuple[LedObservations, RayModel] | None,
) -> tuple[dict[FusedKind, FusedTrack], FusionResult | None]:
    """Return the motion at the instants wanted: LED by LED where ``seen`` is given, else pose by pose."""
    wanted = np.concatenate(list(grid.t_ns.values()))
    fusion = None
    if imu is not None and alignment is not None and brick.imu_lever_arm_mm is not None:
        try:
            if seen is None:
                fusion = fuse(
                    optical, imu, lever_arm_mm=brick.imu_lever_arm_mm, output_t_ns=wanted, alignment=alignment
                )
            else:
                lever_arm_mm = brick.imu_lever_arm_mm
                fusion = _fuse_tight(
                    optical, imu, alignment, brick, seen, wanted, problems, lever_arm_mm=lever_arm_mm
                )
        except (ShapeError, TrackingError) as e:
            problems.append(f"fusion was not possible, optical poses alone: {e}")
    if fusion is not None:
        track = fusion.track
        n_rejected = int(np.count_nonzero(fusion.frame_rejected))
        if n_rejected:
            problems.append(
                f"{n_rejected} optical poses disagree with the IMU and their neighbours and were left out"
            )
    else:
        track = smooth_optical(optical, wanted)
    ends = np.cumsum([len(t) for t in grid.t_ns.values()])
    parts = {
        kind: _rows(track, slice(end - len(t), end))
        for (kind, t), end in zip(grid.t_ns.items(), ends.tolist(), strict=True)
    }
    return parts, fusion


def _fuse_tight(
    optical: OpticalTrack,
    imu: ImuTrack,
    alignment: TimeAlignment,
    brick: BrickModel,
    seen: tuple[LedObservations, RayModel],
    wanted: IntArray,
    problems: list[str],
    *,
    lever_arm_mm: FloatArray,
) -> FusionResult:
    observations, rays = seen
    tight = fuse_tight(
        observations, optical, imu, rays, brick,
        lever_arm_mm=lever_arm_mm, output_t_ns=wanted, alignment=alignment,
    )  # fmt: skip
    n_rejected = int(np.count_nonzero(tight.led_rejected))
    if n_rejected:
        problems.append(f"{n_rejected} LED centroids disagree with all the others and were left out")
    if not tight.check.agrees:
        problems.append(
            f"fusion LED by LED and pose by pose are up to {tight.check.max_mm:.2f} mm apart, in "
            f"{100 * tight.check.share_apart:.0f} % of the instants by more than their uncertainty allows"
        )
    return tight.fused


def _rows(track: FusedTrack, rows: slice) -> FusedTrack:
    return FusedTrack(
        t_ns=track.t_ns[rows],
        R_camera_brick=track.R_camera_brick[rows],
        t_camera_brick_mm=track.t_camera_brick_mm[rows],
        omega_brick_radps=track.omega_brick_radps[rows],
        v_camera_mmps=track.v_camera_mmps[rows],
        covariance=track.covariance[rows],
        flags=track.flags[rows],
    )


def _alignment_details(alignment: TimeAlignment | None, fusion: FusionResult | None) -> Details:
    if alignment is None:
        return {"method": "none: no inertial samples were used"}
    details: Details = {
        "method": "motion" if alignment.source == "data" else "stamps",
        "offset_ms": alignment.offset_ns / 1e6,
        "offset_sd_ms": alignment.offset_sd_ns / 1e6,
        "skew_ppm": alignment.skew * 1e6,
        "skew_sd_ppm": alignment.skew_sd * 1e6,
        "correlation": alignment.correlation,
        "trusted": alignment.is_trusted,
    }
    if fusion is not None:
        details |= {
            "smoothed_offset_ms": fusion.offset_ns / 1e6,
            "smoothed_offset_sd_ms": fusion.offset_sd_ns / 1e6,
            "smoothed_skew_ppm": fusion.skew * 1e6,
            "acc_lag_ms": fusion.acc_lag_ns / 1e6,
            "gyro_bias_dps": np.rad2deg(fusion.gyro_bias_radps).tolist(),
            "acc_bias_mps2": fusion.acc_bias_mps2.tolist(),
            "gravity_camera_mps2": fusion.gravity_camera_mps2.tolist(),
            "mean_nis": fusion.mean_nis,
        }
    return {k: v.item() if isinstance(v, np.generic) else v for k, v in details.items()}


def _calibration_details(calibration: Calibration) -> Details:
    return {
        "method": calibration.method,
        "camera": calibration.unit,
        "date": calibration.created_utc.isoformat(timespec="seconds"),
        "sensor_mode": calibration.sensor_mode.name,
        "simulated": calibration.simulated,
    }


def _calibration_picture(calibration: Calibration) -> CalibrationPicture:
    mode, rays = calibration.sensor_mode, calibration.rays
    if isinstance(rays, CentralRaysRecord):
        outlines = [rays.covered_px]
    else:
        outlines = [rays.covered_a_px, rays.covered_b_px]
    return CalibrationPicture(
        width_px=mode.width,
        height_px=mode.height,
        covered_uv_px=[np.array(outline) for outline in outlines],
        dots_uv_px=np.empty((0, 2)),
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
