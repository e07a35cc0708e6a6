import socket
import time
from collections.abc import Iterator

import msgpack
import pytest
import zmq
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bricktrack_common.errors import DeviceError
from bricktrack_common.wire_codec import decode_reply, encode_message
from bricktrack_common.wire_messages import (
    MAX_HEADER_BYTES,
    Arm,
    Armed,
    Chunk,
    Disarm,
    GetStatus,
    Hello,
    HelloReply,
    Read,
    Refusal,
    Reply,
    Request,
)
from bricktrack_device.network.file_server import Answer, FileServer
from bricktrack_device.refusals import RequestRefusedError

DATA = bytes(range(256)) * 100


class Handler:
    """Answers Hello and Read at once, keeps Arm for later, refuses Disarm, breaks on GetStatus."""

    def __init__(self) -> None:
        self.kept: list[Answer] = []
        self.is_busy = False

    def handle(self, request: Request, answer: Answer) -> None:
        if isinstance(request, Hello):
            answer(HelloReply(unit="unit-1", software="test", simulated=True), None)
        elif isinstance(request, Read):
            data = DATA[request.offset : request.offset + request.length]
            answer(
                Chunk(run_id=request.run_id, file_index=0, offset=request.offset, n_bytes=len(data), crc32=0),
                data,
            )
        elif isinstance(request, Arm):
            self.kept.append(answer)
        elif isinstance(request, Disarm):
            raise RequestRefusedError("wrong-state", "not now")
        else:
            raise ZeroDivisionError("a bug")


class Host:
    """A DEALER that speaks to the server."""

    def __init__(self, port: int) -> None:
        self.context = zmq.Context()
        self.socket = self.context.socket(zmq.DEALER)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.connect(f"tcp://127.0.0.1:{port}")

    def send(self, *frames: bytes) -> None:
        self.socket.send_multipart(list(frames))

    def receive(self, timeout_ms: int = 5000) -> tuple[int, Reply, list[bytes]]:
        assert self.socket.poll(timeout_ms), "no reply came"
        header, *rest = self.socket.recv_multipart()
        request_id, reply = decode_reply(header)
        return request_id, reply, rest

    def ask(self, request: Request, request_id: int = 1) -> tuple[Reply, list[bytes]]:
        self.send(encode_message(request_id, request))
        got_id, reply, rest = self.receive()
        assert got_id == request_id
        return reply, rest

    def close(self) -> None:
        self.socket.close()
        self.context.term()


@pytest.fixture(scope="module")
def handler() -> Handler:
    return Handler()


@pytest.fixture(scope="module")
def server(handler: Handler) -> Iterator[FileServer]:
    made = FileServer("127.0.0.1", 0, handler)
    made.start()
    yield made
    made.stop()


@pytest.fixture(scope="module")
def host(server: FileServer) -> Iterator[Host]:
    made = Host(server.port)
    yield made
    made.close()


def test_requests_are_answered_and_chunk_bytes_come_as_a_raw_frame(host: Host) -> None:
    reply, rest = host.ask(Hello(software="x"), 7)
    assert isinstance(reply, HelloReply) and rest == []
    reply, rest = host.ask(Read(run_id="r", file_index=0, offset=10, length=1000), 8)
    assert isinstance(reply, Chunk) and rest == [DATA[10:1010]] and reply.n_bytes == 1000


def test_a_late_answer_finds_its_host_while_others_are_served(host: Host, handler: Handler) -> None:
    host.send(encode_message(21, Arm(label="a")))
    assert isinstance(host.ask(Hello(software="x"), 22)[0], HelloReply)
    handler.kept.pop()(Armed(run_id="r1", missing=[]), None)  # from this thread, not the server's
    request_id, reply, _ = host.receive()
    assert request_id == 21 and isinstance(reply, Armed)


def test_refusals_and_bugs_become_refusals_with_codes(host: Host, caplog: pytest.LogCaptureFixture) -> None:
    reply, _ = host.ask(Disarm())
    assert isinstance(reply, Refusal) and (reply.code, reply.message) == ("wrong-state", "not now")
    reply, _ = host.ask(GetStatus())
    assert isinstance(reply, Refusal) and reply.code == "internal" and "ZeroDivisionError" in reply.message
    assert "a bug in the file server" in caplog.text
    assert isinstance(host.ask(Hello(software="x"))[0], HelloReply)


