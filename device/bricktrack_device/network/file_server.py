"""The unit's side of the wire: one ROUTER socket, one thread, typed requests in, typed replies out.

Bytes that are no message of the protocol are refused with a code and words; nothing that comes in ends the
thread. It runs at low priority, and does little at a time while a run is recorded. `docs/wire-protocol.md`
describes every message.
"""

import ipaddress
import logging
import math
import queue
import socket
import threading
import time
from collections.abc import Callable
from typing import Protocol

import msgpack
import zmq

from bricktrack_common.errors import DeviceError, ProtocolError
from bricktrack_common.wire_codec import VersionError, decode_request, encode_message
from bricktrack_common.wire_messages import (
    MAX_CHUNK_BYTES,
    MAX_HEADER_BYTES,
    ErrorCode,
    Read,
    Refusal,
    Reply,
    Request,
)
from bricktrack_device.network.connection_guard import ConnectionGuard
from bricktrack_device.network.gatekeeper import ZAP_DOMAIN, Gatekeeper
from bricktrack_device.network.request_limits import PER_SECOND, BusyBudget, PeerRates
from bricktrack_device.network.unit_keys import UnitKeys
from bricktrack_device.priority import at_low_priority, lower_priority
from bricktrack_device.refusals import RequestRefusedError

logger = logging.getLogger(__name__)

HEARTBEAT_IVL_MS = 2000
HEARTBEAT_TIMEOUT_MS = 6000
HANDSHAKE_IVL_MS = 5000
LINGER_MS = 500
SEND_HWM = 32
"""Replies that may wait for one slow host; at the largest chunk that is 32 MiB of memory."""
RECEIVE_HWM = 32
"""Requests of one host that may wait here; what is more waits with the host."""
BACKLOG = 64
_MAX_WORDS = 2000
_POLL_MS = 500
_AT_ONCE = 16
_TOO_MANY = Refusal(code="too-many", message=f"more than {PER_SECOND:g} requests a second; ask less often")

Answer = Callable[[Reply, bytes | None], None]
"""Sends one reply, with file bytes behind it where the reply says so; also later, from any thread."""


class RequestHandler(Protocol):
    """Who knows the answers."""

    @property
    def is_busy(self) -> bool:
        """Whether a run is waited for, recorded or saved: the server then does little at a time."""
        ...

    def handle(self, request: Request, answer: Answer) -> None:
        """Answer now or later; a `RequestRefusedError` is turned into a `Refusal`."""
        ...


