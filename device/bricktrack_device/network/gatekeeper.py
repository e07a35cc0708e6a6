"""Who may connect: answers ZeroMQ's questions (ZAP, RFC 27) by the keys that the unit keeps."""

import logging
import time

import zmq
from zmq.utils import z85

from bricktrack_common.key_files import fingerprint
from bricktrack_device.network.unit_keys import UnitKeys

logger = logging.getLogger(__name__)

ZAP_DOMAIN = b"bricktrack"
_ENDPOINT = "inproc://zeromq.zap.01"
_VERSION = b"1.0"
_TELL_AGAIN_S = 60.0
_MAX_REMEMBERED = 256


class Gatekeeper:
    """Lets hosts in whose key is known. To be made before the server's socket is bound.

    Without one, a socket with `ZAP_ENFORCE_DOMAIN` lets nobody in.

    Parameters
    ----------
    context : zmq.Context
        The server's own.
    keys : UnitKeys
    """

    def __init__(self, context: "zmq.Context[zmq.Socket[bytes]]", keys: UnitKeys) -> None:
        self._keys = keys
        self._told: dict[tuple[str, str], float] = {}
        self.socket = context.socket(zmq.ROUTER)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.bind(_ENDPOINT)

    def answer_one(self) -> None:
        """Answer one question, if one has come; whatever is not as it must be is refused."""
        try:
            frames = self.socket.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return
        # identity, empty, version, request id, domain, address, identity, mechanism, credentials
        if len(frames) < 8 or frames[2] != _VERSION:
            logger.warning("a question about a connection that is not of ZAP 1.0; not answered")
            return
        envelope, request_id = frames[:2], frames[3]
        domain, address, _, mechanism, *credentials = frames[4:]
        name = None
        if domain == ZAP_DOMAIN and mechanism == b"CURVE" and len(credentials) == 1:
            name = self._name_of(credentials[0], address.decode("ascii", "replace"))
        code, words, user = (b"200", b"OK", name.encode()) if name else (b"400", b"unknown key", b"")
        self.socket.send_multipart([*envelope, _VERSION, request_id, code, words, user, b""])

    def close(self) -> None:
        """Let nobody in any more."""
        self.socket.close()

    def _name_of(self, key: bytes, address: str) -> str | None:
        if len(key) != 32:
            return None
        public = z85.encode(key).decode("ascii")
        name = self._keys.client_name(public)
        if name is None:
            self._tell(
                (address, public),
                f"refused a host at {address}: its key {public} ({fingerprint(public)}) is not in "
                f"{self._keys.clients_folder}",
            )
        else:
            logger.debug("host %s connects from %s", name, address)
        return name

    def _tell(self, what: tuple[str, str], words: str) -> None:
        """Log a refusal, the same one once a minute at most."""
        now = time.monotonic()
        self._told = {k: t for k, t in self._told.items() if now - t < _TELL_AGAIN_S}
        if what not in self._told and len(self._told) < _MAX_REMEMBERED:
            self._told[what] = now
            logger.warning("%s", words)
