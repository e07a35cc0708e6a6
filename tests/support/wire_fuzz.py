"""Messages that are almost right, and what a decoder may do with them: return a checked value, or refuse."""

import random
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field

import msgpack
import msgspec
import zmq

from bricktrack_common.clocks import ClockTriplet
from bricktrack_common.discovery import parse_announcement
from bricktrack_common.errors import BricktrackError, ConfigError, ProtocolError
from bricktrack_common.key_files import check_public_key
from bricktrack_common.wire_codec import VersionError, decode_reply, decode_request, encode_message
from bricktrack_common.wire_messages import (
    MAX_CHUNK_BYTES,
    MAX_HEADER_BYTES,
    Arm,
    Armed,
    Chunk,
    Configure,
    Configured,
    Confirm,
    Confirmed,
    Deleted,
    DeleteRun,
    DescribeRun,
    Disarm,
    Disarmed,
    FileSummary,
    GetStatus,
    HealthItem,
    Hello,
    HelloReply,
    ImuStatus,
    ListRuns,
    Read,
    Refusal,
    Request,
    RunDescription,
    RunList,
    RunSummary,
    StatusReply,
    StillImage,
    TakeStill,
)
from bricktrack_device.network.file_server import Answer, FileServer
from bricktrack_host.transfer.unit_client import UnitClient

SHA = "0123456789abcdef" * 4
REQUESTS = [
    Hello(software="bricktrack 1"), GetStatus(), Arm(label="a", duration_s=3.0), Disarm(), ListRuns(),
    DescribeRun(run_id="u_1"), Read(run_id="u_1", file_index=1, offset=0, length=1000),
    Confirm(run_id="u_1", sha256=[SHA, SHA]), DeleteRun(run_id="u_1", force=True),
    TakeStill(encoding="jpeg", lit=False),
    Configure(values={"camera.exposure_us": 500, "camera.colour_gains": [1.0, 2.0], "recording.label": None}),
]  # fmt: skip
REPLIES = [
    HelloReply(unit="u", software="b", simulated=True),
    StatusReply(
        unit="u", state="armed", run_id="u_1", runs=3, disk_free_bytes=10**10, disk_needed_bytes=10**8, frames=7,
        frame_age_ms=12.5, imus=[ImuStatus(name="brick", samples=5, gaps=0, calibration=255)], edges=0,
        line_is_high=False, temperature_degc=41.5, clocks=ClockTriplet(monotonic_ns=1, boottime_ns=2, realtime_ns=3),
        health=[HealthItem(name="clocks", level="ok", words="fine")], health_age_s=1.5,
    ),
    Armed(run_id="u_1", missing=["imu base"]), Disarmed(),
    RunList(runs=[RunSummary(run_id="u_1", state="complete", n_bytes=5, confirmed=False)]),
    RunDescription(run_id="u_1", files=[FileSummary(name="manifest.json", n_bytes=5, sha256=SHA)]),
    Chunk(run_id="u_1", file_index=0, offset=0, n_bytes=5, crc32=7), Confirmed(run_id="u_1"),
    Deleted(run_id="u_1", n_bytes=5), Configured(values={"leds.count": 7}, changed=["leds.count"]),
    StillImage(
        encoding="png", width_px=4, height_px=4, n_bytes=9, crc32=1, model="m", mode="x", exposure_us=5,
        analogue_gain=1.0, colour_gains=(1.0, 1.0), lit=None, taken_ns=5, simulated=True,
    ),
    Refusal(code="busy", message="no"),
]  # fmt: skip
_ODD = [
    None, True, False, 0, -1, 2**53, 2**53 + 1, 2**63, -(2**63), 2**64 - 1, 0.0, -0.0, 1e308, float("nan"),
    float("inf"), "", "\0", "../../etc/passwd", "/", "a" * 3000, "\ud7ff", b"", b"\xff" * 9, [], {}, [[]] * 3,
    {"": 0}, {"type": "read"}, "hello", "nan", 2.5,
]  # fmt: skip


@dataclass
class Tally:
    """What became of the messages."""

    cases: int = 0
    accepted: int = 0
    refused: int = 0
    by_target: dict[str, int] = field(default_factory=dict)

    def count(self, target: str, *, accepted: bool) -> None:
        self.cases += 1
        self.accepted += accepted
        self.refused += not accepted
        self.by_target[target] = self.by_target.get(target, 0) + 1


def messages(rng: random.Random) -> Iterator[bytes]:
    """Yield messages without end: right ones, changed ones, cut ones, noise."""
    plain = [msgspec.to_builtins(body) for body in (*REQUESTS, *REPLIES)]
    seeds = [encode_message(i, body) for i, body in enumerate((*REQUESTS, *REPLIES))]
    while True:
        kind = rng.random()
        if kind < 0.05:
            yield rng.choice(seeds)
        elif kind < 0.50:
            yield _mutated_bytes(rng, rng.choice(seeds))
        elif kind < 0.95:
            yield _packed(_mutated_value(rng, plain))
        else:
            yield rng.randbytes(rng.randrange(0, 200))


def _mutated_bytes(rng: random.Random, data: bytes) -> bytes:
    out = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(out) + 1)
        what = rng.randrange(5)
        if what == 0 and out:
            out[at % len(out)] = rng.randrange(256)
        elif what == 1:
            out[at:at] = rng.randbytes(rng.randint(1, 8))
        elif what == 2:
            del out[at : at + rng.randint(1, 8)]
        elif what == 3 and out:
            out[at % len(out)] ^= 1 << rng.randrange(8)
        else:
            out[at:at] = out[rng.randrange(len(out) + 1) :][: rng.randint(1, 32)]
    return bytes(out)


