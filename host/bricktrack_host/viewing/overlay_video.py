"""The overlay as a film: every frame of a run, drawn on and encoded, at its own time."""

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from av.video.frame import VideoFrame

from bricktrack_common.errors import RunFormatError
from bricktrack_common.run_folder import read_run
from bricktrack_host.durable_files import written_whole
from bricktrack_host.recordings.video_frames import decode_run_video
from bricktrack_host.results.result_store import read_result
from bricktrack_host.viewing.overlay import STRIP_ROWS, Image, OverlayArtist
from bricktrack_host.viewing.run_scene import video_of

_TIME_BASE = Fraction(1, 1_000_000)
_RATE = 30


def write_overlay(
    run_folder: Path,
    results_folder: Path,
    output: Path,
    *,
    slow: float = 1.0,
    scale: float = 1.0,
    frames: tuple[int, int] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Write a run's video with LEDs, residuals, poses and flags drawn on it, as MP4; return how many frames.

    Parameters
    ----------
    run_folder, results_folder : Path
    output : Path
        Written whole or not at all.
    slow : float
        How many times slower than it was; 10 shows a shake of 15 s in two and a half minutes.
    scale : float
        Of the picture's size.
    frames : (int, int), optional
        First frame, and the one after the last; all if not given.
    progress : callable, optional
        Called with how many frames are drawn, and of how many.

    Raises
    ------
    RunFormatError, VideoError
        If the run has no video, or the results are of another run.
    StorageError
        If the film cannot be written.
    """
    run = read_run(run_folder)
    result = read_result(results_folder)
    video, stamps, mode = video_of(run, result)
    first, stop = frames or (0, stamps.n_frames)
    if not 0 <= first < min(stop, stamps.n_frames):
        raise RunFormatError(f"frames {first}:{stop}: the run has frames 0 to {stamps.n_frames - 1}")
    stop = min(stop, stamps.n_frames)
    artist = OverlayArtist.of(result, mode.width, mode.height, frames=(first, stop))
    n = 0
    with (
        written_whole(output, "Choose another --output, or make room") as partial,
        av.open(str(partial), "w", format="mp4") as film,
    ):
        stream = film.add_stream("libx264", rate=_RATE, options={"crf": "20", "preset": "veryfast"})
        stream.pix_fmt = "yuv420p"
        # 4:2:0 has whole squares of four pixels only.
        stream.width = int(mode.width * scale) // 2 * 2
        stream.height = int((mode.height + STRIP_ROWS) * scale) // 2 * 2
        stream.time_base = stream.codec_context.time_base = _TIME_BASE
        t0_ns = int(stamps.sensor_timestamp_ns[first])
        for frame in decode_run_video(video, stamps):
            if frame.index >= stop:
                break
            if frame.index < first:
                continue
            drawn = artist.draw(frame.index, None if frame.picture is None else frame.picture.luma)
            shown = _fit(drawn, stream.width, stream.height)
            shown.pts = round((frame.sensor_timestamp_ns - t0_ns) / 1000 * slow)
            shown.time_base = _TIME_BASE
            film.mux(stream.encode(shown))
            n += 1
            if progress is not None:
                progress(n, stop - first)
        film.mux(stream.encode())
    return n


def _fit(drawn: Image, width: int, height: int) -> VideoFrame:
    if drawn.shape[:2] != (height, width):
        drawn = np.asarray(cv2.resize(drawn, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return VideoFrame.from_ndarray(drawn, format="bgr24")
