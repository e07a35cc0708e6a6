"""From the encoder's thread to the frame sink: absolute times, and no error that could kill that thread.

picamera2 calls an output in its encoder's or camera's thread. An exception there ends the thread without a
word: the encoder still says that it runs, and stopping waits for ever. So nothing leaves this module's calls.
"""

from collections.abc import Callable
from typing import Any, Protocol

from bricktrack_common.clocks import monotonic_ns
from bricktrack_device.hardware.camera_checks import FrameReport, read_report
from bricktrack_device.interfaces import EncodedPacket, FrameMetadata, FrameSink

_MAX_AHEAD_NS = 5_000_000


def _refuse_future(stamp_ns: int, now_ns: int) -> None:
    """Raise on a stamp that cannot be: one far ahead would push every picture before it out of the ring."""
    if stamp_ns > now_ns + _MAX_AHEAD_NS:
        raise ValueError(f"a frame's stamp lies {(stamp_ns - now_ns) / 1e6:.1f} ms in the future")


class TimedEncoder(Protocol):
    """What is needed of a picamera2 encoder."""

    @property
    def firsttimestamp(self) -> int | None:
        """SensorTimestamp of the first frame encoded, us; `None` before it."""
        ...


class PacketTap:
    """Hands encoded packets to a sink, stamped with their frame's SensorTimestamp.

    Attributes
    ----------
    n_packets, n_failed : int
        Packets handed on, and packets that were not.
    last_error : Exception or None
        Why the last one was not.
    """

    def __init__(
        self, encoder: TimedEncoder, sink: FrameSink, *, clock: Callable[[], int] = monotonic_ns
    ) -> None:
        self._encoder = encoder
        self._sink = sink
        self._clock = clock
        self.n_packets = 0
        self.n_failed = 0
        self.last_error: Exception | None = None

    def take(self, data: bytes, keyframe: bool, timestamp_us: int | None) -> None:
        """Take one packet; ``timestamp_us`` counts from the first encoded frame."""
        try:
            first_us = self._encoder.firsttimestamp
            if first_us is None or timestamp_us is None:
                raise ValueError("the encoder gave a packet without a time stamp")
            abs_us = first_us + timestamp_us
            _refuse_future(abs_us * 1000, self._clock())
            self._sink.on_packet(EncodedPacket(abs_us, bool(keyframe), bytes(data)))
            self.n_packets += 1
        except Exception as e:  # noqa: BLE001  see the module's first lines
            self.n_failed += 1
            self.last_error = e


def output_of(tap: PacketTap) -> Any:
    """Return a picamera2 output that gives everything to a tap."""
    from picamera2.outputs import Output

    class RingOutput(Output):  # type: ignore[misc]  # picamera2 has no types
        """Hands packets on and does nothing else."""

        def outputframe(
            self,
            frame: bytes,
            keyframe: bool = True,
            timestamp: int | None = None,
            packet: object = None,
            audio: bool = False,
        ) -> None:
            """Take one packet, in the encoder's thread."""
            if not audio:
                tap.take(frame, keyframe, timestamp)

    return RingOutput()


class MetadataTap:
    """Hands each frame's metadata to a sink; picamera2's ``pre_callback``.

    Parameters
    ----------
    sink : FrameSink
    clock : callable
        CLOCK_MONOTONIC, ns.

    Attributes
    ----------
    on_report : callable or None
        Also hears of every frame, until it is set to `None`: used while the controls are being checked.
    n_frames, n_failed : int
    last_error : Exception or None
    newest_ns : int or None
        SensorTimestamp of the newest frame.
    """

    def __init__(self, sink: FrameSink, clock: Callable[[], int]) -> None:
        self._sink = sink
        self._clock = clock
        self.on_report: Callable[[FrameReport], None] | None = None
        self.n_frames = 0
        self.n_failed = 0
        self.last_error: Exception | None = None
        self.newest_ns: int | None = None

    def __call__(self, request: Any) -> None:
        """Take one frame, in the camera's thread."""
        try:
            arrival_ns = self._clock()
            report = read_report(request.get_metadata(), arrival_ns)
            _refuse_future(report.sensor_timestamp_ns, arrival_ns)
            self._sink.on_metadata(
                FrameMetadata(
                    sensor_timestamp_ns=report.sensor_timestamp_ns,
                    exposure_us=report.exposure_us,
                    analogue_gain=report.analogue_gain,
                    frame_duration_us=report.frame_duration_us,
                )
            )
            self.newest_ns = report.sensor_timestamp_ns
            self.n_frames += 1
            listener = self.on_report
            if listener is not None:
                listener(report)
        except Exception as e:  # noqa: BLE001  see the module's first lines
            self.n_failed += 1
            self.last_error = e
