"""A run as a recording for the Rerun viewer: video, LEDs, rays, bricks and curves on one timeline."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.run_folder import Run
from bricktrack_host.assemblies.motion_history import HistoryError, run_history
from bricktrack_host.quality import PoseFlag, describe
from bricktrack_host.results.result_store import RunResult
from bricktrack_host.results.run_summary import imu_camera_time_ns, key_figures, main_track, verdict
from bricktrack_host.viewing.run_scene import (
    Body,
    Many,
    brick_at,
    encoded_pictures,
    led_marks,
    led_rays,
    measured,
    nearest_pinhole,
    optical_brick,
    origin_ns,
    video_of,
)

APPLICATION = "bricktrack"
CAMERA = "world/camera"
RESIDUAL_SCALE = 100.0
_AXES = ([230, 110, 70], [90, 180, 90], [80, 150, 240])
_OPTICAL, _FUSED, _RAY = [240, 150, 60], [90, 170, 230], [250, 215, 120, 90]
_SEEN, _UNUSED, _PREDICTED = [120, 220, 120], [255, 160, 60], [90, 200, 255]
_EVENTS = PoseFlag.NO_POSE | PoseFlag.DROPOUT | PoseFlag.IMPACT | PoseFlag.CLIPPED | PoseFlag.IMU_GAP


@dataclass(frozen=True, slots=True)
class Belongings:
    """What the results do not hold: the calibrated rays and the layout, where they are known."""

    rays: RayModel | None = None
    brick: BrickModel | None = None


def record_run(
    stream: "rr.RecordingStream",
    run: Run,
    result: RunResult,
    belongings: Belongings,
    *,
    with_video: bool = True,
    progress: Callable[[str, int, int], None] | None = None,
) -> None:
    """Send a run to a recording.

    Parameters
    ----------
    stream : rerun.RecordingStream
    run, result : Run, RunResult
        The recording, and what processing it gave.
    belongings : Belongings
        Without rays no rays are drawn, and the picture stands by itself; without a layout bricks are axes.
    with_video : bool
        The video makes nearly all of the recording's size.
    progress : callable, optional
        Called with what is being done, how many parts are done, and of how many.

    Raises
    ------
    VideoError, RunFormatError
        If the run has no video, or the results are of another run.
    """
    video, frames, _ = video_of(run, result)
    say = progress or (lambda _what, _done, _of: None)
    recorder = _Recorder(stream, result)
    parts: list[tuple[str, Callable[[], None]]] = [
        ("video", lambda: recorder.video(encoded_pictures(video, frames))),
        ("camera", lambda: recorder.camera(belongings.rays)),
        ("LEDs", recorder.leds),
        ("rays", lambda: recorder.rays(belongings)),
        ("bricks", lambda: recorder.bricks(belongings.brick)),
        ("motion", recorder.motion),
        ("samples", recorder.samples),
        ("words", recorder.words),
    ]
    for i, (what, send) in enumerate(parts):
        say(what, i, len(parts))
        if what != "video" or with_video:
            send()


def timeline_of(result: RunResult) -> str:
    """Return the name of the timeline: seconds of the unit's clock since the trigger, or the first frame."""
    return f"since {origin_ns(result)[1]}"


