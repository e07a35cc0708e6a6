"""One picture of now from a unit that records nothing: for aiming, focus and calibration."""

import logging
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bricktrack_common.checksums import crc32
from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import BricktrackError, HardwareError
from bricktrack_common.run_manifest import CameraSection
from bricktrack_common.wire_messages import MAX_STILL_BYTES, StillEncoding, StillImage
from bricktrack_device.capture.camera_stream import CameraStream
from bricktrack_device.config import DeviceConfig
from bricktrack_device.interfaces import Rig, Still
from bricktrack_device.refusals import RequestRefusedError

if TYPE_CHECKING:
    import av

logger = logging.getLogger(__name__)

STILL_TIMEOUT_S = 5.0
_RING_NS = 1_000_000_000
_JPEG_QUALITY = 2  # FFmpeg's scale, 2 is the best
_POLL_S = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class TakenStill:
    """A picture, and how it was taken.

    Attributes
    ----------
    lit : bool or None
        Whether the LEDs were switched on for it; `None` where they hang on no pins.
    taken_ns : int
        CLOCK_MONOTONIC when the camera was asked.
    """

    still: Still
    section: CameraSection
    lit: bool | None
    taken_ns: int


def take_still(
    config: DeviceConfig,
    rig: Rig,
    *,
    lit: bool,
    beat: Callable[[], None],
    note_lost_camera: Callable[[str], None] = lambda words: None,
) -> TakenStill:
    """Start the camera as a run would, take a picture, and stop it again.

    Parameters
    ----------
    lit : bool
        Switch the LEDs on for it, where they hang on pins.
    beat : callable
        Called while waiting; raises to give up.
    note_lost_camera : callable
        Hears why only a new start of the daemon gives the camera back, or ``""``.

    Raises
    ------
    RequestRefusedError
        If the camera does not start or gives no picture.
    """
    pins = config.leds.pins
    try:
        leds = rig.leds(pins, active_high=config.leds.active_high) if pins else None
        with nullcontext() if leds is None else leds:
            if leds is not None:
                leds.switch(lit)
            stream = CameraStream(rig.open_camera, _RING_NS, beat=beat)
            try:
                return _picture_from(stream, lit=None if leds is None else lit, beat=beat)
            finally:
                try:
                    _stop(stream)
                finally:
                    note_lost_camera(stream.lost)
    except HardwareError as e:
        raise RequestRefusedError("not-ready", f"no picture: {e}") from e


def _picture_from(stream: CameraStream, *, lit: bool | None, beat: Callable[[], None]) -> TakenStill:
    section = stream.start()
    deadline = time.monotonic() + STILL_TIMEOUT_S
    while True:
        beat()
        taken_ns = monotonic_ns()
        still = stream.still()
        if still is not None:
            return TakenStill(still, section, lit, taken_ns)
        if time.monotonic() > deadline:
            raise HardwareError(
                f"{section.model} gave none within {STILL_TIMEOUT_S:g} s ({stream.ring.n_packets} pictures "
                "were encoded). Check the camera's cable, then run 'bricktrackd check'"
            )
        time.sleep(_POLL_S)


def _stop(stream: CameraStream) -> None:
    try:
        stream.stop()
    except (BricktrackError, OSError) as e:
        logger.warning("camera: %s", e)


def encode_still(taken: TakenStill, encoding: StillEncoding, *, simulated: bool) -> tuple[StillImage, bytes]:
    """Return a picture as a file's bytes, and what is said of it.

    Raises
    ------
    RequestRefusedError
        If PyAV is missing here, or the file gets too large to be sent.
    """
    height, width = taken.still.luma.shape
    data = encode_png(taken.still) if encoding == "png" else encode_jpeg(taken.still)
    if len(data) > MAX_STILL_BYTES:
        raise RequestRefusedError(
            "not-ready",
            f"the picture has {len(data)} bytes as {encoding}; at most {MAX_STILL_BYTES} are sent",
        )
    section = taken.section
    image = StillImage(
        encoding=encoding,
        width_px=width,
        height_px=height,
        n_bytes=len(data),
        crc32=crc32(data),
        model=section.model,
        mode=section.mode.name,
        exposure_us=section.exposure_us,
        analogue_gain=section.analogue_gain,
        colour_gains=section.colour_gains,
        lit=taken.lit,
        taken_ns=taken.taken_ns,
        simulated=simulated,
    )
    return image, data


def encode_png(still: Still) -> bytes:
    """Return the luma plane as a grey PNG, without loss: 16 is black, 235 white."""
    av = _av()
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(still.luma), format="gray")
    return _encoded(frame, "png", {"compression_level": "1", "pred": "up"})


def encode_jpeg(still: Still) -> bytes:
    """Return the picture as a colour JPEG of high quality, full range."""
    av = _av()
    planes = [still.luma.ravel(), still.chroma_u.ravel(), still.chroma_v.ravel()]
    width = still.luma.shape[1]
    frame = av.VideoFrame.from_ndarray(np.concatenate(planes).reshape(-1, width), format="yuv420p")
    frame = frame.reformat(format="yuvj420p", src_color_range="MPEG", dst_color_range="JPEG")
    return _encoded(frame, "mjpeg", {"qmin": str(_JPEG_QUALITY), "qmax": str(_JPEG_QUALITY)})


def _encoded(frame: "av.VideoFrame", codec: str, options: dict[str, str]) -> bytes:
    """Return one picture, encoded by one of FFmpeg's encoders for single pictures."""
    av = _av()
    encoder = av.CodecContext.create(codec, "w")
    encoder.width, encoder.height = frame.width, frame.height
    encoder.pix_fmt = frame.format.name
    encoder.framerate = 25  # a picture has none, but the encoder asks for one
    encoder.options = options
    frame.pts = 0
    return b"".join(bytes(packet) for packet in (*encoder.encode(frame), *encoder.encode(None)))


def _av() -> Any:
    try:
        import av
    except ModuleNotFoundError as e:
        raise RequestRefusedError(
            "not-ready",
            "pictures are encoded with PyAV, which is not installed on this unit; run apt install python3-av "
            "or pip install 'bricktrack[sim]' there",
        ) from e
    return av
