"""PiCamera over the real picamera2, libcamera and libx264, inside the virtual Pi's camera root."""

import dataclasses
import errno
import threading
import time
from itertools import pairwise
from statistics import median

import av
import pytest
import virtual_sensor
from picamera2 import Picamera2
from picamera2.dma_heap import DmaHeap

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import HardwareError
from bricktrack_device.hardware.camera_settings import CameraMode, PiCameraSettings
from bricktrack_device.hardware.pi_camera import PiCamera
from bricktrack_device.interfaces import EncodedPacket, FrameMetadata

SIZE = (640, 480)
SETTINGS = PiCameraSettings(
    mode=CameraMode("virtual", SIZE, SIZE),
    picture_format="NV12",
    bitrate_bps=2_000_000,
    iperiod=12,
    rate_tolerance=1.0,  # its stamps are made by a thread that this machine may delay
    camera_num=next(i for i, c in enumerate(Picamera2.global_camera_info()) if "Virtual" in c["Id"]),
)


class Sink:
    """Keeps everything; can be told to fail."""

    def __init__(self):
        self.packets: list[EncodedPacket] = []
        self.metadata: list[FrameMetadata] = []
        self.fails = False

    def on_packet(self, packet):
        if self.fails:
            raise OSError(errno.ENOSPC, "no room")
        self.packets.append(packet)

    def on_metadata(self, metadata):
        self.metadata.append(metadata)


def camera(**changes):
    settings = dataclasses.replace(SETTINGS, **changes)
    return PiCamera(settings, line_time=lambda model, camera_id: virtual_sensor.LINE_TIME_NS)


@pytest.fixture(autouse=True)
def good_sensor():
    virtual_sensor.quirks.__init__()
    yield
    virtual_sensor.quirks.__init__()


def wait_for(condition, timeout_s=20.0):
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)


