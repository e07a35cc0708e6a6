"""Keeps the number of connections to the server bounded, and tells of handshakes that failed.

A flood of connections that never speak would take every file descriptor of the daemon, and a run could not be
saved. What comes when all places are taken is hung up on at once; who is connected already keeps the place.
"""

import itertools
import logging
import os
import resource
import socket
import time

import zmq
from zmq.utils.monitor import parse_monitor_message

logger = logging.getLogger(__name__)

MAX_CONNECTIONS = 64
DESCRIPTORS = 4096
_TELL_AGAIN_S = 60.0
_COUNT_AGAIN_S = 1.0
_MAX_EVENTS_AT_ONCE = 1000
_EVENTS = (
    zmq.EVENT_ACCEPTED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_CLOSED
    | zmq.EVENT_ACCEPT_FAILED
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)
_WORDS = {
    "full": f"connections refused: all {MAX_CONNECTIONS} places are taken",
    "failed": "connections failed the handshake: a wrong server key, none at all, or nothing of bricktrack",
    "accept": "connections could not be accepted: the process is out of file descriptors",
}
_numbers = itertools.count()


def raise_descriptor_limit(wanted: int = DESCRIPTORS) -> None:
    """Let this process open more files, as far as it may: hanging up on a connection takes a moment."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    ceiling = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
    if soft != resource.RLIM_INFINITY and soft < ceiling:
        resource.setrlimit(resource.RLIMIT_NOFILE, (ceiling, hard))


class ConnectionGuard:
    """Watches one listening socket.

    Parameters
    ----------
    server : zmq.Socket
        Not yet bound.
    max_connections : int
    """

    def __init__(self, server: "zmq.Socket[bytes]", *, max_connections: int = MAX_CONNECTIONS) -> None:
        self._server = server
        self._max = max_connections
        self._open: set[int] = set()
        self._counts = dict.fromkeys(_WORDS, 0)
        self._told_s = -_TELL_AGAIN_S
        self._counted_s = -_COUNT_AGAIN_S
        self.port = 0
        self.n_refused = 0
        address = f"inproc://connections-{next(_numbers)}"
        server.monitor(address, _EVENTS)
        self.socket: zmq.Socket[bytes] = server.context.socket(zmq.PAIR)
        self.socket.setsockopt(zmq.LINGER, 0)
        # Unbounded, or ZeroMQ's own thread would wait here when many events come at once.
        self.socket.setsockopt(zmq.RCVHWM, 0)
        self.socket.connect(address)

    @property
    def n_open(self) -> int:
        """How many connections there are."""
        return len(self._open)

    def look(self) -> None:
        """Take in what has happened; hang up on what is too many."""
        for _ in range(_MAX_EVENTS_AT_ONCE):
            try:
                event = parse_monitor_message(self.socket.recv_multipart(zmq.NOBLOCK))
            except zmq.Again:
                break
            self._take(event["event"], event["value"])
        self._tell()

    def close(self) -> None:
        """Watch no more."""
        self._server.disable_monitor()
        self.socket.close()

    def _take(self, event: int, value: int) -> None:
        if event == zmq.EVENT_ACCEPTED:
            self._open.add(value)
            if len(self._open) > self._max:
                self._forget_ended()
            if len(self._open) > self._max:
                self._counts["full"] += 1
                self.n_refused += 1
                self._hang_up(value)
        elif event in (zmq.EVENT_DISCONNECTED, zmq.EVENT_CLOSED):
            self._open.discard(value)
        elif event == zmq.EVENT_ACCEPT_FAILED:
            self._counts["accept"] += 1
        else:
            self._counts["failed"] += 1

    def _forget_ended(self) -> None:
        """Free places whose end went unheard; only now and then, because it is slow."""
        now = time.monotonic()
        if now - self._counted_s >= _COUNT_AGAIN_S:
            self._counted_s = now
            self._open = {n for n in self._open if self._is_ours(n)}

    def _hang_up(self, descriptor: int) -> None:
        """End a connection that ZeroMQ owns: it sees an end of file, and closes it.

        By now the number may belong to something else: only a connection to our own port is touched.
        """
        if self._is_ours(descriptor, hang_up=True):
            logger.debug("hung up on connection %d", descriptor)

    def _is_ours(self, descriptor: int, *, hang_up: bool = False) -> bool:
        try:
            with socket.socket(fileno=os.dup(descriptor)) as connection:
                if connection.family not in (socket.AF_INET, socket.AF_INET6):
                    return False
                is_ours = bool(connection.getsockname()[1] == self.port)
                if is_ours and hang_up:
                    connection.shutdown(socket.SHUT_RDWR)
                return is_ours
        except OSError:
            return False

    def _tell(self) -> None:
        now = time.monotonic()
        if any(self._counts.values()) and now - self._told_s >= _TELL_AGAIN_S:
            for what, n in self._counts.items():
                if n:
                    logger.warning("%d %s", n, _WORDS[what])
            self._counts = dict.fromkeys(_WORDS, 0)
            self._told_s = now