@pytest.mark.parametrize(
    ("message", "code", "request_id"),
    [
        ({"protocol": 1, "request_id": 5, "body": {"type": "hello", "software": "x"}}, "bad-version", 5),
        ({"protocol": 2, "minor": 0, "request_id": 6, "body": {"type": "shutdown"}}, "bad-message", 6),
        ({"protocol": 2, "minor": 0, "request_id": 7, "body": {"type": "hello", "software": "x", "more": 1}}, "bad-message", 7),
        ({"protocol": 2, "minor": 0, "request_id": 8, "body": {"type": "describe", "run_id": "../etc/passwd"}}, "bad-message", 8),
        ({"protocol": 2, "minor": 0, "request_id": -1, "body": {"type": "hello", "software": "x"}}, "bad-message", 0),
        ({"protocol": 2, "minor": 0, "request_id": 9,
          "body": {"type": "read", "run_id": "r", "file_index": 0, "offset": 0, "length": 1 << 30}},
         "bad-message", 9),
        ([1, 2, 3], "bad-message", 0),
    ],
)  # fmt: skip
def test_messages_that_are_not_of_the_protocol_are_refused(
    host: Host, message: object, code: str, request_id: int
) -> None:
    host.send(msgpack.packb(message))
    got_id, reply, _ = host.receive()
    assert isinstance(reply, Refusal) and (reply.code, got_id) == (code, request_id) and reply.message


@pytest.mark.parametrize("frames", [[b""], [b"", b"x"], [b"a", b"b", b"c"]])
def test_a_wrong_number_of_frames_is_refused(host: Host, frames: list[bytes]) -> None:
    host.send(*frames)
    _, reply, _ = host.receive()
    assert isinstance(reply, Refusal) and reply.code == "bad-message"


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.binary(max_size=300) | st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=8) | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=10), inner, max_size=4), max_leaves=12,
).map(lambda value: msgpack.packb(value)))  # fmt: skip
def test_arbitrary_bytes_are_refused_and_the_server_lives(host: Host, data: bytes) -> None:
    host.send(data)
    _, reply, _ = host.receive()
    assert isinstance(reply, Refusal) and reply.code in ("bad-message", "bad-version")


def test_a_message_over_the_limit_ends_that_connection_only(server: FileServer, host: Host) -> None:
    bully = Host(server.port)
    bully.send(b"x" * (MAX_HEADER_BYTES + 1))
    assert not bully.socket.poll(300)
    bully.close()
    assert isinstance(host.ask(Hello(software="x"))[0], HelloReply)


def test_bytes_that_are_not_zeromq_do_no_harm(server: FileServer, host: Host) -> None:
    with socket.create_connection(("127.0.0.1", server.port)) as raw:
        raw.sendall(b"GET / HTTP/1.1\r\nHost: brick\r\n\r\n" * 10)
        time.sleep(0.05)
    assert isinstance(host.ask(Hello(software="x"))[0], HelloReply)


def test_a_host_that_leaves_before_its_answer_does_no_harm(
    server: FileServer, host: Host, handler: Handler
) -> None:
    gone = Host(server.port)
    gone.send(encode_message(1, Arm()))
    deadline = time.monotonic() + 5
    while not handler.kept:
        assert time.monotonic() < deadline
        time.sleep(0.005)
    gone.close()
    time.sleep(0.1)
    handler.kept.pop()(Armed(run_id="r1", missing=[]), None)
    assert isinstance(host.ask(Hello(software="x"))[0], HelloReply)


def test_a_taken_port_is_a_clear_error_naming_the_address(server: FileServer, handler: Handler) -> None:
    with pytest.raises(DeviceError, match=rf"127\.0\.0\.1 port {server.port}.*another"):
        FileServer("127.0.0.1", server.port, handler)


def test_nothing_but_loopback_is_served(handler: Handler) -> None:
    with pytest.raises(DeviceError, match="loopback"):
        FileServer("0.0.0.0", 0, handler)


def test_stopping_frees_the_port(handler: Handler) -> None:
    first = FileServer("127.0.0.1", 0, handler)
    first.start()
    assert first.beat_age_s < 5
    first.stop()
    assert first.beat_age_s == float("inf")
    again = FileServer("127.0.0.1", first.port, handler)
    again.stop()
