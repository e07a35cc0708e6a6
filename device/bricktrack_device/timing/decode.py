"""Luma planes of recorded packets, by the PyAV that picamera2 brings along."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bricktrack_common.errors import HardwareError
from bricktrack_device.interfaces import EncodedPacket


def decode_luma(packets: Sequence[EncodedPacket]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield each packet's index and luma plane, shape (height, width); those that do not decode are left out.

    Parameters
    ----------
    packets : sequence of EncodedPacket
        From a keyframe on, in order of time.

    Raises
    ------
    HardwareError
        If there is no PyAV here.
    """
    try:
        import av
        from av.video.codeccontext import VideoCodecContext
        from av.video.frame import VideoFrame
    except ImportError as e:
        raise HardwareError(
            f"PyAV does not import: {e}. It reads the recorded rows; sudo apt install python3-av"
        ) from e
    decoder = av.CodecContext.create("h264", "r")
    if not isinstance(decoder, VideoCodecContext):
        raise HardwareError("this PyAV has no H.264 decoder; sudo apt install python3-av")

    def planes(frames: Sequence[VideoFrame]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        for frame in frames:
            if frame.pts is not None:
                plane: Any = frame.planes[0]  # it has the buffer protocol, which its types do not say
                rows = np.frombuffer(plane, dtype=np.uint8).reshape(plane.height, plane.line_size)
                yield int(frame.pts), rows[:, : frame.width].copy()

    for i, encoded in enumerate(packets):
        packet = av.Packet(encoded.data)
        packet.pts = packet.dts = i
        try:
            yield from planes(decoder.decode(packet))
        except av.error.InvalidDataError:
            continue
    yield from planes(decoder.decode(None))
