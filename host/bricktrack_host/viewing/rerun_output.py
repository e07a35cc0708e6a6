"""Where a recording for the Rerun viewer goes: a file, or the viewer on this screen."""

import os
import sys
from collections.abc import Callable
from pathlib import Path

import rerun as rr

from bricktrack_common.errors import ConfigError
from bricktrack_common.run_folder import Run
from bricktrack_host.durable_files import written_whole
from bricktrack_host.results.result_store import RunResult
from bricktrack_host.viewing.rerun_blueprint import run_blueprint
from bricktrack_host.viewing.rerun_recording import APPLICATION, Belongings, record_run, timeline_of

Progress = Callable[[str, int, int], None]


def save_recording(
    path: Path,
    run: Run,
    result: RunResult,
    belongings: Belongings,
    *,
    with_video: bool = True,
    progress: Progress | None = None,
) -> None:
    """Write a run as an ``.rrd`` file, whole or not at all; see `record_run`.

    Raises
    ------
    VideoError, RunFormatError
        If the run has no video, or the results are of another run.
    StorageError
        If the file cannot be written.
    """
    with written_whole(path, "Choose another file for --save, or make room") as partial:
        partial.write_bytes(b"")  # what is wrong with the place is said by the system's own error
        stream = _stream(result)
        stream.save(partial, default_blueprint=_arranged(result, belongings))
        record_run(stream, run, result, belongings, with_video=with_video, progress=progress)
        stream.disconnect()


def show_recording(
    run: Run,
    result: RunResult,
    belongings: Belongings,
    *,
    with_video: bool = True,
    progress: Progress | None = None,
) -> None:
    """Open the viewer on this screen, or use the one that is open, and send it a run.

    Raises
    ------
    ConfigError
        If there is no screen.
    VideoError, RunFormatError
        If the run has no video, or the results are of another run.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ConfigError(
            "there is no screen here to open the viewer on. Write a file with --save run.rrd, and open it on "
            "another computer with 'rerun run.rrd'"
        )
    stream = _stream(result)
    stream.spawn(default_blueprint=_arranged(result, belongings))
    record_run(stream, run, result, belongings, with_video=with_video, progress=progress)
    stream.disconnect()


def _arranged(result: RunResult, belongings: Belongings) -> "rr.blueprint.Blueprint":
    return run_blueprint(timeline_of(result), with_camera=belongings.rays is not None)


def _stream(result: RunResult) -> "rr.RecordingStream":
    # A run has one name in the viewer, however often it is sent.
    return rr.RecordingStream(APPLICATION, recording_id=result.manifest.run_id)
