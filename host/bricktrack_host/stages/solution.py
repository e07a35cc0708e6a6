"""From the LEDs seen to all that the results hold: poses, clocks, motion."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.checksums import sha256_file
from bricktrack_common.errors import TrackingError
from bricktrack_common.poses import Pose
from bricktrack_common.run_folder import Run
from bricktrack_common.run_manifest import MANIFEST_NAME
from bricktrack_host.calibration.calibration_file import Calibration
from bricktrack_host.quality import PoseFlag
from bricktrack_host.reporting.fusion_check import TwoFusions
from bricktrack_host.results.ray_errors import ray_errors
from bricktrack_host.results.rest_pose import RestPose, rest_of_fused
from bricktrack_host.results.result_store import Provenance, RunResult, software_version
from bricktrack_host.stages.clocks import (
    align,
    choose_imu,
    fit_square_wave,
    rest_pose,
    unsure_stamps,
    with_stamps_mended,
)
from bricktrack_host.stages.details import alignment_details, calibration_details
from bricktrack_host.stages.motion import (
    fuse_run,
    output_grid,
    retime,
    with_ray_errors,
    with_rejected_told,
    with_restamped_told,
    with_times_doubted,
    with_unsure_times,
    words_on_knocks,
)
from bricktrack_host.stages.progress import Stages
from bricktrack_host.stages.settings import ProcessSettings
from bricktrack_host.tracking.centroid_noise import with_measured_noise
from bricktrack_host.tracking.copied_frames import with_copied_frames_left_out
from bricktrack_host.tracking.frame_errors import frame_errors
from bricktrack_host.tracking.led_fit import with_profile_of_run
from bricktrack_host.tracking.led_sizes import led_sizes
from bricktrack_host.tracking.odd_leds import with_odd_leds_doubted, words_on_odd_leds, words_on_unused_leds
from bricktrack_host.tracking.optical_track import solve_poses, start_poses
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracks import LedObservations, OpticalTrack


def solve_run(
    run: Run,
    observations: LedObservations,
    *,
    calibration: Calibration,
    rays: RayModel,
    brick: BrickModel,
    settings: ProcessSettings,
    problems: list[str],
    stages: Stages,
    files: tuple[Path, Path],
) -> tuple[RunResult, TwoFusions | None]:
    """Return the result of a run, and both fusions where LED by LED was checked against pose by pose.

    Parameters
    ----------
    run : Run
    observations : LedObservations
        The LEDs seen in its pictures.
    calibration : Calibration
    rays : RayModel
        The calibration's, in the sensor mode of the run.
    brick : BrickModel
    settings : ProcessSettings
    problems : list of str
        What goes wrong is added in words.
    stages : Stages
        Hears which stage begins.
    files : (Path, Path)
        The calibration's and the layout's, whose hashes the results hold.

    Raises
    ------
    TrackingError
        If no pose can be believed.
    """
    with stages("solve poses"):
        observations, copies = with_copied_frames_left_out(observations)
        problems += copies
        first = start_poses(observations, rays, brick, form=settings.prsoi_form)
        brick = with_profile_of_run(
            observations, first, rays, brick, rolling_shutter=settings.rolling_shutter
        )
        errors = frame_errors(observations, first, rays, brick, rolling_shutter=settings.rolling_shutter)
        observations, errors = with_odd_leds_doubted(observations, errors)
        problems += words_on_odd_leds(observations, brick)
        problems += words_on_unused_leds(observations, brick)
        is_keyframe = None if run.frames is None else run.frames.keyframe
        observations = with_measured_noise(observations, errors, is_keyframe)
        optical = solve_poses(
            observations, rays, brick, rolling_shutter=settings.rolling_shutter, first=first
        )
    _require_poses(optical, run, brick)
    sizes = led_sizes(observations, optical, rays, brick)
    with stages("align clocks"):
        edge_fit = fit_square_wave(run, problems)
        imu = choose_imu(run, brick, settings, problems)
        inertial = None if imu is None else align(optical, imu, run, brick, edge_fit, settings, problems)
        if inertial is not None and inertial.slips is not None:
            observations = with_stamps_mended(observations, inertial.slips, optical.t_ns)
            first = start_poses(observations, rays, brick, form=settings.prsoi_form)
            optical = solve_poses(
                observations, rays, brick, rolling_shutter=settings.rolling_shutter, first=first
            )
        time_sd_ns = unsure_stamps(observations.sensor_timestamp_ns, optical, inertial, problems)
        rest = rest_pose(optical, inertial, problems)
    with stages("fuse"):
        if settings.rolling_shutter:
            optical = retime(observations, first, optical, inertial, rays, brick)
            _require_poses(optical, run, brick)
        problems += words_on_knocks(optical, inertial)
        grid = output_grid(optical, inertial, edge_fit)
        seen = (with_times_doubted(observations, time_sd_ns), rays) if settings.rolling_shutter else None
        fused, fusion, rejected = fuse_run(
            optical, inertial, brick, grid, problems, seen=seen,
            rest_ns=None if rest is None else rest.interval_ns,
        )  # fmt: skip
        observations = with_rejected_told(observations, rejected)
        optical, fused = with_unsure_times(optical, fused, time_sd_ns)
        fused = with_restamped_told(optical, fused)
        fused_rest = None
        if rest is not None and fusion is not None and fusion.pose_level is not None:  # fused LED by LED
            fused_rest = rest_of_fused(rest, fused["frame"], optical)
        errors_of_rays = ray_errors(
            calibration.ray_model, brick, _pose_at_rest(optical, rest), led_sd_px=sizes.sd_px
        )
        problems += sizes.words(brick, in_covariance=errors_of_rays is not None)
        if errors_of_rays is None:
            problems.append(
                "where the brick stood, fewer than four LEDs lie in the picture: the standard deviations "
                "hold nothing of the calibration's own"
            )
        optical, fused = with_ray_errors(optical, fused, errors_of_rays)
        rest, fused_rest = (
            None if pose is None else replace(pose, ray_errors=errors_of_rays) for pose in (rest, fused_rest)
        )
    result = RunResult(
        manifest=run.manifest,
        led_names=brick.led_names,
        observations=observations,
        optical=optical,
        fused=fused,
        edge_index=grid.edge_index,
        edge_fit=edge_fit,
        imu=imu,
        imu_camera_t_ns=None if inertial is None else inertial.alignment.sampled_ns(inertial.imu),
        rest=rest,
        fused_rest=fused_rest,
        alignment=alignment_details(inertial, fusion, optical),
        calibration=calibration_details(calibration),
        problems=tuple(problems),
        provenance=Provenance(
            manifest_sha256=sha256_file(run.folder / MANIFEST_NAME),
            calibration_sha256=sha256_file(files[0]),
            layout_sha256=sha256_file(files[1]),
            software_version=software_version(),
            settings=settings.facts(),
        ),
        timings_s=stages.seconds,
    )
    if fusion is None or fusion.pose_level is None:
        return result, None
    return result, TwoFusions.of(fusion.track, fusion.pose_level)


def _pose_at_rest(optical: OpticalTrack, rest: RestPose | None) -> Pose:
    """Return the pose at rest, or one from the middle of a run that was never still."""
    if rest is not None:
        return Pose(rest.R_camera_rest, rest.t_camera_rest_mm)
    posed = np.flatnonzero(all_finite(optical.t_camera_brick_mm))
    t_mm = optical.t_camera_brick_mm[posed]
    middle = posed[np.linalg.norm(t_mm - np.median(t_mm, axis=0), axis=1).argmin()]
    return Pose(optical.R_camera_brick[middle], optical.t_camera_brick_mm[middle])


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
