"""The simulated camera: pictures of the world, free-running, through a real H.264 encoder.

Like the real one it waits for nobody: a frame that is too late is dropped, and shows as a gap in the stamps.
"""

import logging
import queue
import threading
from typing import TYPE_CHECKING

import av

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import HardwareError
from bricktrack_common.run_manifest import CameraSection
from bricktrack_device.interfaces import FrameMetadata, FrameSink, Still
from bricktrack_device.sim.led_renderer import LedRenderer
from bricktrack_device.sim.led_switch import LedSwitch
from bricktrack_device.sim.lens import lens_of
from bricktrack_device.sim.scene import Plane
from bricktrack_device.sim.video_encoder import VideoEncoder
from bricktrack_device.sim.world import SimWorld

if TYPE_CHECKING:
    from bricktrack_device.config import CameraTable

logger = logging.getLogger(__name__)

LINES_A_FRAME = 1763  # what libcamera makes of 33333 us at the IMX219's line time: 30.0058 frames a second
_SENSOR_FRAME_RATE_HZ = 30.0
_MAX_LAG_S = 0.5
"""How late a picture may be rendered on a busy computer; twice that is a silent camera for the daemon."""
_MAX_WAITING = 2
"""Rendered pictures that wait for the encoder, 2 MB each."""


class SimCamera:
    """A simulated IMX219 in its 1080p mode, meeting `interfaces.Camera`.

    Parameters
    ----------
    world : SimWorld
    settings : CameraTable
    switch : LedSwitch, optional
        What lights the LEDs; they are lit without one.
    runs_free : bool
        Give each picture when it is rendered, whatever the clock says, and lose none: stamps only count from
        the clock then.
    """

    def __init__(
        self,
        world: SimWorld,
        settings: "CameraTable",
        switch: LedSwitch | None = None,
        *,
        runs_free: bool = False,
    ) -> None:
        self._runs_free = runs_free
        self._world = world
        self._switch = switch
        self._settings = settings
        self._mode = IMX219_1080P
        self._stopping = threading.Event()
        self._threads: list[threading.Thread] = []
        self._to_encode: queue.Queue[tuple[int, Plane] | None] = queue.Queue()
        self.frames_dropped = 0
        self._newest: Still | None = None
        self._encoder_failed = False

    def start(self, sink: FrameSink) -> CameraSection:
        """Begin to stream; raise `HardwareError` if it streams already or no encoder can be had."""
        if self._threads:
            raise HardwareError("the simulated camera streams already; stop it first")
        s, mode = self._settings, self._mode
        exposure_us = round(round(s.exposure_us * 1e3 / mode.line_time_ns) * mode.line_time_ns / 1e3)
        lines = round(LINES_A_FRAME * _SENSOR_FRAME_RATE_HZ / s.frame_rate_hz)
        period_ns = lines * mode.line_time_ns
        renderer = LedRenderer(
            self._world.settings,
            self._world,
            lens=lens_of(self._world.settings.seed),
            mode=mode,
            exposure_ns=exposure_us * 1000,
            switch=self._switch,
        )
        encoder = VideoEncoder(s, mode.width, mode.height)
        self._stopping.clear()
        self._encoder_failed = False
        self._to_encode = queue.Queue(_MAX_WAITING)
        self._threads = [
            threading.Thread(target=target, args=args, name=name, daemon=True)
            for name, target, args in (
                ("sim-camera", self._film, (renderer, sink, period_ns, exposure_us)),
                ("sim-encoder", self._encode, (encoder, renderer.chroma_u, renderer.chroma_v, sink)),
            )
        ]
        for thread in self._threads:
            thread.start()
        return CameraSection(
            model="simulated imx219",
            mode=mode,
            exposure_us=exposure_us,
            analogue_gain=s.analogue_gain,
            colour_gains=s.colour_gains,
            frame_duration_us=round(period_ns / 1000),
            encoder=encoder.name,
            encoder_settings=encoder.settings,
        )

    def still(self) -> Still | None:
        """Return the newest picture; `None` while none streams."""
        return self._newest

    def problem(self) -> str | None:
        """Return what is wrong with a camera that should stream, or `None`."""
        if not self._threads:
            return "camera: it does not stream"
        if not all(thread.is_alive() for thread in self._threads):
            return "camera: its thread has ended"
        return "camera: its encoder failed; see the log" if self._encoder_failed else None

    def stop(self) -> None:
        """Stop streaming. Calling it twice does no harm."""
        self._stopping.set()
        for thread in self._threads:
            thread.join(timeout=5)
        self._threads = []
        self._newest = None

    def _film(self, renderer: LedRenderer, sink: FrameSink, period_ns: float, exposure_us: int) -> None:
        """Render each frame when its read-out is over; skip frames that are too late."""
        faults = self._world.settings.faults
        read_out_ns = float(self._mode.row_delay_ns(self._mode.height))
        start = monotonic_ns()
        k = 0
        while not self._stopping.is_set():
            k += 1
            stamp = start + round(k * period_ns)
            wait_s = 0.0 if self._runs_free else (stamp + read_out_ns - monotonic_ns()) * 1e-9
            if wait_s > 0 and self._stopping.wait(wait_s):
                break
            if faults.camera_dies_after_s is not None and (stamp - start) * 1e-9 > faults.camera_dies_after_s:
                break
            dropped = faults.drop_frame_every and k % faults.drop_frame_every == 0
            if dropped or wait_s < -_MAX_LAG_S:
                self.frames_dropped += 1
                continue
            luma = renderer.luma(stamp)
            self._newest = Still(luma, renderer.chroma_u, renderer.chroma_v)
            self._to_encode.put((stamp, luma))
            gain = self._settings.analogue_gain
            sink.on_metadata(FrameMetadata(stamp, exposure_us, gain, round(period_ns / 1000)))
        self._to_encode.put(None)

    def _encode(self, encoder: VideoEncoder, chroma_u: Plane, chroma_v: Plane, sink: FrameSink) -> None:
        while (item := self._to_encode.get()) is not None:
            stamp, luma = item
            if self._encoder_failed:
                continue  # as when picamera2's encoder dies: frames stop, nothing raises
            try:
                for packet in encoder.encode(stamp // 1000, luma, chroma_u, chroma_v):
                    sink.on_packet(packet)
            except av.error.FFmpegError:
                logger.exception("the simulated camera's encoder failed; no more frames will come")
                self._encoder_failed = True
