"""What there is to see of a run in space: bricks, rays and LEDs at each instant, camera frame, mm.

Plain arrays, with nothing of the viewer's. What is not known at an instant has no points there, so that a
viewer that keeps the last value on the screen shows nothing rather than what is past.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel, SensorMode
from bricktrack_common.errors import RunFormatError, VideoError
from bricktrack_common.frame_times import FrameTimes
from bricktrack_common.run_folder import Run
from bricktrack_host.assemblies.motion_history import NOT_MEASURED
from bricktrack_host.recordings.annex_b import NAL_PPS, NAL_SPS, iter_nal_units
from bricktrack_host.results.result_store import RunResult

AXIS_MM = 20.0
_BOX_MARGIN_MM = 6.0
_RING_MARGIN_PX = 6.0
_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
# One line along all twelve edges of a box; the corners are numbered as in _CORNERS.
_EDGES = np.array([0, 1, 3, 2, 0, 4, 5, 7, 6, 4, 5, 1, 3, 7, 6, 2])


@dataclass(frozen=True, slots=True, eq=False)
class Many:
    """Shapes at instants: how many there are at each, and all their numbers, one after the other.

    Attributes
    ----------
    t_ns : ndarray of int64, shape (n,)
    counts : ndarray of int64, shape (n,)
    values : ndarray, shape (sum of counts, ...)
    """

    t_ns: IntArray
    counts: IntArray
    values: FloatArray

    @classmethod
    def of(cls, t_ns: IntArray, values: FloatArray, known: BoolArray) -> "Many":
        """Return shapes of (n, k, ...) with those that are known, (n, k)."""
        return cls(t_ns, known.sum(axis=1), values[known])


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A brick at instants, camera frame, mm.

    Attributes
    ----------
    leds : Many of (3,)
        Where the layout's LEDs are by the pose.
    box : Many of (16, 3)
        A line along the edges of a box around them.
    axes : Many of (2, 3)
        Origin and vector of each of the brick's axes, `AXIS_MM` long.
    """

    leds: Many
    box: Many
    axes: Many


@dataclass(frozen=True, slots=True, eq=False)
class LedMarks:
    """What was found in the pictures; positions in the viewer's pixels, whose centres are at halves.

    Attributes
    ----------
    used, not_used : Many of (2,)
        Centroids.
    rings : Many of (33, 2)
        Around the LEDs that a pose is of, a little larger than their lights.
    predicted : Many of (2,)
        Where the pose puts them.
    residuals : Many of (2, 2)
        Predicted place, and the way from there to the centroid in pixels.
    labels : Many of (2,)
        Where the names of all that were seen are written: at the upper right of their lights.
    names : list of str
    """

    used: Many
    not_used: Many
    rings: Many
    predicted: Many
    residuals: Many
    labels: Many
    names: list[str]


@dataclass(frozen=True, slots=True, eq=False)
class Pinhole:
    """The straight camera that is nearest to the rays around the middle of the picture, for drawing."""

    focal_px: tuple[float, float]
    principal_px: tuple[float, float]


def video_of(run: Run, result: RunResult) -> tuple[Path, FrameTimes, SensorMode]:
    """Return the video of a run, whose results these are, its frame times and its camera's mode.

    Raises
    ------
    VideoError
        If it has no video.
    RunFormatError
        If the results are of another run.
    """
    if run.video is None or run.frames is None or run.manifest.camera is None:
        raise VideoError(f"{run.folder}: the run has no video with frame times; there is nothing to see")
    if result.manifest.run_id != run.manifest.run_id or len(result.optical.t_ns) != run.frames.n_frames:
        raise RunFormatError(f"{run.folder}: these are results of {result.manifest.run_id}, not of this run")
    return run.video, run.frames, run.manifest.camera.mode


def origin_ns(result: RunResult) -> tuple[int, str]:
    """Return the zero of the viewer's time, and what it is: the trigger, or else the first frame."""
    if result.t0_ns is not None:
        return result.t0_ns, "trigger"
    return int(result.optical.t_ns[0]), "first frame"


def brick_at(
    t_ns: IntArray, R: FloatArray, t_mm: FloatArray, known: BoolArray, brick: BrickModel | None
) -> Body:
    """Return a brick at instants; without its layout its axes alone."""
    n = len(t_ns)
    origins = np.broadcast_to(t_mm[:, None], (n, 3, 3))
    axes = np.stack([origins, AXIS_MM * np.swapaxes(R, 1, 2)], axis=2)
    leds = np.empty((0, 3)) if brick is None else brick.led_positions_mm
    low, high = (leds.min(axis=0), leds.max(axis=0)) if len(leds) else (np.zeros(3), np.zeros(3))
    corners = (low - _BOX_MARGIN_MM + (high - low + 2 * _BOX_MARGIN_MM) * _CORNERS)[_EDGES]
    n_boxes = int(len(leds) > 0)
    return Body(
        leds=Many.of(t_ns, _placed(R, t_mm, leds), np.repeat(known[:, None], len(leds), axis=1)),
        box=Many.of(t_ns, _placed(R, t_mm, corners)[:, None][:, :n_boxes], known[:, None][:, :n_boxes]),
        axes=Many.of(t_ns, axes, np.repeat(known[:, None], 3, axis=1)),
    )


