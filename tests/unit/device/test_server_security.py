"""The server against hosts that may not, programs that are none, and too many of either."""

import logging
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq

from bricktrack_common.errors import DeviceError
from bricktrack_common.key_files import KeyPair, make_key_pair, write_public_key, write_secret_key
from bricktrack_common.wire_codec import decode_reply, encode_message
from bricktrack_common.wire_messages import Hello, HelloReply, Refusal, Request
from bricktrack_device.network import connection_guard, file_server
from bricktrack_device.network.connection_guard import ConnectionGuard
from bricktrack_device.network.file_server import Answer, FileServer
from bricktrack_device.network.unit_keys import UnitKeys
from bricktrack_device.priority import NICENESS

HELLO = HelloReply(unit="unit-1", software="test", simulated=True)


class Handler:
    def __init__(self) -> None:
        self.is_busy = False
        self.n = 0
        self.thread_niceness: int | None = None

    def handle(self, request: Request, answer: Answer) -> None:
        self.n += 1
        self.thread_niceness = os.getpriority(os.PRIO_PROCESS, 0)
        answer(HELLO, None)


class Peer:
    """A DEALER with or without keys."""

    def __init__(self, port: int, *, own: KeyPair | None = None, server: str | None = None) -> None:
        self.context = zmq.Context()
        self.socket = self.context.socket(zmq.DEALER)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.setsockopt(zmq.RECONNECT_IVL, 50)
        if own is not None and server is not None:
            self.socket.curve_publickey = own.public.encode()
            self.socket.curve_secretkey = own.secret.encode()
            self.socket.curve_serverkey = server.encode()
        self.socket.connect(f"tcp://127.0.0.1:{port}")

    def is_answered(self, timeout_ms: int = 400) -> bool:
        self.socket.send(encode_message(1, Hello(software="x")))
        if not self.socket.poll(timeout_ms):
            return False
        return decode_reply(self.socket.recv()) == (1, HELLO)

    def __enter__(self) -> "Peer":
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()
        self.context.term()


@pytest.fixture
def host_keys() -> KeyPair:
    return make_key_pair()


@pytest.fixture
def keys(tmp_path: Path, host_keys: KeyPair) -> UnitKeys:
    write_secret_key(tmp_path / "unit.key_secret", make_key_pair(), what="unit")
    (tmp_path / "clients").mkdir()
    write_public_key(tmp_path / "clients" / "lab.key", host_keys.public, what="lab")
    return UnitKeys(tmp_path)


@pytest.fixture
def server(keys: UnitKeys) -> Iterator[FileServer]:
    made = FileServer("127.0.0.1", 0, Handler(), keys=keys)
    made.start()
    yield made
    made.stop()


def wait_for(condition, timeout_s: float = 5.0) -> None:  # type: ignore[no-untyped-def]
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_a_host_whose_key_is_known_is_served(server: FileServer, keys: UnitKeys, host_keys: KeyPair) -> None:
    with Peer(server.port, own=host_keys, server=keys.own.public) as peer:
        assert peer.is_answered(5000)


def test_a_stranger_is_refused_and_named_in_the_log(
    server: FileServer, keys: UnitKeys, caplog: pytest.LogCaptureFixture
) -> None:
    stranger = make_key_pair()
    for _ in range(3):
        with Peer(server.port, own=stranger, server=keys.own.public) as peer:
            assert not peer.is_answered()
    wait_for(lambda: stranger.public in caplog.text)
    assert caplog.text.count("refused a host at 127.0.0.1") == 1  # once a minute, however often it knocks


def test_the_wrong_server_key_and_no_key_get_nowhere_and_are_logged(
    server: FileServer, host_keys: KeyPair, caplog: pytest.LogCaptureFixture
) -> None:
    with Peer(server.port, own=host_keys, server=make_key_pair().public) as peer:
        assert not peer.is_answered()
    with Peer(server.port) as peer:
        assert not peer.is_answered()
    wait_for(lambda: "failed the handshake" in caplog.text)


def test_a_host_is_let_in_and_shut_out_without_a_restart(
    server: FileServer, keys: UnitKeys, host_keys: KeyPair
) -> None:
    new = make_key_pair()
    write_public_key(keys.clients_folder / "lab-new.key", new.public, what="lab")
    for pair in (host_keys, new):  # both count while a host changes its key
        with Peer(server.port, own=pair, server=keys.own.public) as peer:
            assert peer.is_answered(5000)
    (keys.clients_folder / "lab.key").unlink()
    with Peer(server.port, own=host_keys, server=keys.own.public) as peer:
        assert not peer.is_answered()
    with Peer(server.port, own=new, server=keys.own.public) as peer:
        assert peer.is_answered(5000)


def test_a_folder_of_keys_that_vanishes_shuts_everybody_out(
    server: FileServer, keys: UnitKeys, host_keys: KeyPair
) -> None:
    keys.clients_folder.rename(keys.folder / "elsewhere")
    with Peer(server.port, own=host_keys, server=keys.own.public) as peer:
        assert not peer.is_answered()


