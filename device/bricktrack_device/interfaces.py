"""What the daemon needs of the hardware: protocols that the real parts and the simulated ones both meet."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self

import gpiozero
import numpy as np
from numpy.typing import NDArray

from bricktrack_common.run_manifest import CameraSection

if TYPE_CHECKING:
    from bricktrack_device.config import DeviceConfig


@dataclass(frozen=True, slots=True)
class EncodedPacket:
    """One encoded picture, Annex-B.

    Attributes
    ----------
    abs_us : int
        SensorTimestamp of its frame in us, CLOCK_MONOTONIC: ``encoder.firsttimestamp + timestamp``.
    keyframe : bool
    data : bytes
    """

    abs_us: int
    keyframe: bool
    data: bytes


@dataclass(frozen=True, slots=True)
class FrameMetadata:
    """What the sensor said of one frame, encoded or not."""

    sensor_timestamp_ns: int
    exposure_us: int
    analogue_gain: float
    frame_duration_us: int


@dataclass(frozen=True, slots=True, eq=False)
class Still:
    """One picture, not encoded: YUV 4:2:0, limited range.

    Attributes
    ----------
    luma : ndarray of uint8, shape (height, width)
        16 is black, 235 white.
    chroma_u, chroma_v : ndarray of uint8, shape (height/2, width/2)
        128 is grey.
    """

    luma: NDArray[np.uint8]
    chroma_u: NDArray[np.uint8]
    chroma_v: NDArray[np.uint8]


class FrameSink(Protocol):
    """Where a camera hands its frames to. Both calls come from the camera's threads and must not block."""

    def on_packet(self, packet: EncodedPacket) -> None:
        """Take one encoded picture."""
        ...

    def on_metadata(self, metadata: FrameMetadata) -> None:
        """Take one frame's metadata; it may come before or after the frame's packet."""
        ...


class Camera(Protocol):
    """A camera that streams encoded pictures from `start` to `stop`."""

    def start(self, sink: FrameSink) -> CameraSection:
        """Configure, verify the fixed controls, begin to stream into ``sink``; say how pictures are taken.

        Raises
        ------
        HardwareError
            If the camera is missing or does not hold the controls it was given.
        """
        ...

    def still(self) -> Still | None:
        """Return a picture of now while streaming; `None` where none can be had. Never waits for long."""
        ...

    def problem(self) -> str | None:
        """Return in words what is wrong with a camera that should stream, or `None`; cheap."""
        ...

    def stop(self) -> None:
        """Stop streaming; frames under way may be lost. Calling it twice does no harm."""
        ...


class Leds(Protocol):
    """LEDs that the unit can switch, all together; as a context it switches them off in the end."""

    def switch(self, on: bool) -> tuple[int, int]:
        """Switch; return CLOCK_MONOTONIC before and after, ns."""
        ...

    def close(self) -> None:
        """Switch off and give the pins back. Calling it twice does no harm."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class I2cBus(Protocol):
    """An I2C bus as the Adafruit driver wants it, and one burst read for the hot path."""

    def try_lock(self) -> bool:
        """Take the bus; tell whether that worked."""
        ...

    def unlock(self) -> None:
        """Give the bus back."""
        ...

    def writeto(self, address: int, buffer: bytes, *, start: int = 0, end: int | None = None) -> None:
        """Write bytes to a device."""
        ...

    def readfrom_into(
        self, address: int, buffer: bytearray, *, start: int = 0, end: int | None = None
    ) -> None:
        """Read bytes from a device into ``buffer``."""
        ...

    def writeto_then_readfrom(
        self, address: int, out_buffer: bytes, in_buffer: bytearray, *, out_start: int = 0,
        out_end: int | None = None, in_start: int = 0, in_end: int | None = None,
    ) -> None:  # fmt: skip
        """Write, then read with a repeated start."""
        ...

    def read_burst(self, address: int, register: int, n_bytes: int) -> bytes:
        """Read consecutive registers in one transaction; raise `OSError` with its errno on failure."""
        ...

    def close(self) -> None:
        """Release the bus."""
        ...


BusOpener = Callable[[], I2cBus]
"""Opens a bus; passes to a spawned process as an argument, because each sampler opens its own bus."""


class Rig(Protocol):
    """All the hardware of a unit, real or simulated; made by `backends.open_rig` alone."""

    simulated: bool

    def configure(self, config: "DeviceConfig") -> None:
        """Use another configuration from the next opening of a part on."""
        ...

    def open_camera(self) -> Camera:
        """Return the camera, not yet started."""
        ...

    def pin_factory(self) -> gpiozero.Factory:
        """Return the gpiozero factory that makes the trigger's pin."""
        ...

    def bus_opener(self, bus: str) -> BusOpener:
        """Return what opens the named I2C bus."""
        ...

    def leds(self, pins: Sequence[str], *, active_high: bool = True) -> Leds:
        """Return the LEDs on some pins, switched off; raise `HardwareError` where a pin cannot be had."""
        ...

    def on_armed(self, t_armed_ns: int) -> None:
        """Hear that the unit is armed: a simulated table schedules its shake, a real one does nothing."""
        ...

    def write_truth(self, folder: Path, *, start_ns: int, end_ns: int) -> Path | None:
        """Write the true motion beside a simulated run and return the file; `None` on hardware."""
        ...

    def describe(self) -> dict[str, str]:
        """Return model, kernel and the like, for the manifest's ``hardware``."""
        ...

    def close(self) -> None:
        """Release everything."""
        ...
