"""The simulated camera: pictures of the world, free-running, through a real H.264 encoder.

Like the real one it never waits: a frame whose turn has passed is dropped, and shows as a gap in the stamps.
"""

import logging
import queue
import threading
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import av
import numpy as np
from av.video.codeccontext import VideoCodecContext
from av.video.frame import PictureType, VideoFrame

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import HardwareError
from bricktrack_common.run_manifest import CameraSection
from bricktrack_device.interfaces import EncodedPacket, FrameMetadata, FrameSink
from bricktrack_device.sim.led_renderer import LedRenderer
from bricktrack_device.sim.lens import lens_of
from bricktrack_device.sim.scene import Plane
from bricktrack_device.sim.world import SimWorld

if TYPE_CHECKING:
    from bricktrack_device.config import CameraTable

logger = logging.getLogger(__name__)

LINES_A_FRAME = 1763  # what libcamera makes of 33333 us at the IMX219's line time: 30.0058 frames a second
_SENSOR_FRAME_RATE_HZ = 30.0
_ENCODER_QUEUE = 3


class SimCamera:
    """A simulated IMX219 in its 1080p mode, meeting `interfaces.Camera`."""

    def __init__(self, world: SimWorld, settings: "CameraTable") -> None:
        self._world = world
        self._settings = settings
        self._mode = IMX219_1080P
        self._stopping = threading.Event()
        self._threads: list[threading.Thread] = []
        self._to_encode: queue.Queue[tuple[int, Plane] | None] = queue.Queue(_ENCODER_QUEUE)
        self.frames_dropped = 0

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
        )
        encoder, encoder_settings = _open_encoder(s, mode.width, mode.height)
        self._stopping.clear()
        self._to_encode = queue.Queue(_ENCODER_QUEUE)
        planes = renderer.chroma_u, renderer.chroma_v
        self._threads = [
            threading.Thread(
                target=self._film,
                args=(renderer, sink, period_ns, exposure_us),
                name="sim-camera",
                daemon=True,
            ),
            threading.Thread(
                target=self._encode, args=(encoder, planes, sink), name="sim-encoder", daemon=True
            ),
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
            encoder=f"libx264 by PyAV {av.__version__}",
            encoder_settings=encoder_settings,
        )

    def stop(self) -> None:
        """Stop streaming. Calling it twice does no harm."""
        self._stopping.set()
        for thread in self._threads:
            thread.join(timeout=5)
        self._threads = []

    def _film(self, renderer: LedRenderer, sink: FrameSink, period_ns: float, exposure_us: int) -> None:
        """Render each frame when its read-out is over; skip frames whose turn has passed."""
        faults = self._world.settings.faults
        read_out_ns = float(self._mode.row_delay_ns(self._mode.height))
        start = monotonic_ns()
        k = 0
        while not self._stopping.is_set():
            k += 1
            stamp = start + round(k * period_ns)
            wait_s = (stamp + read_out_ns - monotonic_ns()) * 1e-9
            if wait_s > 0 and self._stopping.wait(wait_s):
                break
            if faults.camera_dies_after_s is not None and (stamp - start) * 1e-9 > faults.camera_dies_after_s:
                break
            dropped = faults.drop_frame_every and k % faults.drop_frame_every == 0
            if dropped or wait_s < -period_ns * 1e-9:
                self.frames_dropped += 1
                continue
            luma = renderer.luma(stamp)
            try:
                self._to_encode.put_nowait((stamp, luma))
            except queue.Full:
                self.frames_dropped += 1
                continue
            gain = self._settings.analogue_gain
            sink.on_metadata(FrameMetadata(stamp, exposure_us, gain, round(period_ns / 1000)))
        self._to_encode.put(None)

    def _encode(self, encoder: VideoCodecContext, chroma: tuple[Plane, Plane], sink: FrameSink) -> None:
        stamps: dict[int, int] = {}
        n = 0
        while (item := self._to_encode.get()) is not None:
            stamp, luma = item
            frame = VideoFrame(luma.shape[1], luma.shape[0], "yuv420p")
            for plane, values in zip(frame.planes, (luma, *chroma), strict=True):
                _fill(plane, values)
            frame.pts = n
            frame.pict_type = PictureType.NONE
            stamps[n] = stamp
            n += 1
            for packet in encoder.encode(frame):
                key = -1 if packet.pts is None else packet.pts
                sink.on_packet(
                    EncodedPacket(stamps.pop(key) // 1000, bool(packet.is_keyframe), bytes(packet))
                )


def _fill(plane: Any, values: Plane) -> None:
    rows = np.frombuffer(plane, dtype=np.uint8).reshape(plane.height, plane.line_size)
    rows[:, : values.shape[1]] = values


def _open_encoder(
    s: "CameraTable", width: int, height: int
) -> tuple[VideoCodecContext, dict[str, str | int | float | bool | None]]:
    """Return libx264 set as picamera2's LibavH264Encoder sets it, and the settings for the manifest."""
    options = {
        "preset": "superfast",
        "tune": "zerolatency",
        "profile": "high",
        "x264-params": "repeat-headers=1",
    }
    try:
        encoder = av.CodecContext.create("libx264", "w")
    except (av.error.FFmpegError, ValueError) as e:
        raise HardwareError(f"this PyAV has no libx264 encoder: {e}. Install PyAV from its own wheels") from e
    if not isinstance(encoder, VideoCodecContext):
        raise HardwareError("libx264 is no video encoder here; install PyAV from its own wheels")
    encoder.width, encoder.height, encoder.pix_fmt = width, height, "yuv420p"
    encoder.framerate = Fraction(s.frame_rate_hz).limit_denominator(1000)
    encoder.bit_rate = s.bitrate_bps
    encoder.gop_size = s.iperiod
    encoder.max_b_frames = 0
    encoder.thread_count = 2
    encoder.options = options
    encoder.open()
    return encoder, {**options, "bitrate_bps": s.bitrate_bps, "iperiod": s.iperiod, "threads": 2}