def optical_brick(result: RunResult, brick: BrickModel | None) -> Body:
    """Return the brick as each frame alone shows it."""
    optical = result.optical
    known = np.asarray(np.isfinite(optical.t_camera_brick_mm).all(axis=1))
    return brick_at(optical.t_ns, optical.R_camera_brick, optical.t_camera_brick_mm, known, brick)


def measured(t_mm: FloatArray, flags: IntArray) -> BoolArray:
    """Return where a position is known and not extrapolated."""
    return np.asarray(np.isfinite(t_mm).all(axis=1) & (flags & int(NOT_MEASURED) == 0))


def led_marks(result: RunResult) -> LedMarks:
    """Return what was found in the pictures."""
    t_ns, residual = result.optical.t_ns, result.optical.residual_px
    uv = result.observations.uv_px + 0.5
    seen = np.asarray(np.isfinite(uv).all(axis=2))
    is_used = seen & np.isfinite(residual).all(axis=2)
    names = np.broadcast_to(np.array(result.led_names, dtype=object), seen.shape)
    turn = np.linspace(0, 2 * np.pi, 33)
    radius = np.sqrt(np.nan_to_num(result.observations.area_px2, nan=50.0) / np.pi) + _RING_MARGIN_PX
    circles = uv[:, :, None] + radius[..., None, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return LedMarks(
        used=Many.of(t_ns, uv, is_used),
        not_used=Many.of(t_ns, uv, seen & ~is_used),
        rings=Many.of(t_ns, circles, is_used),
        predicted=Many.of(t_ns, uv - residual, is_used),
        residuals=Many.of(t_ns, np.stack([uv - residual, residual], axis=2), is_used),
        labels=Many.of(t_ns, uv + (radius + 6.0)[..., None] * np.array([0.9, -0.9]), seen),
        names=names[seen].tolist(),
    )


def led_rays(result: RunResult, rays: RayModel, brick: BrickModel | None) -> Many:
    """Return the rays of the LEDs that the poses are of, each from z = 0 to its LED's depth, of (2, 3).

    Without the layout they end on the second calibration plane.
    """
    optical, uv = result.optical, result.observations.uv_px
    used = np.isfinite(optical.residual_px).all(axis=2) & np.isfinite(uv).all(axis=2)
    depth = np.full(uv.shape[:2], rays.plane_b_mm)
    if brick is not None:
        placed = _placed(optical.R_camera_brick, optical.t_camera_brick_mm, brick.led_positions_mm)
        depth = placed[..., 2]
        used &= np.isfinite(depth)
    a, b = rays.plane_a_mm, rays.plane_b_mm
    on_a, on_b = (rays.points_on_plane(uv[used], z) for z in (a, b))
    slope = (on_b - on_a) / (b - a)
    ends = np.empty((int(used.sum()), 2, 3))
    for k, z in enumerate((np.zeros(len(ends)), depth[used])):
        ends[:, k, :2], ends[:, k, 2] = on_a + slope * (z - a)[:, None], z
    return Many(optical.t_ns, used.sum(axis=1), ends)


def nearest_pinhole(rays: RayModel) -> Pinhole:
    """Return the pinhole that has the rays' directions around the picture's middle."""
    mode = rays.sensor_mode
    middle = np.array([(mode.width - 1) / 2, (mode.height - 1) / 2])
    step = mode.height / 8
    uv = middle + step * np.array([[0.0, 0.0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    a, b = rays.plane_a_mm, rays.plane_b_mm
    slope = (rays.points_on_plane(uv, b) - rays.points_on_plane(uv, a)) / (b - a)
    fx, fy = 2 * step / (slope[1, 0] - slope[2, 0]), 2 * step / (slope[3, 1] - slope[4, 1])
    centre = middle - np.array([fx, fy]) * slope[0]
    return Pinhole((float(fx), float(fy)), (float(centre[0]), float(centre[1])))


def encoded_pictures(video: Path, frames: FrameTimes) -> list[bytes]:
    """Return each frame's bytes as recorded; each keyframe with parameter sets, so that it can come first."""
    data = video.read_bytes()
    whole = [i for i, end in enumerate((frames.byte_offset + frames.n_bytes).tolist()) if end <= len(data)]
    pictures = [data[frames.byte_offset[i] : frames.byte_offset[i] + frames.n_bytes[i]] for i in whole]
    sets = _parameter_sets(pictures[0]) if pictures else b""
    return [
        sets + picture if frames.keyframe[i] and not _parameter_sets(picture) else picture
        for i, picture in zip(whole, pictures, strict=True)
    ]


def _parameter_sets(picture: bytes) -> bytes:
    units = list(iter_nal_units(picture))
    ends = [unit.offset for unit in units[1:]] + [len(picture)]
    return b"".join(
        picture[unit.offset : end]
        for unit, end in zip(units, ends, strict=True)
        if unit.nal_type in (NAL_SPS, NAL_PPS)
    )


def _placed(R: FloatArray, t_mm: FloatArray, points_brick_mm: FloatArray) -> FloatArray:
    """Return points of the brick in the camera frame, shape (n, k, 3)."""
    return np.asarray(np.einsum("nij,kj->nki", R, points_brick_mm) + t_mm[:, None])
