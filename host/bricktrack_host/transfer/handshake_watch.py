"""Hears from ZeroMQ why a connection does not come about: a key that is refused, or wrong, or missing."""

import itertools

import zmq

_numbers = itertools.count()
_EVENTS = (
    zmq.EVENT_HANDSHAKE_SUCCEEDED
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)


class HandshakeWatch:
    """The handshakes of one socket, from before it connects until the first one succeeds.

    Parameters
    ----------
    socket : zmq.Socket
        A client's, not yet connected.
    """

    def __init__(self, socket: "zmq.Socket[bytes]") -> None:
        self._watched = socket
        self._has_keys = socket.getsockopt(zmq.MECHANISM) == zmq.CURVE
        self._refused = False
        self._other_mechanism = False
        self._n_hung_up = 0
        self._events: zmq.Socket[bytes] | None = None
        try:
            address = f"inproc://handshakes-{next(_numbers)}"
            socket.monitor(address, _EVENTS)
            self._events = socket.context.socket(zmq.PAIR)
            self._events.setsockopt(zmq.LINGER, 0)
            self._events.connect(address)
        except zmq.ZMQError:  # the context has no sockets left: go without explanations
            self.close()

    def refusal(self) -> str:
        """Return in words why this connection will never come about; empty while it may."""
        self._hear()
        if self._refused:
            return (
                "the unit does not know this host's key. 'bricktrack keys show' prints it; put it on the "
                "unit with 'bricktrack keys install'"
            )
        if self._other_mechanism and not self._has_keys:
            return (
                "the unit asks for keys, and none is given for it. Put its server_key into fleet.toml; "
                "'bricktrackd keys show' on the unit prints it"
            )
        if self._other_mechanism:
            return (
                "the unit has no keys, and server_key expects some: it may be another program that answers, "
                "or the unit's [server] keys is not set"
            )
        return ""

    def suspicion(self) -> str:
        """Return in words what has probably gone wrong; empty if nothing is known."""
        self._hear()
        if self._n_hung_up and self._has_keys:
            return (
                "What answers there hangs up during the handshake: it is another unit than the one that "
                "server_key means, or the unit has a new key. 'bricktrackd keys show' on the unit prints it"
            )
        if self._n_hung_up:
            return "Something answers there, and hangs up: is it a unit?"
        return ""

    def close(self) -> None:
        """Hear no more."""
        if self._events is not None:
            self._watched.disable_monitor()
            self._events.close()
            self._events = None

    def _hear(self) -> None:
        # It loads asyncio and TLS, which no command needs but those that talk with units.
        from zmq.utils.monitor import parse_monitor_message

        while self._events is not None and self._events.poll(0):
            event = parse_monitor_message(self._events.recv_multipart())["event"]
            if event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                self._n_hung_up = 0
                self.close()
            elif event == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
                self._refused = True
            elif event == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL:
                self._other_mechanism = True
            else:
                self._n_hung_up += 1
