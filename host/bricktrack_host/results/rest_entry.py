"""How a rest pose, and what the calibration's rays do to poses, stand in the summary of results."""

from typing import Literal

import msgspec
import numpy as np

from bricktrack_common.poses import Pose
from bricktrack_host.results.ray_errors import RayErrors
from bricktrack_host.results.rest_pose import RestPose


class RayErrorsEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`RayErrors` as written."""

    rotation_camera_brick: list[list[float]]
    position_camera_mm: list[float]
    factor: list[list[float]]
    slopes: list[list[list[float]]]


class RestEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`RestPose` as written."""

    rotation_camera_rest: list[list[float]]
    position_camera_mm: list[float]
    interval_ns: tuple[int, int]
    n_frames: int
    spread_mm: list[float]
    spread_rad: list[float]
    source: Literal["found", "given"]
    covariance: list[list[float]] | None = None
    ray_errors: RayErrorsEntry | None = None


def rest_entry(rest: RestPose | None, *, with_rays: bool = True) -> RestEntry | None:
    """Return what is written of a rest pose; what rays do is long, and said once."""
    if rest is None:
        return None
    return RestEntry(
        rotation_camera_rest=rest.R_camera_rest.tolist(),
        position_camera_mm=rest.t_camera_rest_mm.tolist(),
        interval_ns=rest.interval_ns,
        n_frames=rest.n_frames,
        spread_mm=rest.spread_mm.tolist(),
        spread_rad=rest.spread_rad.tolist(),
        source=rest.source,
        covariance=rest.covariance.tolist(),
        ray_errors=_ray_errors_entry(rest.ray_errors) if with_rays and rest.ray_errors else None,
    )


def _ray_errors_entry(errors: RayErrors) -> RayErrorsEntry:
    return RayErrorsEntry(
        rotation_camera_brick=errors.about.R.tolist(),
        position_camera_mm=errors.about.t_mm.tolist(),
        factor=errors.factor.tolist(),
        slopes=errors.slopes.tolist(),
    )


def rest_pose_of(entry: RestEntry | None, *, rays_of: RestPose | None = None) -> RestPose | None:
    """Return the rest pose that was written, with what another one says of the rays if it does not."""
    if entry is None:
        return None
    errors = None if rays_of is None else rays_of.ray_errors
    # Until version 2 each frame was believed to err anew.
    of_mean = np.square([*entry.spread_rad, *entry.spread_mm]) / entry.n_frames
    return RestPose(
        R_camera_rest=np.array(entry.rotation_camera_rest),
        t_camera_rest_mm=np.array(entry.position_camera_mm),
        interval_ns=entry.interval_ns,
        n_frames=entry.n_frames,
        spread_mm=np.array(entry.spread_mm),
        spread_rad=np.array(entry.spread_rad),
        covariance=np.diag(of_mean) if entry.covariance is None else np.array(entry.covariance),
        source=entry.source,
        ray_errors=_ray_errors(entry.ray_errors) if entry.ray_errors else errors,
    )


def _ray_errors(entry: RayErrorsEntry) -> RayErrors:
    about = Pose(np.array(entry.rotation_camera_brick), np.array(entry.position_camera_mm))
    return RayErrors(about, np.array(entry.factor), np.array(entry.slopes))
