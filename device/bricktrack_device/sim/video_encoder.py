"""libx264 through PyAV, set as picamera2's LibavH264Encoder sets it: Annex-B, no B frames, all headers."""

from fractions import Fraction
from typing import TYPE_CHECKING, Any

import av
import numpy as np
from av.video.codeccontext import VideoCodecContext
from av.video.frame import PictureType, VideoFrame

from bricktrack_common.errors import HardwareError
from bricktrack_device.interfaces import EncodedPacket
from bricktrack_device.sim.scene import Plane

if TYPE_CHECKING:
    from bricktrack_device.config import CameraTable

_THREADS = 2
_OPTIONS = {
    "preset": "superfast",
    "tune": "zerolatency",
    "profile": "high",
    "x264-params": "repeat-headers=1",
}
_LIMITED_RANGE, _SMPTE170M = 1, 6  # AVCOL_RANGE_MPEG; BT.601 with the primaries and curve of 525 lines


class VideoEncoder:
    """Encodes YUV 4:2:0 pictures one by one, each as soon as it comes.

    Raises
    ------
    HardwareError
        If no libx264 can be had.
    """

    def __init__(self, camera: "CameraTable", width: int, height: int) -> None:
        try:
            encoder = av.CodecContext.create("libx264", "w")
        except (av.error.FFmpegError, ValueError) as e:
            raise HardwareError(
                f"this PyAV has no libx264 encoder: {e}. Install PyAV from its own wheels"
            ) from e
        if not isinstance(encoder, VideoCodecContext):
            raise HardwareError("libx264 is no video encoder here; install PyAV from its own wheels")
        encoder.width, encoder.height, encoder.pix_fmt = width, height, "yuv420p"
        encoder.framerate = Fraction(round(camera.frame_rate_hz))
        encoder.bit_rate = camera.bitrate_bps
        encoder.gop_size = camera.iperiod
        encoder.max_b_frames = 0
        encoder.thread_count = _THREADS
        encoder.color_range, encoder.colorspace = _LIMITED_RANGE, _SMPTE170M
        encoder.color_primaries, encoder.color_trc = _SMPTE170M, _SMPTE170M
        encoder.options = dict(_OPTIONS)
        encoder.open()
        self._encoder = encoder
        self._size = width, height
        self._n = 0
        self._stamps_us: dict[int, int] = {}
        self.name = f"libx264 by PyAV {av.__version__}"
        self.settings: dict[str, str | int | float | bool | None] = {
            **_OPTIONS, "bitrate_bps": camera.bitrate_bps, "iperiod": camera.iperiod, "threads": _THREADS
        }  # fmt: skip

    def encode(self, abs_us: int, luma: Plane, chroma_u: Plane, chroma_v: Plane) -> list[EncodedPacket]:
        """Return the packets that this picture, stamped ``abs_us``, makes: one, without delay."""
        frame = VideoFrame(*self._size, "yuv420p")
        for plane, values in zip(frame.planes, (luma, chroma_u, chroma_v), strict=True):
            _fill(plane, values)
        frame.pts = self._n
        frame.pict_type = PictureType.NONE
        self._stamps_us[self._n] = abs_us
        self._n += 1
        return [
            EncodedPacket(self._stamps_us.pop(int(p.pts or 0)), bool(p.is_keyframe), bytes(p))
            for p in self._encoder.encode(frame)
        ]


def _fill(plane: Any, values: Plane) -> None:
    rows = np.frombuffer(plane, dtype=np.uint8).reshape(plane.height, plane.line_size)
    rows[:, : values.shape[1]] = values
