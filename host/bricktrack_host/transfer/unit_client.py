"""Speaks to one brick unit: one request after another, and file chunks with several asked for ahead.

Every request has its own number, and only the reply with that number is believed: replies that come late,
twice, or from something that speaks no bricktrack are counted and left alone.
"""

import itertools
import logging
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import NamedTuple, Self, TypeVar

import zmq

from bricktrack_common.checksums import crc32
from bricktrack_common.errors import ConfigError, ProtocolError, TransferError, UnitError, UnitTimeoutError
from bricktrack_common.key_files import KeyPair, check_public_key
from bricktrack_common.wire_messages import (
    MAX_CHUNK_BYTES,
    MAX_STILL_BYTES,
    Arm,
    Armed,
    Chunk,
    Configure,
    Configured,
    ConfigValue,
    Confirm,
    Confirmed,
    Deleted,
    DeleteRun,
    DescribeRun,
    Disarm,
    Disarmed,
    GetStatus,
    Hello,
    HelloReply,
    ListRuns,
    Read,
    Refusal,
    Reply,
    Request,
    RunDescription,
    RunList,
    StatusReply,
    StillEncoding,
    StillImage,
    TakeStill,
    VersionError,
    decode_reply,
    encode_message,
)
from bricktrack_host.transfer.handshake_watch import HandshakeWatch

logger = logging.getLogger(__name__)

CHUNK_BYTES = 512 * 1024
CREDIT = 5
"""Chunks asked for ahead: the bytes of ten of 256 KiB, and two thirds faster (scripts/bench_transfer.py)."""
_MAX_TRIES_PER_CHUNK = 4
_POLL_MS = 200  # how soon a stop is noticed
_LOOKS_WHILE_SILENT = 4  # how often a unit that works on something is asked for a sign of life

_Reply_T = TypeVar("_Reply_T")


_ORDINARY_SUSPICION = "Is the unit on, bricktrackd running and the address right?"


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


class VerifiedChunk(NamedTuple):
    """Bytes of a file that match their checksum."""

    offset: int
    data: bytes
    crc32: int


@dataclass(slots=True)
class _Asked:
    offset: int
    length: int
    tries: int = 0


