"""Packets and metadata on their way out of the camera's threads."""

import errno

from bricktrack_device.hardware.packet_tap import MetadataTap, PacketTap
from bricktrack_device.interfaces import EncodedPacket, FrameMetadata


class Sink:
    def __init__(self) -> None:
        self.packets: list[EncodedPacket] = []
        self.metadata: list[FrameMetadata] = []
        self.error: Exception | None = None

    def on_packet(self, packet: EncodedPacket) -> None:
        if self.error:
            raise self.error
        self.packets.append(packet)

    def on_metadata(self, metadata: FrameMetadata) -> None:
        if self.error:
            raise self.error
        self.metadata.append(metadata)


class Encoder:
    firsttimestamp: int | None = 7_000_000


class Request:
    def __init__(self, **changes: object) -> None:
        self._metadata = {
            "SensorTimestamp": 123_456_789,
            "ExposureTime": 1984,
            "AnalogueGain": 1.0,
            "FrameDuration": 33326,
        } | changes

    def get_metadata(self) -> dict[str, object]:
        return self._metadata


def test_a_packets_stamp_is_absolute() -> None:
    sink = Sink()
    tap = PacketTap(Encoder(), sink)
    tap.take(b"\0\0\0\1", True, 0)
    tap.take(b"\0\0\1", False, 33_327)
    assert sink.packets == [
        EncodedPacket(7_000_000, True, b"\0\0\0\1"),
        EncodedPacket(7_033_327, False, b"\0\0\1"),
    ]
    assert (tap.n_packets, tap.n_failed, tap.last_error) == (2, 0, None)


def test_a_packets_bytes_are_kept_when_the_encoder_reuses_its_buffer() -> None:
    sink = Sink()
    buffer = bytearray(b"abc")
    PacketTap(Encoder(), sink).take(buffer, True, 0)  # type: ignore[arg-type]
    buffer[:] = b"xyz"
    assert sink.packets[0].data == b"abc"


def test_a_sinks_error_stays_out_of_the_encoders_thread() -> None:
    sink = Sink()
    sink.error = OSError(errno.ENOSPC, "full")
    tap = PacketTap(Encoder(), sink)
    tap.take(b"a", True, 0)
    assert (tap.n_packets, tap.n_failed) == (0, 1)
    assert tap.last_error is sink.error


def test_a_packet_without_a_time_is_not_handed_on() -> None:
    sink, encoder = Sink(), Encoder()
    tap = PacketTap(encoder, sink)
    tap.take(b"a", True, None)
    encoder.firsttimestamp = None
    tap.take(b"a", True, 5)
    assert (sink.packets, tap.n_failed) == ([], 2)


def test_a_stamp_in_the_future_is_refused_because_it_would_empty_the_ring() -> None:
    sink = Sink()
    packets = PacketTap(Encoder(), sink, clock=lambda: 7_040_000_000)
    for timestamp_us in (0, 33_327, 3_600_000_000, 39_000):
        packets.take(b"a", True, timestamp_us)
    assert [p.abs_us for p in sink.packets] == [7_000_000, 7_033_327, 7_039_000]
    assert packets.n_failed == 1 and "3599960.0 ms in the future" in str(packets.last_error)
    metadata = MetadataTap(sink, clock=lambda: 150_000_000)
    metadata(Request(SensorTimestamp=156_000_000))
    metadata(Request(SensorTimestamp=149_000_000))
    assert [m.sensor_timestamp_ns for m in sink.metadata] == [149_000_000] and metadata.n_failed == 1


def test_metadata_are_handed_on_with_what_a_run_keeps() -> None:
    sink = Sink()
    heard = []
    tap = MetadataTap(sink, clock=lambda: 150_000_000)
    tap.on_report = heard.append
    tap(Request(Lux=3.0))
    tap.on_report = None
    tap(Request(SensorTimestamp=148_000_000))
    assert sink.metadata[0] == FrameMetadata(123_456_789, 1984, 1.0, 33326)
    assert [r.arrival_ns for r in heard] == [150_000_000]
    assert (tap.n_frames, tap.newest_ns) == (2, 148_000_000)


def test_an_error_in_the_metadata_stays_out_of_the_cameras_thread() -> None:
    sink = Sink()
    tap = MetadataTap(sink, clock=lambda: 150_000_000)
    tap(Request(ExposureTime="none"))
    sink.error = RuntimeError("sink")
    tap(Request())
    assert (tap.n_frames, tap.n_failed) == (0, 2)
    assert tap.last_error is sink.error