def test_without_a_gatekeeper_nobody_comes_in(
    keys: UnitKeys, host_keys: KeyPair, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Absent:
        def __init__(self, context: zmq.Context, keys: UnitKeys) -> None:
            self.socket = context.socket(zmq.PULL)

        def close(self) -> None:
            self.socket.close()

    monkeypatch.setattr(file_server, "Gatekeeper", Absent)
    handler = Handler()
    server = FileServer("127.0.0.1", 0, handler, keys=keys)
    server.start()
    try:
        with Peer(server.port, own=host_keys, server=keys.own.public) as peer:
            assert not peer.is_answered()
        assert handler.n == 0
    finally:
        server.stop()


def test_only_with_keys_is_anything_but_loopback_served(keys: UnitKeys) -> None:
    with pytest.raises(DeviceError, match="without keys"):
        FileServer("0.0.0.0", 0, Handler())
    server = FileServer("0.0.0.0", 0, Handler(), keys=keys)
    server.stop()


def test_a_peer_that_asks_without_end_is_told_so() -> None:
    server = FileServer("127.0.0.1", 0, Handler())
    server.start()
    try:
        with Peer(server.port) as peer:
            for i in range(3000):  # without waiting for answers: so a busy machine is asked too often as well
                peer.socket.send(encode_message(i, Hello(software="x")))
            refused = None
            while refused is None and peer.socket.poll(5000):
                reply = decode_reply(peer.socket.recv())[1]
                refused = reply if isinstance(reply, Refusal) else None
            assert refused is not None and refused.code == "too-many"
            with Peer(server.port) as other:
                assert other.is_answered(5000)
    finally:
        server.stop()


def test_a_busy_unit_serves_a_hundred_requests_a_second_in_all() -> None:
    handler = Handler()
    handler.is_busy = True
    server = FileServer("127.0.0.1", 0, handler)
    server.start()
    try:
        with Peer(server.port) as peer:
            for i in range(60):
                peer.socket.send(encode_message(i, Hello(software="x")))
            started = time.monotonic()
            for _ in range(60):
                assert peer.socket.poll(5000)
                peer.socket.recv()
            # Ten in each of six slots of 0.1 s: the last come after five slots at least.
            assert time.monotonic() - started > 0.4
    finally:
        server.stop()


def test_the_servers_threads_let_others_go_first() -> None:
    handler = Handler()
    before = {p.name for p in Path("/proc/self/task").iterdir()}
    server = FileServer("127.0.0.1", 0, handler)
    server.start()
    try:
        with Peer(server.port) as peer:
            assert peer.is_answered(5000)
            assert handler.thread_niceness == NICENESS
            own = os.getpriority(os.PRIO_PROCESS, 0)
            assert own < NICENESS  # this thread was left alone
            mine = {int(p.name) for p in Path("/proc/self/task").iterdir() if p.name not in before}
            # ZeroMQ's I/O and reaper threads of the server, and the server's own.
            assert sum(os.getpriority(os.PRIO_PROCESS, n) == NICENESS for n in mine) >= 3
    finally:
        server.stop()


def test_connections_are_bounded_and_those_that_are_there_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        file_server, "ConnectionGuard", lambda server: ConnectionGuard(server, max_connections=5)
    )
    server = FileServer("127.0.0.1", 0, Handler())
    server.start()
    try:
        with Peer(server.port) as early:
            assert early.is_answered(5000)
            crowd = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(40)]
            guard = server._guard
            assert guard is not None
            wait_for(lambda: guard.n_refused >= 36)
            wait_for(lambda: guard.n_open <= 5)
            assert early.is_answered(5000)
            for connection in crowd:
                connection.close()
            wait_for(lambda: guard.n_open == 1)
            with Peer(server.port) as late:
                assert late.is_answered(5000)
    finally:
        server.stop()


def test_more_descriptors_are_taken_as_far_as_they_may_be(monkeypatch: pytest.MonkeyPatch) -> None:
    limits = {"now": (256, 1000)}
    monkeypatch.setattr(connection_guard.resource, "getrlimit", lambda _: limits["now"])
    monkeypatch.setattr(connection_guard.resource, "setrlimit", lambda _, new: limits.update(now=new))
    connection_guard.raise_descriptor_limit()
    assert limits["now"] == (1000, 1000)
    limits["now"] = (8192, connection_guard.resource.RLIM_INFINITY)
    connection_guard.raise_descriptor_limit()
    assert limits["now"][0] == 8192  # never fewer


def test_a_full_house_is_logged_once_a_minute(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    server = FileServer("127.0.0.1", 0, Handler())
    server.start()
    try:
        n = connection_guard.MAX_CONNECTIONS + 20
        crowd = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(n)]
        wait_for(lambda: "places are taken" in caplog.text)
        assert caplog.text.count("places are taken") == 1
        for connection in crowd:
            connection.close()
    finally:
        server.stop()