class _Recorder:
    """Sends the parts of one run."""

    def __init__(self, stream: "rr.RecordingStream", result: RunResult) -> None:
        self._stream = stream
        self._result = result
        self._origin_ns = origin_ns(result)[0]
        self._timeline = timeline_of(result)

    def video(self, pictures: list[bytes]) -> None:
        path = f"{CAMERA}/video"
        self._fixed(path, rr.VideoStream(codec=rr.VideoCodec.H264))
        self._send(path, self._result.optical.t_ns[: len(pictures)], rr.VideoStream.columns(sample=pictures))

    def camera(self, rays: RayModel | None) -> None:
        self._fixed("world", rr.ViewCoordinates.RDF)
        if rays is None:
            return
        pinhole, mode = nearest_pinhole(rays), rays.sensor_mode
        self._fixed(
            CAMERA,
            rr.Pinhole(
                focal_length=pinhole.focal_px,
                # Of Rerun a pixel's centre is at its half; here it is at its whole number.
                principal_point=[x + 0.5 for x in pinhole.principal_px],
                resolution=[mode.width, mode.height],
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=1.4 * rays.plane_b_mm,
            ),
        )

    def leds(self) -> None:
        marks, path = led_marks(self._result), f"{CAMERA}/leds"
        for name, points, colour in (("used", marks.used, _SEEN), ("not_used", marks.not_used, _UNUSED)):
            self._fixed(f"{path}/{name}", rr.Points2D.from_fields(colors=colour, radii=[2.5]))
            self._send_many(f"{path}/{name}", points, rr.Points2D.columns(positions=points.values))
        self._fixed(f"{path}/names", rr.Points2D.from_fields(colors=_SEEN, radii=[0.5], show_labels=True))
        columns = rr.Points2D.columns(positions=marks.labels.values, labels=marks.names)
        self._send_many(f"{path}/names", marks.labels, columns)
        self._fixed(f"{path}/rings", rr.LineStrips2D.from_fields(colors=_SEEN, radii=[1.0]))
        self._send_many(
            f"{path}/rings", marks.rings, rr.LineStrips2D.columns(strips=list(marks.rings.values))
        )
        self._fixed(f"{path}/predicted", rr.Points2D.from_fields(colors=_PREDICTED, radii=[1.5]))
        columns = rr.Points2D.columns(positions=marks.predicted.values)
        self._send_many(f"{path}/predicted", marks.predicted, columns)
        name, arrows = f"{path}/residuals_x{RESIDUAL_SCALE:g}", marks.residuals
        self._fixed(name, rr.Arrows2D.from_fields(colors=_PREDICTED, radii=[1.0]))
        vectors = RESIDUAL_SCALE * arrows.values[:, 1]
        # Its head is where the centroid is seen, as in the film of `bricktrack overlay`.
        tails = arrows.values.sum(axis=1) - vectors
        self._send_many(name, arrows, rr.Arrows2D.columns(origins=tails, vectors=vectors))

    def rays(self, belongings: Belongings) -> None:
        if belongings.rays is None:
            return
        rays = led_rays(self._result, belongings.rays, belongings.brick)
        self._fixed("world/rays", rr.LineStrips3D.from_fields(colors=_RAY, radii=[0.15]))
        self._send_many("world/rays", rays, rr.LineStrips3D.columns(strips=list(rays.values)))

    def bricks(self, brick: BrickModel | None) -> None:
        self._body("world/optical", optical_brick(self._result, brick), _OPTICAL)
        track = main_track(self._result)
        if track is not None:
            known = measured(track.t_camera_brick_mm, track.flags)
            body = brick_at(track.t_ns, track.R_camera_brick, track.t_camera_brick_mm, known, brick)
            self._body("world/fused", body, _FUSED)

    def motion(self) -> None:
        result = self._result
        motions: list[tuple[str, IntArray, Any]] = []
        try:
            motions.append(("optical", result.optical.t_ns, run_history(result)))
            kind = next((kind for kind in ("imu", "frame") if kind in result.fused), None)
            if kind is not None:
                motions.append(("fused", result.fused[kind].t_ns, run_history(result, kind)))
        except HistoryError:
            return  # no rest pose, as the words say
        for name, t_ns, history in motions:
            for what, values in (
                ("displacement_mm", history.displacement_mm),
                ("rotation_deg", history.rotation_deg),
            ):
                shown = np.where(history.measured[:, None], values, np.nan)
                for k, axis in enumerate("xyz"):
                    path = f"motion/{what}/{axis}/{name}"
                    if name == "optical":
                        self._fixed(path, rr.SeriesPoints(names=name, colors=_OPTICAL, marker_sizes=2.0))
                    else:
                        self._fixed(path, rr.SeriesLines(names=name, colors=_FUSED, widths=1.5))
                    self._send(path, t_ns, rr.Scalars.columns(scalars=shown[:, k]))

    def samples(self) -> None:
        result = self._result
        residual = np.linalg.norm(result.optical.residual_px, axis=2)
        names = [f"{name}, px" for name in result.led_names]
        self._series("residuals", result.optical.t_ns, residual, names, rr.SeriesPoints)
        if result.imu is not None:
            t_ns = imu_camera_time_ns(result)
            for path, values, unit in (
                ("imu/acceleration", result.imu.acc_mps2, "m/s²"),
                ("imu/angular_rate", np.rad2deg(result.imu.gyro_radps), "deg/s"),
            ):
                self._series(path, t_ns, values, [f"{c}, {unit}" for c in "xyz"], rr.SeriesLines)

    def words(self) -> None:
        result = self._result
        line, problems = verdict(result, key_figures(result))
        p = result.provenance
        hashes = [(sha256 or "none")[:12] for sha256 in (p.calibration_sha256, p.layout_sha256)]
        paragraphs = [
            f"# {result.manifest.run_id}",
            "**SIMULATED**" if result.manifest.simulated else "",
            line,
            "\n".join(f"- {problem}" for problem in problems),
            f"bricktrack {p.software_version}; calibration {hashes[0]}, layout {hashes[1]}",
            f"Time: seconds {self._timeline}, by the unit's clock. World: the camera frame, mm, x right, "
            "y down, z out through the lens. Blue: fused; orange: the camera alone. Residuals are drawn "
            f"{RESIDUAL_SCALE:g} times their length.",
        ]
        text = "\n\n".join(paragraph for paragraph in paragraphs if paragraph)
        self._fixed("about", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
        track = main_track(result)
        flags, t_ns = (
            (result.optical.flags, result.optical.t_ns) if track is None else (track.flags, track.t_ns)
        )
        shown = flags & int(_EVENTS)
        begins = np.flatnonzero(np.diff(shown, prepend=0))
        words = [describe(int(shown[i])) or "as usual again" for i in begins]
        levels = ["WARN" if shown[i] else "INFO" for i in begins]
        if words:
            self._send("events", t_ns[begins], rr.TextLog.columns(text=words, level=levels))

    def _body(self, path: str, body: Body, colour: list[int]) -> None:
        self._fixed(f"{path}/leds", rr.Points3D.from_fields(colors=colour, radii=[2.5]))
        self._send_many(f"{path}/leds", body.leds, rr.Points3D.columns(positions=body.leds.values))
        self._fixed(f"{path}/box", rr.LineStrips3D.from_fields(colors=colour, radii=[0.5]))
        self._send_many(f"{path}/box", body.box, rr.LineStrips3D.columns(strips=list(body.box.values)))
        self._fixed(f"{path}/axes", rr.Arrows3D.from_fields(colors=_AXES, radii=[0.5]))
        axes = body.axes.values
        self._send_many(
            f"{path}/axes", body.axes, rr.Arrows3D.columns(origins=axes[:, 0], vectors=axes[:, 1])
        )

    def _series(self, path: str, t_ns: IntArray, values: FloatArray, names: list[str], style: Any) -> None:
        colours = _AXES if len(names) == 3 else None
        self._fixed(path, style(names=names, colors=colours))
        n, k = values.shape
        self._send(path, t_ns, rr.Scalars.columns(scalars=values.ravel()).partition([k] * n))

    def _fixed(self, path: str, what: Any) -> None:
        """Log what holds at all times."""
        self._stream.log(path, what, static=True)

    def _send_many(self, path: str, shapes: Many, columns: Any) -> None:
        self._send(path, shapes.t_ns, columns.partition(shapes.counts))

    def _send(self, path: str, t_ns: IntArray, columns: Any) -> None:
        since = (t_ns - self._origin_ns).astype("timedelta64[ns]")
        self._stream.send_columns(path, [rr.TimeColumn(self._timeline, duration=since)], columns)