def test_every_packet_carries_the_absolute_stamp_of_its_frame():
    sink, unit = Sink(), camera()
    before_ns = monotonic_ns()
    section = unit.start(sink)
    try:
        wait_for(lambda: len(sink.packets) >= 60)
        assert unit.problem() is None
    finally:
        unit.stop()
    after_ns = monotonic_ns()

    assert section.exposure_us == 1984  # 105 whole lines of 18.9035 us in the 2000 us asked for
    assert section.frame_duration_us == 33326  # 1763 whole lines in 33333 us: 30.006 Hz
    assert section.mode.line_time_ns == virtual_sensor.LINE_TIME_NS
    assert (section.mode.width, section.mode.height, section.mode.binning) == (640, 480, 1)
    assert section.encoder == "libx264"
    assert section.encoder_settings["preset"] == "superfast"
    assert section.encoder_settings["buffers"] == 6

    stamps_us = {m.sensor_timestamp_ns // 1000 for m in sink.metadata}
    assert all(p.abs_us in stamps_us for p in sink.packets)
    times = [p.abs_us for p in sink.packets]
    assert times == sorted(set(times))
    assert before_ns // 1000 < times[0] < times[-1] < after_ns // 1000
    # The virtual sensor is paced at 30 Hz by a thread, on one CPU under ptrace: no more than this can be said.
    assert median(b - a for a, b in pairwise(times)) == pytest.approx(33333, rel=0.5)

    assert sink.packets[0].keyframe
    keyframes = [i for i, p in enumerate(sink.packets) if p.keyframe]
    assert keyframes[:4] == [0, 12, 24, 36]
    # From any keyframe on, the stream decodes: parameter sets are repeated.
    assert n_decoded(sink.packets[24:]) == len(sink.packets) - 24


def n_decoded(packets):
    codec = av.CodecContext.create("h264", "r")
    n = sum(len(codec.decode(p)) for p in codec.parse(b"".join(p.data for p in packets)))
    n += sum(len(codec.decode(p)) for p in codec.parse(None))
    return n + len(codec.decode(None))


def test_it_starts_again_after_a_stop():
    unit = camera()
    for _ in range(2):
        sink = Sink()
        unit.start(sink)
        unit.stop()
        assert sink.packets[0].keyframe
    unit.stop()


@pytest.mark.parametrize(
    ("quirk", "words"),
    [
        ({"exposure_us": 9000}, r"exposure is 8998 us, wanted 2000 us"),
        ({"gain_wanders": True}, r"the values wander: analogue_gain from"),
        ({"without": "ExposureTime"}, r"frames come without ExposureTime"),
        ({"crop": (100, 0, 540, 480)}, r"the picture shows \(100, 0, 540, 480\) of the sensor"),
    ],
)
def test_a_camera_that_does_not_obey_is_refused(quirk, words):
    for name, value in quirk.items():
        setattr(virtual_sensor.quirks, name, value)
    unit, sink = camera(), Sink()
    with pytest.raises(HardwareError, match=words):
        unit.start(sink)
    assert not sink.packets
    for name in quirk:
        setattr(virtual_sensor.quirks, name, type(virtual_sensor.quirks)().__dict__[name])
    unit.start(Sink())
    unit.stop()


def test_a_size_that_libcamera_changes_is_refused():
    odd = (600, 400)
    with pytest.raises(HardwareError, match=r"picture size is .* wanted \(600, 400\)"):
        camera(mode=CameraMode("odd", odd, odd)).start(Sink())


def test_a_sink_that_fails_does_not_kill_the_stream():
    sink, unit = Sink(), camera()
    unit.start(sink)
    sink.fails = True
    n = len(sink.metadata)
    wait_for(lambda: len(sink.metadata) > n + 20)
    assert "frames were lost on the way" in unit.problem()
    sink.fails = False
    n = len(sink.packets)
    wait_for(lambda: len(sink.packets) > n + 5)
    unit.stop()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_dead_camera_thread_is_seen_and_stopping_does_not_hang():
    sink, unit = Sink(), camera()
    unit.start(sink)

    def post_callback(request):
        raise OSError(errno.ENOSPC, "as picamera2's own outputs raise on a full disk")

    unit._picam2.post_callback = post_callback
    wait_for(lambda: "thread has died" in (unit.problem() or ""))
    start = time.monotonic()
    unit.stop()
    assert time.monotonic() - start < 5
    sink = Sink()
    unit.start(sink)
    unit.stop()
    assert sink.packets


def test_a_stop_that_hangs_ends_in_an_error_and_stays_one():
    unit = camera()
    unit.start(Sink())
    forever = threading.Event()
    stop, unit._picam2.stop = unit._picam2.stop, forever.wait
    picam2, encoder = unit._picam2, unit._encoder
    start = time.monotonic()
    with pytest.raises(HardwareError, match=r"did not stop within"):
        unit.stop()
    assert time.monotonic() - start < 5
    with pytest.raises(HardwareError, match=r"restart bricktrackd"):
        unit.start(Sink())
    forever.set()
    picam2.stop = stop
    picam2.stop()
    picam2.stop_encoder(encoder)
    picam2.close()


class SmallHeap:
    """Refuses a number of allocations, as the kernel does without room for one more buffer."""

    def __init__(self, n_refused):
        self.n_refused = n_refused
        self.alloc = DmaHeap.alloc

    def __call__(self, heap, name, size):
        if self.n_refused:
            self.n_refused -= 1
            raise OSError(errno.ENOMEM, "Cannot allocate memory")
        return self.alloc(heap, name, size)


def test_short_memory_means_fewer_buffers(monkeypatch):
    heap = SmallHeap(n_refused=2)
    monkeypatch.setattr(DmaHeap, "alloc", lambda self, name, size: heap(self, name, size))
    unit = camera()
    assert unit.start(Sink()).encoder_settings["buffers"] == 4
    unit.stop()
    heap.n_refused = 99
    with pytest.raises(HardwareError, match=r"no memory for 5 picture buffers.*CMA"):
        camera(buffer_counts=(6, 5)).start(Sink())


def test_a_camera_that_is_not_there_is_named():
    with pytest.raises(HardwareError, match=r"camera 7 does not exist: libcamera finds"):
        camera(camera_num=7).start(Sink())