class FileServer:
    """The socket and its thread, both at low priority.

    Parameters
    ----------
    address : str
        An IP address; without keys only a loopback one.
    port : int
        0 takes a free one; see `port`.
    handler : RequestHandler
        Called in the server's thread.
    keys : UnitKeys, optional
        With them everything is encrypted, and only hosts whose keys are known are let in.

    Raises
    ------
    DeviceError
        If the address is not loopback and there are no keys, or it is taken.
    """

    def __init__(
        self, address: str, port: int, handler: RequestHandler, *, keys: UnitKeys | None = None
    ) -> None:
        parsed = ipaddress.ip_address(address)
        if keys is None and not parsed.is_loopback:
            raise DeviceError(f"{address} is not a loopback address; without keys nothing else is served")
        self._handler = handler
        self._keys = keys
        self._replies: queue.SimpleQueue[tuple[bytes, int, Reply, bytes | None]] = queue.SimpleQueue()
        self._rates = PeerRates()
        self._budget = BusyBudget()
        self._wake_out, self._wake_in = socket.socketpair()
        self._wake_in.setblocking(False)
        self._stopping = threading.Event()
        self._last_beat = time.monotonic()
        self._context = zmq.Context()
        self._gatekeeper: Gatekeeper | None = None
        self._guard: ConnectionGuard | None = None
        self.address = address
        self.port = port
        at_low_priority(self._open)
        self._thread = threading.Thread(target=self._run, name="file-server")

    def _open(self) -> None:
        """Make the sockets; ZeroMQ's own thread, which does the encryption, inherits the priority."""
        is_ipv6 = ":" in self.address
        self._socket: zmq.Socket[bytes] = self._context.socket(zmq.ROUTER)
        for option, value in (
            (zmq.ROUTER_MANDATORY, 1),
            (zmq.HEARTBEAT_IVL, HEARTBEAT_IVL_MS),
            (zmq.HEARTBEAT_TIMEOUT, HEARTBEAT_TIMEOUT_MS),
            (zmq.HANDSHAKE_IVL, HANDSHAKE_IVL_MS),
            (zmq.LINGER, LINGER_MS),
            (zmq.MAXMSGSIZE, MAX_HEADER_BYTES),
            (zmq.SNDHWM, SEND_HWM),
            (zmq.RCVHWM, RECEIVE_HWM),
            (zmq.BACKLOG, BACKLOG),
            (zmq.IPV6, int(is_ipv6)),
        ):
            self._socket.setsockopt(option, value)
        host = f"[{self.address}]" if is_ipv6 else self.address
        try:
            if self._keys is not None:
                # Before the port is bound: nobody is to come in while nobody watches the door.
                self._gatekeeper = Gatekeeper(self._context, self._keys)
                self._socket.curve_server = True
                self._socket.curve_secretkey = self._keys.own.secret.encode("ascii")
                self._socket.zap_domain = ZAP_DOMAIN
                self._socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)
            self._guard = ConnectionGuard(self._socket)
            self._socket.bind(f"tcp://{host}:{self.port or '*'}")
        except zmq.ZMQError as e:
            self._release()
            remedy = (
                "another program, perhaps another bricktrackd, has it. Stop that one or set server.port"
                if e.errno == zmq.EADDRINUSE
                else f"{e.strerror}. Set server.address and server.port"
            )
            raise DeviceError(f"cannot listen on {self.address} port {self.port}: {remedy}") from e
        self.port = int(self._socket.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])
        self._guard.port = self.port

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread and close the socket; replies that were given are still sent, for half a second."""
        self._stopping.set()
        self._wake()
        if self._thread.ident is not None:
            self._thread.join()
        self._release()

    @property
    def beat_age_s(self) -> float:
        """Seconds since the thread was last seen at work; infinite once it is gone."""
        return time.monotonic() - self._last_beat if self._thread.is_alive() else float("inf")

    def _release(self) -> None:
        if self._guard is not None:
            self._guard.close()
        self._socket.close(LINGER_MS)
        if self._gatekeeper is not None:
            self._gatekeeper.close()
        self._context.term()
        self._wake_out.close()
        self._wake_in.close()

    def _wake(self) -> None:
        try:
            self._wake_in.send(b"\0")
        except BlockingIOError:
            return  # the pipe is full of wake-ups already
        except OSError:
            logger.debug("a reply came after the server was closed")

    def _run(self) -> None:
        lower_priority()
        poller = zmq.Poller()
        poller.register(self._wake_out, zmq.POLLIN)
        for door in (self._gatekeeper, self._guard):
            if door is not None:
                poller.register(door.socket, zmq.POLLIN)
        while not self._stopping.is_set():
            self._last_beat = time.monotonic()
            wait_s = self._budget.wait_s() if self._handler.is_busy else 0.0
            poller.register(self._socket, zmq.POLLIN if wait_s == 0.0 else 0)
            ready = dict(poller.poll(_POLL_MS if wait_s == 0.0 else math.ceil(1000 * wait_s)))
            if self._wake_out.fileno() in ready:
                self._wake_out.recv(4096)
            self._send_waiting()
            try:
                if self._gatekeeper is not None and self._gatekeeper.socket in ready:
                    self._gatekeeper.answer_one()
                if self._guard is not None and self._guard.socket in ready:
                    self._guard.look()
                if self._socket in ready:
                    self._receive_some()
            except Exception:
                logger.exception("a bug in the file server; the request is dropped")
        self._send_waiting()

    def _receive_some(self) -> None:
        """Take the requests that have come, not too many at once."""
        for _ in range(_AT_ONCE):
            if self._handler.is_busy and self._budget.wait_s() > 0.0:
                return
            if not self._receive():
                return
            self._send_waiting()

    def _receive(self) -> bool:
        """Take one request, if one has come; tell whether it has."""
        try:
            identity, *frames = self._socket.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return False
        self._budget.spend()
        header = frames[0] if frames else b""
        try:
            if len(frames) != 1:
                raise ProtocolError(f"a request is one frame; this message has {len(frames)}")
            request_id, request = decode_request(header)
        except VersionError as e:
            self._put(identity, _request_id_in(header), _refusal("bad-version", str(e)), None)
            return True
        except ProtocolError as e:
            logger.debug("refused %d bytes: %s", len(header), e)
            self._put(identity, _request_id_in(header), _refusal("bad-message", str(e)), None)
            return True
        # Reading is bounded by the replies that may wait for a host; all else by its rate.
        if not isinstance(request, Read) and not self._rates.allows(identity):
            self._put(identity, request_id, _TOO_MANY, None)
            return True

        def answer(reply: Reply, data: bytes | None = None) -> None:
            self._put(identity, request_id, reply, data)
            if threading.current_thread() is not self._thread:
                self._wake()

        try:
            self._handler.handle(request, answer)
        except RequestRefusedError as e:
            answer(_refusal(e.code, str(e)))
        except Exception as e:
            logger.exception("a bug in the file server; the request is refused")
            answer(_refusal("internal", f"{type(e).__name__}: {e}"))
        return True

    def _put(self, identity: bytes, request_id: int, reply: Reply, data: bytes | None) -> None:
        self._replies.put((identity, request_id, reply, data))

    def _send_waiting(self) -> None:
        while True:
            try:
                identity, request_id, reply, data = self._replies.get_nowait()
            except queue.Empty:
                return
            frames = [identity, encode_message(request_id, reply)]
            if data is not None:
                pieces = range(0, max(len(data), 1), MAX_CHUNK_BYTES)
                frames += [data[start : start + MAX_CHUNK_BYTES] for start in pieces]
            try:
                self._socket.send_multipart(frames, zmq.NOBLOCK)
            except zmq.ZMQError as e:
                # EHOSTUNREACH: the host has gone. EAGAIN: it does not take its replies. It will ask again.
                logger.debug("reply %d not sent: %s", request_id, e.strerror)


def _refusal(code: ErrorCode, words: str) -> Refusal:
    return Refusal(code=code, message=words[:_MAX_WORDS])


def _request_id_in(header: bytes) -> int:
    """Return the id in a message that was refused, if it has one, so that the host can tell which it was."""
    if len(header) > MAX_HEADER_BYTES:
        return 0
    try:
        value = msgpack.unpackb(header, raw=False, strict_map_key=True, max_ext_len=0)
    except (ValueError, TypeError, OverflowError, msgpack.UnpackException):
        return 0
    request_id = value.get("request_id") if isinstance(value, dict) else None
    if isinstance(request_id, int) and not isinstance(request_id, bool) and 0 <= request_id <= 2**53:
        return request_id
    return 0
