"""One connection to a unit: numbered requests out, checked replies in, and why one does not come.

Every request has its own number, and only the reply with that number is believed: replies that come late,
twice, or from something that speaks no bricktrack are counted and left alone.
"""

import itertools
import logging
import threading
import time
from dataclasses import dataclass
from typing import TypeVar

import zmq

from bricktrack_common.errors import ConfigError, ProtocolError, UnitError, UnitTimeoutError
from bricktrack_common.key_files import KeyPair, check_public_key
from bricktrack_common.wire_codec import VersionError, decode_reply, encode_message
from bricktrack_common.wire_messages import (
    MAX_CHUNK_BYTES,
    MAX_STILL_BYTES,
    Chunk,
    Refusal,
    Reply,
    Request,
    StillImage,
)
from bricktrack_host.transfer.handshake_watch import HandshakeWatch

logger = logging.getLogger(__name__)

_POLL_MS = 200  # how soon a stop is noticed
_ORDINARY_SUSPICION = "Is the unit on, bricktrackd running and the address right?"

_Reply_T = TypeVar("_Reply_T")


class Stopped(Exception):  # noqa: N818  (not an error: somebody asked for it)
    """The user asked to stop while a unit was being waited for."""


@dataclass(slots=True)
class ClientCounts:
    """What came that was not waited for, and what had to be asked for again."""

    stray_replies: int = 0
    """Late, duplicated, or never asked for."""
    foreign_messages: int = 0
    """Not of this protocol."""
    repeated_chunks: int = 0
    """Asked for again, because they came broken or not at all."""


class UnitConnection:
    """A socket that speaks to one unit. Not to be shared between threads; the context may be.

    The parameters and what they may raise are those of `UnitClient`.
    """

    def __init__(
        self,
        address: str,
        *,
        timeout_s: float,
        context: zmq.Context[zmq.Socket[bytes]] | None,
        stop: threading.Event | None,
        server_key: str,
        own_keys: KeyPair | None,
    ) -> None:
        self.address = address
        self.timeout_s = timeout_s
        self.counts = ClientCounts()
        self._stop = stop
        self._request_ids = itertools.count(1)
        if server_key:
            check_public_key(server_key, where=f"{address}: server_key")
            if own_keys is None:
                raise ConfigError(
                    f"{address}: the unit has keys and this host has none; run 'bricktrack keys create' and "
                    "name the file in fleet.toml: [host] secret_key"
                )
        self._socket = (context or zmq.Context.instance()).socket(zmq.DEALER)
        for option, value in (
            (zmq.IMMEDIATE, 1),
            (zmq.LINGER, 500),
            (zmq.IPV6, 1),
            (zmq.HEARTBEAT_IVL, 2000),
            (zmq.HEARTBEAT_TIMEOUT, 6000),
            (zmq.HANDSHAKE_IVL, 5000),
            (zmq.RECONNECT_IVL, 100),
            (zmq.RECONNECT_IVL_MAX, 2000),
            (zmq.MAXMSGSIZE, MAX_CHUNK_BYTES + 64 * 1024),
        ):
            self._socket.setsockopt(option, value)
        if server_key and own_keys is not None:
            self._socket.curve_serverkey = server_key.encode("ascii")
            self._socket.curve_publickey = own_keys.public.encode("ascii")
            self._socket.curve_secretkey = own_keys.secret.encode("ascii")
        self._handshake = HandshakeWatch(self._socket)
        try:
            self._socket.connect(address)
        except zmq.ZMQError as e:
            self.close()
            raise UnitError(
                f"{address}: not an address to connect to ({e}). Give it as tcp://host:port",
                code="bad-address",
            ) from e

    def close(self) -> None:
        """End the connection; requests under way are forgotten."""
        self._handshake.close()
        self._socket.close()

    def ask(self, request: Request, kind: type[_Reply_T], *, timeout_s: float | None = None) -> _Reply_T:
        """Send a request and return its reply, which must be of this kind."""
        return self.ask_with_data(request, kind, timeout_s=timeout_s)[0]

    def ask_with_data(
        self, request: Request, kind: type[_Reply_T], *, timeout_s: float | None = None
    ) -> tuple[_Reply_T, bytes]:
        """Send a request and return its reply with the bytes behind it."""
        deadline_s = time.monotonic() + (self.timeout_s if timeout_s is None else timeout_s)
        asked_for = str(type(request).__struct_config__.tag)
        request_id = self.send(request, min(deadline_s, time.monotonic() + self.timeout_s))
        while True:
            reply_id, reply, data = self.receive(deadline_s, asked_for)
            if reply_id == request_id:
                return self.expect(reply, kind, asked_for), data
            self.counts.stray_replies += 1

    def expect(self, reply: Reply, kind: type[_Reply_T], asked_for: str) -> _Reply_T:
        """Return the reply if it is of this kind; raise a refusal, or that it is another."""
        if isinstance(reply, Refusal):
            raise UnitError(f"{self.address} refused {asked_for}: {reply.message}", code=reply.code)
        if not isinstance(reply, kind):
            raise ProtocolError(f"{self.address}: answered {asked_for} with a {type(reply).__name__}")
        return reply

    def send(self, request: Request, deadline_s: float) -> int:
        """Send a request and return its number; waits for a connection until the deadline."""
        request_id = next(self._request_ids)
        while True:
            self._wait_for(zmq.POLLOUT, deadline_s, "no connection")
            try:
                self._socket.send(encode_message(request_id, request), zmq.NOBLOCK)
            except zmq.Again:
                continue  # the connection broke between the two
            return request_id

    def receive(self, deadline_s: float, waiting_for: str) -> tuple[int, Reply, bytes]:
        """Return the next message of this protocol: its number, its body and the bytes behind it."""
        while True:
            self._wait_for(zmq.POLLIN, deadline_s, f"no answer to {waiting_for}")
            header, *rest = self._socket.recv_multipart(zmq.NOBLOCK)
            try:
                request_id, reply = decode_reply(header)
            except VersionError as e:
                raise ProtocolError(f"{self.address}: {e}") from e
            except ProtocolError as e:
                logger.debug("%s: foreign message: %s", self.address, e)
                self.counts.foreign_messages += 1
                continue
            if len(rest) not in _frames_allowed(reply):
                self.counts.foreign_messages += 1
                continue
            self._handshake.close()  # it is over, and its sockets are wanted by the next of many units
            return request_id, reply, rest[0] if len(rest) == 1 else b"".join(rest)

    def _wait_for(self, event: int, deadline_s: float, problem: str) -> None:
        while True:
            if self._stop is not None and self._stop.is_set():
                raise Stopped
            left_ms = (deadline_s - time.monotonic()) * 1000
            if self._socket.poll(int(min(max(left_ms, 0), _POLL_MS)), event):
                return
            refused = self._handshake.refusal()
            if refused:
                raise UnitError(f"{self.address}: {refused}", code="not-allowed")
            if left_ms <= 0:
                foreign = self.counts.foreign_messages
                raise UnitTimeoutError(
                    f"{self.address}: {problem} in time. "
                    + (self._handshake.suspicion() or _ORDINARY_SUSPICION)
                    + (f" {foreign} messages came that are not bricktrack's" if foreign else "")
                )


def _frames_allowed(reply: Reply) -> range:
    """Return how many raw frames may follow a reply."""
    match reply:
        case Chunk():
            return range(1, 2)
        case StillImage():
            return range(1, MAX_STILL_BYTES // MAX_CHUNK_BYTES + 1)
        case _:
            return range(1)