class UnitClient:
    """A connection to one unit. Not to be shared between threads; the context may be.

    Parameters
    ----------
    address : str
        ``tcp://host:port``.
    timeout_s : float, s
        How long a unit may be silent before `UnitTimeoutError` is raised.
    context : zmq.Context, optional
        Default: the process's own.
    stop : threading.Event, optional
        Once it is set, waiting ends with `Stopped`.
    server_key : str
        The unit's public key; nothing else is spoken to then, whatever answers at the address. Without it
        nothing is encrypted, and a unit that has keys does not answer.
    own_keys : KeyPair, optional
        This host's; must be given with ``server_key``.

    Raises
    ------
    UnitError
        If the address is none.
    ConfigError
        If a key is none, or this host's is missing.
    """

    def __init__(
        self,
        address: str,
        *,
        timeout_s: float = 5.0,
        context: zmq.Context[zmq.Socket[bytes]] | None = None,
        stop: threading.Event | None = None,
        server_key: str = "",
        own_keys: KeyPair | None = None,
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

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the connection; requests under way are forgotten."""
        self._handshake.close()
        self._socket.close()

    def hello(self, software: str = "bricktrack") -> HelloReply:
        """Ask who is there."""
        return self._ask(Hello(software=software), HelloReply)

    def status(self) -> StatusReply:
        """Ask how the unit is."""
        return self._ask(GetStatus(), StatusReply)

    def arm(self, label: str = "", *, duration_s: float | None = None, patience_s: float = 60.0) -> Armed:
        """Make the unit ready for the next first edge; returns once it *is* ready.

        A camera may take longer to start than a unit may be silent: meanwhile the unit is asked how it is,
        and waited for while it answers.

        Raises
        ------
        UnitTimeoutError
            If nothing comes for ``timeout_s``, or the unit is not ready after ``patience_s``.
        """
        now_s = time.monotonic()
        give_up_s = now_s + patience_s
        silent_s = now_s + self.timeout_s
        arming = self._send(Arm(label=label, duration_s=duration_s), silent_s)
        while (now_s := time.monotonic()) < give_up_s:
            look_s = now_s + self.timeout_s / _LOOKS_WHILE_SILENT
            try:
                reply_id, reply, _ = self._receive(min(look_s, silent_s), "arm")
            except UnitTimeoutError:
                if time.monotonic() >= silent_s:
                    raise
                self._send(GetStatus(), silent_s)
                continue
            if reply_id == arming:
                return self._expect(reply, Armed, "arm")
            silent_s = time.monotonic() + self.timeout_s
            self.counts.stray_replies += not isinstance(reply, StatusReply)
        raise UnitTimeoutError(
            f"{self.address}: answers, but is not ready to record after {patience_s:g} s. "
            "'bricktrack status' shows what it does, 'bricktrack disarm' brings it back"
        )

    def disarm(self, *, timeout_s: float = 30.0) -> Disarmed:
        """Bring the unit back to idle without a run."""
        return self._ask(Disarm(), Disarmed, timeout_s=timeout_s)

    def list_runs(self) -> RunList:
        """Return the runs on the unit, oldest first."""
        return self._ask(ListRuns(), RunList)

    def describe_run(self, run_id: str, *, timeout_s: float = 30.0) -> RunDescription:
        """Return one run's files; the unit may have to hash them first."""
        reply = self._ask(DescribeRun(run_id=run_id), RunDescription, timeout_s=timeout_s)
        if reply.run_id != run_id:
            raise ProtocolError(f"{self.address}: described run {reply.run_id}; asked for {run_id}")
        return reply

    def confirm(self, run_id: str, sha256: list[str]) -> Confirmed:
        """Tell the unit that these files, in the order of its description, are verified and on disk here."""
        return self._ask(Confirm(run_id=run_id, sha256=sha256), Confirmed)

    def delete_run(self, run_id: str, *, force: bool = False, timeout_s: float = 30.0) -> Deleted:
        """Remove a run from the unit: one that a host has confirmed, or any with ``force``."""
        return self._ask(DeleteRun(run_id=run_id, force=force), Deleted, timeout_s=timeout_s)

    def configure(
        self, values: Mapping[str, ConfigValue] | None = None, *, timeout_s: float = 30.0
    ) -> Configured:
        """Change values of the unit's configuration, for good; without any, only ask what they are.

        Parameters
        ----------
        values : mapping
            By dotted key, ``{"camera.exposure_us": 2000}``; `None` goes back to what the unit's file says.
        """
        return self._ask(Configure(values=dict(values or {})), Configured, timeout_s=timeout_s)

    def still(
        self, *, encoding: StillEncoding = "png", lit: bool = True, timeout_s: float = 45.0
    ) -> tuple[StillImage, bytes]:
        """Return a picture of now: what is said of it, and the bytes of a PNG or JPEG file.

        The unit must be idle; starting its camera takes seconds. A PNG is grey: the camera's own luma, 16
        for black and 235 for white. With ``lit`` the LEDs are lit, where they hang on the unit's pins.

        Raises
        ------
        TransferError
            If the picture does not match its checksum.
        """
        reply, data = self._ask_with_data(
            TakeStill(encoding=encoding, lit=lit), StillImage, timeout_s=timeout_s
        )
        if len(data) != reply.n_bytes or crc32(data) != reply.crc32:
            raise TransferError(
                f"{self.address}: the picture came broken ({len(data)} of {reply.n_bytes} bytes); ask again"
            )
        return reply, data

    def read_chunks(
        self, run_id: str, file_index: int, ranges: list[tuple[int, int]], *, credit: int = CREDIT
    ) -> Iterator[VerifiedChunk]:
        """Yield the bytes of some ranges of a file, in the order they arrive.

        Up to ``credit`` chunks are asked for ahead. A chunk that does not match its checksum, and one that
        stays out while others come, is asked for again.

        Parameters
        ----------
        ranges : list of (int, int), bytes
            Offset and length of each chunk, at most `MAX_CHUNK_BYTES` long.

        Raises
        ------
        UnitTimeoutError
            If nothing comes for ``timeout_s``.
        TransferError
            If a chunk comes broken four times.
        UnitError
            If the unit refuses.
        """
        waiting = deque(_Asked(offset, length) for offset, length in ranges)
        asked: dict[int, _Asked] = {}
        heard_s = time.monotonic()
        while waiting or asked:
            while waiting and len(asked) < credit:
                chunk = waiting.popleft()
                chunk.tries += 1
                read = Read(run_id=run_id, file_index=file_index, offset=chunk.offset, length=chunk.length)
                asked[self._send(read, heard_s + self.timeout_s)] = chunk
            what = f"{len(asked)} chunks of file {file_index} of {run_id}"
            request_id, reply, data = self._receive(heard_s + self.timeout_s, what)
            if request_id not in asked:
                self.counts.stray_replies += 1
                continue
            chunk = asked.pop(request_id)
            heard_s = time.monotonic()
            header = self._expect(reply, Chunk, f"bytes from {chunk.offset} of file {file_index} of {run_id}")
            problem = _chunk_problem(header, data, run_id, file_index, chunk)
            if problem:
                self._ask_again(chunk, waiting, problem)
            else:
                yield VerifiedChunk(chunk.offset, data, header.crc32)
                heard_s = time.monotonic()  # a slow disk on this side is not the unit's silence
            for overdue in [i for i in asked if i < request_id - 2 * credit]:
                lost = asked.pop(overdue)
                self._ask_again(lost, waiting, f"the chunk at byte {lost.offset} did not come")

    def _ask_again(self, chunk: _Asked, waiting: deque[_Asked], problem: str) -> None:
        if chunk.tries >= _MAX_TRIES_PER_CHUNK:
            raise TransferError(
                f"{self.address}: {problem}, {chunk.tries} times. Check the network and the unit's card"
            )
        logger.warning("%s: %s; asked for again", self.address, problem)
        self.counts.repeated_chunks += 1
        waiting.appendleft(chunk)

    def _ask(self, request: Request, kind: type[_Reply_T], *, timeout_s: float | None = None) -> _Reply_T:
        return self._ask_with_data(request, kind, timeout_s=timeout_s)[0]

    def _ask_with_data(
        self, request: Request, kind: type[_Reply_T], *, timeout_s: float | None = None
    ) -> tuple[_Reply_T, bytes]:
        deadline_s = time.monotonic() + (self.timeout_s if timeout_s is None else timeout_s)
        asked_for = str(type(request).__struct_config__.tag)
        request_id = self._send(request, min(deadline_s, time.monotonic() + self.timeout_s))
        while True:
            reply_id, reply, data = self._receive(deadline_s, asked_for)
            if reply_id == request_id:
                return self._expect(reply, kind, asked_for), data
            self.counts.stray_replies += 1

    def _expect(self, reply: Reply, kind: type[_Reply_T], asked_for: str) -> _Reply_T:
        if isinstance(reply, Refusal):
            raise UnitError(f"{self.address} refused {asked_for}: {reply.message}", code=reply.code)
        if not isinstance(reply, kind):
            raise ProtocolError(f"{self.address}: answered {asked_for} with a {type(reply).__name__}")
        return reply

    def _send(self, request: Request, deadline_s: float) -> int:
        request_id = next(self._request_ids)
        while True:
            self._wait_for(zmq.POLLOUT, deadline_s, "no connection")
            try:
                self._socket.send(encode_message(request_id, request), zmq.NOBLOCK)
            except zmq.Again:
                continue  # the connection broke between the two
            return request_id

    def _receive(self, deadline_s: float, waiting_for: str) -> tuple[int, Reply, bytes]:
        """Return the next message of this protocol: its number, its body and the bytes behind it."""
        while True:
            self._wait_for(zmq.POLLIN, deadline_s, f"no answer to {waiting_for}")
            header, *rest = self._socket.recv_multipart(zmq.NOBLOCK)
            try:
                request_id, reply = decode_reply(header)
            except VersionError as e:
                raise ProtocolError(f"{self.address}: {e}. Install the same bricktrack on both ends") from e
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


def _chunk_problem(reply: Chunk, data: bytes, run_id: str, file_index: int, chunk: _Asked) -> str:
    """Return in words why a chunk is not the one that was asked for, or is broken; else ``""``."""
    where = f"the chunk at byte {chunk.offset} of file {file_index} of {run_id}"
    if (reply.run_id, reply.file_index, reply.offset) != (run_id, file_index, chunk.offset):
        return f"{where} came as byte {reply.offset} of file {reply.file_index} of {reply.run_id}"
    if len(data) != chunk.length or reply.n_bytes != chunk.length:
        return f"{where} has {len(data)} bytes instead of {chunk.length}"
    if crc32(data) != reply.crc32:
        return f"{where} does not match its checksum"
    return ""