def _mutated_value(rng: random.Random, plain: list[object]) -> object:
    message: dict[object, object] = {
        "protocol": rng.choice([2, 2, 2, 2, 1, 3, -1, True, "2", None]),
        "minor": rng.choice([0, 0, 0, 1, 7, -1, 2**60, None, "0"]),
        "request_id": rng.choice([0, 1, 2**53, 2**53 + 1, -1, None, 1.5]),
        "body": dict(rng.choice(plain)),  # type: ignore[call-overload]
    }
    body = message["body"]
    for _ in range(rng.randint(0, 3)):
        target = message if rng.random() < 0.2 else body
        if not isinstance(target, dict) or not target:
            break
        key = rng.choice(list(target))
        action = rng.randrange(4)
        if action == 0:
            target[key] = rng.choice(_ODD)
        elif action == 1:
            del target[key]
        elif action == 2:
            target[rng.choice(["type", "path", "x", "", "run_id", "values", 5])] = rng.choice(_ODD)
        elif isinstance(target[key], list):
            target[key] = [*target[key], rng.choice(_ODD)] * rng.choice([1, 1, 40])
    return message


def _packed(value: object) -> bytes:
    try:
        return bytes(msgpack.packb(value))
    except (ValueError, OverflowError, UnicodeEncodeError):
        return b""


def try_decoders(data: bytes, tally: Tally) -> None:
    """Give bytes to both decoders; whatever they accept must survive a second time around."""
    for target, decode in (("request", decode_request), ("reply", decode_reply)):
        try:
            request_id, body = decode(data)
        except ProtocolError:
            tally.count(target, accepted=False)
            continue
        again = decode(encode_message(request_id, body))
        assert msgspec.msgpack.encode(again[1]) == msgspec.msgpack.encode(body)  # NaN is not equal to itself
        tally.count(target, accepted=True)


def try_texts(rng: random.Random, tally: Tally) -> None:
    """Give noise to what reads keys and announcements."""
    text = "".join(chr(rng.randrange(32, 300)) for _ in range(rng.choice([0, 39, 40, 40, 40, 41])))
    try:
        check_public_key(text, where="fuzz")
        tally.count("key", accepted=True)
    except ConfigError:
        tally.count("key", accepted=False)
    txt = {
        rng.choice([b"unit", b"protocol", b"key", b"x"]): rng.randbytes(rng.randrange(6)) for _ in range(4)
    }
    tally.count("announcement", accepted=parse_announcement(txt) is not None)


class _Handler:
    is_busy = False

    def handle(self, request: Request, answer: Answer) -> None:
        answer(
            HelloReply(unit="u", software="x", simulated=True), b"x" if isinstance(request, Read) else None
        )


def try_server(rng: random.Random, n: int, tally: Tally) -> None:
    """Send ``n`` messages to a real server: each has one reply, and the server lives."""
    server = FileServer("127.0.0.1", 0, _Handler())
    server.start()
    context = zmq.Context()
    socket = context.socket(zmq.DEALER)
    socket.setsockopt(zmq.LINGER, 0)
    socket.connect(f"tcp://127.0.0.1:{server.port}")
    source = messages(rng)
    try:
        for start in range(0, n, 16):
            size = min(16, n - start)
            for _ in range(size):
                data = next(source)
                extra = [b""] * (rng.random() < 0.02)
                socket.send_multipart([data[:MAX_HEADER_BYTES], *extra])
            for _ in range(size):
                assert socket.poll(10_000), "the server did not answer"
                reply = decode_reply(socket.recv_multipart()[0])[1]
                tally.count("server", accepted=not isinstance(reply, Refusal))
                assert not isinstance(reply, Refusal) or reply.code in (
                    "bad-message",
                    "bad-version",
                    "too-many",
                )
    finally:
        socket.close()
        context.term()
        server.stop()


def _speaks_another_version(data: bytes) -> bool:
    try:
        decode_reply(data)
    except VersionError:
        return True
    except ProtocolError:
        pass
    return False


def try_client(rng: random.Random, n: int, tally: Tally) -> None:
    """Answer a real client with ``n`` messages that are none, and then rightly: it finds the right one."""
    context = zmq.Context()
    unit = context.socket(zmq.ROUTER)
    unit.setsockopt(zmq.LINGER, 0)
    unit.setsockopt(zmq.SNDHWM, 0)
    port = unit.bind_to_random_port("tcp://127.0.0.1")
    stop = threading.Event()
    source = messages(rng)

    def answer() -> None:
        while not stop.is_set():
            if unit.poll(20):
                identity, header = unit.recv_multipart()
                request_id, _ = decode_request(header)
                for _ in range(16):
                    data = next(source)
                    # A message of another version ends the request, rightly, and one that is too long the
                    # connection; most requests shall go on to their end.
                    while len(data) > MAX_CHUNK_BYTES or (
                        _speaks_another_version(data) and rng.random() < 0.95
                    ):
                        data = next(source)
                    unit.send_multipart([identity, data, *[rng.randbytes(3)] * rng.choice([0, 0, 1, 2])])
                unit.send_multipart([identity, encode_message(request_id, REPLIES[0])])

    thread = threading.Thread(target=answer)
    thread.start()
    client = UnitClient(f"tcp://127.0.0.1:{port}", timeout_s=10)
    client._request_ids = iter(range(2**40, 2**50))  # no message above happens to have such a number
    try:
        for _ in range(0, n, 16):
            try:
                # A message of another version ends the request; all else is passed over.
                accepted = client.hello() == REPLIES[0]
            except BricktrackError as e:
                assert isinstance(e, ProtocolError), e
                accepted = False
            for _ in range(16):
                tally.count("client", accepted=accepted)
    finally:
        client.close()
        stop.set()
        thread.join()
        unit.close()
        context.term()
