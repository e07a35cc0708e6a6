"""The camera as the daemon sees it: started and stopped in time, watched, its pictures held in a ring.

A call that hangs is left to its thread; only a new start of the daemon gives such a camera back.
"""

import time
from collections.abc import Callable

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import HardwareError
from bricktrack_common.run_manifest import CameraSection
from bricktrack_device.capture.ring import FrameRing, VideoCut, cut_video
from bricktrack_device.in_time import HangsError, in_time
from bricktrack_device.interfaces import Camera, Still

START_TIMEOUT_S = 30.0
STOP_TIMEOUT_S = 5.0
STILL_TIMEOUT_S = 5.0
FIRST_KEYFRAME_TIMEOUT_S = 10.0
_SILENT_NS = 1_000_000_000
_SILENT_PERIODS = 10
_POLL_S = 0.01


class CameraStream:
    """A camera from `start` to `stop`.

    Parameters
    ----------
    open_camera : callable
        Returns the camera, not yet started.
    span_ns : int
        How far back pictures are kept.
    beat : callable
        Called while waiting for the camera; raises to give up.

    Attributes
    ----------
    ring : FrameRing
    section : CameraSection or None
        How pictures are taken, once it has started.
    lost : str
        Why only a new start of the daemon gives the camera back, in words; ``""`` while that is not needed.
    """

    def __init__(self, open_camera: Callable[[], Camera], span_ns: int, *, beat: Callable[[], None]) -> None:
        self._open_camera = open_camera
        self._beat = beat
        self._camera: Camera | None = None
        self._start_problem = ""
        self._own_words_told = ""
        self._silence_told = False
        self.ring = FrameRing(span_ns)
        self.section: CameraSection | None = None
        self.lost = ""

    def start(self) -> CameraSection:
        """Open the camera and start it.

        Raises
        ------
        HardwareError
            If it does not start, or not in time.
        """
        try:
            camera = self._camera = self._open_camera()
            self.section = in_time("start", lambda: camera.start(self.ring), START_TIMEOUT_S, beat=self._beat)
        except HardwareError as e:
            self._start_problem = str(e)
            if isinstance(e, HangsError):
                self.lost = f"camera: {e}"
            raise
        return self.section

    def wait_for_keyframe(self) -> None:
        """Wait for the first picture that can be decoded.

        Raises
        ------
        HardwareError
            If none comes in time.
        """
        deadline = time.monotonic() + FIRST_KEYFRAME_TIMEOUT_S
        while self.ring.first_keyframe_us is None:
            self._beat()
            if time.monotonic() > deadline:
                self._start_problem = (
                    f"no keyframe came within {FIRST_KEYFRAME_TIMEOUT_S:g} s of starting "
                    f"({self.ring.n_packets} pictures came). Check the camera's cable, then run "
                    "'bricktrackd check'"
                )
                raise HardwareError(self._start_problem)
            time.sleep(_POLL_S)

    def still(self) -> Still | None:
        """Return a picture of now, or `None`; raise `HardwareError` where the camera does not answer."""
        camera = self._camera
        return None if camera is None else in_time("still", camera.still, STILL_TIMEOUT_S, beat=self._beat)

    @property
    def problem(self) -> str:
        """Why no pictures come now, in words, or ``""``; a camera that was silent may come again."""
        if self._start_problem or self.section is None:
            return self._start_problem or "it has not started"
        silent_ns = monotonic_ns() - (self.ring.newest_us or 0) * 1000
        limit_ns = max(_SILENT_NS, _SILENT_PERIODS * self.section.frame_duration_us * 1000)
        return f"no picture for {silent_ns / 1e9:.1f} s" if silent_ns > limit_ns else ""

    def news(self) -> list[str]:
        """Return in words what has gone wrong since the last time, with a camera that had started."""
        if self._camera is None or self.section is None or self._start_problem:
            return []
        found = []
        own_words = self._camera.problem() or ""
        if own_words and not self._own_words_told:
            self._own_words_told = own_words
            found.append(own_words)
        silence = self.problem
        if silence and not self._silence_told:
            self._silence_told = True
            found.append(f"camera: {silence}")
        return found

    def cut(self, start_ns: int, end_ns: int) -> VideoCut | None:
        """Return the pictures of a window; `None` of a camera that gave none."""
        section, first_us = self.section, self.ring.first_abs_us
        if section is None or first_us is None:
            return None
        packets, metadata = self.ring.snapshot()
        return cut_video(
            packets,
            metadata,
            start_ns=start_ns,
            end_ns=end_ns,
            first_abs_us=first_us,
            period_us=section.frame_duration_us,
            default_exposure_us=section.exposure_us,
            default_gain=section.analogue_gain,
        )

    def stop(self) -> None:
        """Stop it. Calling it twice does no harm.

        Raises
        ------
        Exception
            What stopping raises, or that it hangs; `lost` then says so too.
        """
        camera, self._camera = self._camera, None
        if camera is None:
            return
        try:
            in_time("stop", camera.stop, STOP_TIMEOUT_S, beat=lambda: None)
        except Exception as e:
            self.lost = str(e)
            raise
