import threading
from itertools import pairwise

import numpy as np
import pytest

from bricktrack_common.frame_times import FrameFlag
from bricktrack_device.capture.ring import FrameRing, VideoCut, cut_video
from bricktrack_device.interfaces import EncodedPacket, FrameMetadata

PERIOD_NS = 33_327_000  # 30.0058 Hz, as an IMX219 runs when it is asked for 30
T_NS = 7_000_000_123


def stream(
    n: int, *, iperiod: int = 10, skip: tuple[int, ...] = ()
) -> tuple[list[EncodedPacket], list[FrameMetadata]]:
    stamps = [(i, T_NS + i * PERIOD_NS) for i in range(n) if i not in skip]
    packets = [EncodedPacket(t // 1000, i % iperiod == 0, bytes([i % 256]) * (5 + i % 3)) for i, t in stamps]
    metadata = [FrameMetadata(t, 1500 + i, 2.0, 33_327) for i, t in stamps]
    return packets, metadata


def cut(
    packets: list[EncodedPacket], metadata: list[FrameMetadata], start_ns: int, end_ns: int, **changes: int
) -> VideoCut:
    return cut_video(
        packets, metadata, start_ns=start_ns, end_ns=end_ns, first_abs_us=changes.get("first_abs_us", T_NS // 1000),
        period_us=33_333, default_exposure_us=999, default_gain=1.0,
    )  # fmt: skip


def at(i: int) -> int:
    return T_NS + i * PERIOD_NS


def test_a_cut_begins_at_the_last_keyframe_at_or_before_the_start() -> None:
    packets, metadata = stream(100)
    got = cut(packets, metadata, at(25), at(60))
    assert got.packets[0] is packets[20] and got.packets[-1] is packets[60]
    assert got.problems == [] and got.n_dropped == 0 and got.n_without_metadata == 0
    exact = cut(packets, metadata, at(30) // 1000 * 1000, at(60))
    assert exact.packets[0] is packets[30]


def test_records_hold_full_stamps_encoder_times_and_byte_places() -> None:
    packets, metadata = stream(40)
    got = cut(packets, metadata, at(12), at(30))
    stamps = [r.sensor_timestamp_ns for r in got.records]
    assert stamps == [at(i) for i in range(10, 31)]  # nanoseconds, from the metadata
    assert [r.pts_us for r in got.records] == [at(i) // 1000 - T_NS // 1000 for i in range(10, 31)]
    assert [r.exposure_us for r in got.records] == [1500 + i for i in range(10, 31)]
    offset = 0
    for record, packet in zip(got.records, got.packets, strict=True):
        assert (record.byte_offset, record.n_bytes) == (offset, len(packet.data))
        offset += len(packet.data)
    assert got.n_bytes == offset


def test_packets_and_metadata_meet_by_time_not_by_count() -> None:
    packets, metadata = stream(60)
    ahead = [FrameMetadata(T_NS - k * PERIOD_NS, 1, 9.0, 33_327) for k in (3, 2, 1)]  # frames never encoded
    del metadata[25]
    got = cut(packets, ahead + metadata[::-1], at(20), at(30))
    by_stamp = {r.sensor_timestamp_ns: r for r in got.records}
    for i in (20, 24, 26, 30):
        assert by_stamp[at(i)].exposure_us == 1500 + i and by_stamp[at(i)].flags == 0
    lost = by_stamp[at(25) // 1000 * 1000]
    assert lost.flags == FrameFlag.NO_METADATA and lost.exposure_us == 999
    assert got.n_without_metadata == 1


@pytest.mark.parametrize(("skip", "dropped"), [((), 0), ((24,), 1), ((24, 25, 26), 3), ((22, 24), 2)])
def test_gaps_over_one_and_a_half_periods_are_drops(skip: tuple[int, ...], dropped: int) -> None:
    packets, metadata = stream(60, skip=skip)
    got = cut(packets, metadata, at(20), at(50))
    assert got.n_dropped == dropped
    flagged = [r.sensor_timestamp_ns for r in got.records if r.flags & FrameFlag.GAP_BEFORE]
    after_gaps = [b.sensor_timestamp_ns for a, b in pairwise(got.records)
                  if b.sensor_timestamp_ns - a.sensor_timestamp_ns > 1.5 * PERIOD_NS]  # fmt: skip
    assert flagged == after_gaps


def test_losing_every_second_frame_is_not_taken_for_a_slower_camera() -> None:
    packets, metadata = stream(60, iperiod=10, skip=tuple(range(21, 60, 2)))
    got = cut(packets, metadata, at(20), at(50))
    assert got.n_dropped == 15


def test_a_stream_that_begins_late_or_ends_early_says_so() -> None:
    packets, metadata = stream(40)
    late = cut(packets, metadata, at(-15), at(30))
    assert late.packets[0] is packets[0] and "begins 499.9 ms after" in late.problems[0]
    early = cut(packets, metadata, at(10), at(45))
    assert "ends" in early.problems[0] and early.packets[-1] is packets[39]


def test_frames_missing_across_the_end_of_the_window_are_drops() -> None:
    packets, metadata = stream(60, skip=(39, 40, 41, 42))
    got = cut(packets, metadata, at(20), at(41) + 1000)
    assert got.packets[-1].abs_us == at(38) // 1000 and got.problems == [] and got.n_dropped == 3


def test_no_keyframe_in_reach_gives_an_empty_cut_in_words() -> None:
    packets, metadata = stream(30)
    headless = [EncodedPacket(p.abs_us, False, p.data) for p in packets]
    got = cut(headless, metadata, at(5), at(20))
    assert got.packets == [] and "no picture that can be decoded" in got.problems[0]
    assert cut([], [], at(5), at(20)).packets == []


def test_pictures_out_of_order_or_empty_are_left_out_in_words() -> None:
    packets, metadata = stream(40)
    packets[25] = EncodedPacket(packets[23].abs_us, False, b"x")
    packets[27] = EncodedPacket(packets[27].abs_us, False, b"")
    got = cut(packets, metadata, at(20), at(38))
    assert "2 pictures" in got.problems[0] and got.n_dropped == 2
    assert np.all(np.diff([r.sensor_timestamp_ns for r in got.records]) > 0)


def test_the_ring_forgets_by_time_and_counts_bytes() -> None:
    ring = FrameRing(10 * PERIOD_NS)
    packets, metadata = stream(50)
    for p, m in zip(packets, metadata, strict=True):
        ring.on_metadata(m)
        ring.on_packet(p)
    held, of_frames = ring.snapshot()
    assert held == packets[-11:] and of_frames == metadata[-11:]
    assert ring.n_bytes == sum(len(p.data) for p in held) and ring.n_packets == 50
    assert ring.first_abs_us == packets[0].abs_us == ring.first_keyframe_us
    assert ring.newest_us == packets[-1].abs_us


def test_a_camera_whose_stamps_stand_still_fills_no_memory() -> None:
    now = [T_NS]
    ring = FrameRing(10 * PERIOD_NS, clock=lambda: now[0])
    packets, metadata = stream(50)
    for i in range(50):
        now[0] = at(i) + PERIOD_NS // 2  # each comes half a period after its stamp
        ring.on_packet(packets[min(i, 30)])
        ring.on_metadata(metadata[min(i, 30)])
    held, of_frames = ring.snapshot()
    assert held == [packets[30]] * 11 and of_frames == [metadata[30]] * 11
    assert ring.n_bytes == 11 * len(packets[30].data) and ring.newest_us == packets[30].abs_us


def test_pictures_that_come_late_and_all_at_once_are_kept_for_the_whole_span() -> None:
    now = [at(60)]  # the unit stood still for longer than the span
    ring = FrameRing(10 * PERIOD_NS, clock=lambda: now[0])
    packets, _ = stream(50)
    for packet in packets:
        ring.on_packet(packet)
    assert ring.snapshot()[0] == packets[-11:]


def test_snapshots_are_whole_while_the_camera_appends() -> None:
    ring = FrameRing(20 * PERIOD_NS)
    packets, metadata = stream(4000)
    done = threading.Event()

    def camera() -> None:
        for p, m in zip(packets, metadata, strict=True):
            ring.on_packet(p)
            ring.on_metadata(m)
        done.set()

    thread = threading.Thread(target=camera)
    thread.start()
    while not done.is_set():
        held, _ = ring.snapshot()
        assert all(b.abs_us > a.abs_us for a, b in pairwise(held)) and len(held) <= 21
    thread.join()
