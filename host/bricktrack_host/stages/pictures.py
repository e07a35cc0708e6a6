"""The stage of the pictures: decode, find the LEDs, keep a few for the report."""

from typing import TYPE_CHECKING

import numpy as np

from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import VideoError
from bricktrack_common.frame_times import FrameTimes
from bricktrack_common.run_folder import Run
from bricktrack_host.recordings.video_frames import DecodedFrame
from bricktrack_host.recordings.video_parts import work_on_frames
from bricktrack_host.reporting.page_picture import PagePicture, page_picture
from bricktrack_host.stages.progress import ProcessProgress, Silent
from bricktrack_host.tracking.pictures.run_lights import light_finder
from bricktrack_host.tracking.pictures.segment import Blobs
from bricktrack_host.tracks import LedObservations, OpticalTrack

if TYPE_CHECKING:
    from bricktrack_host.reporting.plots import FrameOverlay
    from bricktrack_host.tracking.identity.led_identity import SegmentMethod

FIND = "decode and find LEDs"
_N_OVERLAYS = 4


def require_video(run: Run) -> FrameTimes:
    """Return the records of the frames.

    Raises
    ------
    VideoError
        If there is no video, or nothing in it.
    """
    if run.video is None or run.frames is None or run.manifest.camera is None:
        raise VideoError(f"{run.folder}: the run has no video with frame times; there is nothing to track")
    if run.frames.n_frames == 0:
        raise VideoError(f"{run.folder}: the run holds no frames")
    return run.frames


class RunPictures:
    """The pictures of a run on their way to the tracker: counts the lost ones, keeps a few for the report."""

    def __init__(self, run: Run, frames: FrameTimes) -> None:
        if run.video is None:
            raise VideoError(f"{run.folder}: the run has no video")
        self._video = run.video
        self._frames = frames
        self._keep = set(np.linspace(0, frames.n_frames - 1, _N_OVERLAYS).round().astype(int).tolist())
        self._kept: dict[int, PagePicture] = {}
        self._lost: dict[str, list[int]] = {}

    def observe(
        self, rays: RayModel, brick: BrickModel, method: "SegmentMethod", progress: ProcessProgress
    ) -> LedObservations:
        """Return the LEDs seen in all pictures."""
        return self.observations(self.lights(rays, brick, method, progress), rays, brick, method)

    def lights(
        self, rays: RayModel, brick: BrickModel, method: "SegmentMethod", progress: ProcessProgress
    ) -> list[Blobs | None]:
        """Return what could be an LED in each picture; `None` where it is lost."""
        find = light_finder(rays, brick, method)

        def lights_of(frame: DecodedFrame) -> Blobs | str:
            if frame.picture is None:
                return frame.lost_because
            if frame.index in self._keep:
                self._kept[frame.index] = page_picture(frame.picture.luma)
            return find(frame.index, frame.picture)

        found = work_on_frames(self._video, self._frames, lights_of, progress=progress.advance_to)
        for i, why in enumerate(found):
            if isinstance(why, str):
                self._lost.setdefault(why, []).append(i)
        return [None if isinstance(lights, str) else lights for lights in found]

    def observations(
        self, lights: list[Blobs | None], rays: RayModel, brick: BrickModel, method: "SegmentMethod"
    ) -> LedObservations:
        """Return which of the lights are which LEDs."""
        # Loaded here, because finding the lights need not wait for it; see `pipeline.LOADED_MEANWHILE`.
        from bricktrack_host.tracking.led_tracker import observe_lights

        return observe_lights(
            lights, rays, brick, sensor_timestamp_ns=self._frames.sensor_timestamp_ns,
            exposure_ns=self._frames.exposure_us * 1000, method=method,
        )  # fmt: skip

    def problems(self) -> list[str]:
        """Return what was wrong with the video, in words."""
        return [
            f"{len(frames)} frame{'s' if len(frames) > 1 else ''} lost (first: {frames[0]}): {reason}"
            for reason, frames in self._lost.items()
        ]

    def overlays(self, observations: LedObservations, optical: OpticalTrack) -> "list[FrameOverlay]":
        """Return the kept frames with the LEDs as seen and as the pose predicts them."""
        from bricktrack_host.reporting.plots import FrameOverlay

        out = []
        for i, picture in sorted(self._kept.items()):
            predicted = observations.uv_px[i] - optical.residual_px[i]
            seconds = (optical.t_ns[i] - optical.t_ns[0]) / 1e9
            out.append(FrameOverlay(f"frame {i}, {seconds:.2f} s", picture, observations.uv_px[i], predicted))
        return out


def observe_run(
    run: Run, rays: RayModel, brick: BrickModel, *, progress: ProcessProgress | None = None
) -> tuple[LedObservations, list[str]]:
    """Return the LEDs seen in a run, and what was wrong with its video, in words.

    Raises
    ------
    VideoError
        If the run has no video with frame times.
    """
    frames = require_video(run)
    pictures = RunPictures(run, frames)
    progress = progress or Silent()
    progress.stage(FIND, frames.n_frames)
    observations = pictures.observe(rays, brick, "default", progress)
    return observations, [*run.problems, *pictures.problems()]
