"""A TCP proxy that stands for a bad network: it cuts connections at random points, and damages bytes."""

import contextlib
import random
import select
import socket
import struct
import threading
from collections.abc import Callable

_RESET = struct.pack("ii", 1, 0)  # SO_LINGER: closing sends a reset, as a pulled cable's time-out does


class BadNetwork:
    """Forwards to one port of this machine.

    Parameters
    ----------
    port : int
        The unit's.
    draw_budget : callable, optional
        Draws after how many bytes from the unit a new connection is cut; `None` for never.
    damage : callable, optional
        Alters bytes on their way to the host.
    piece_bytes : int
        At most so many are passed on at a time.
    """

    def __init__(
        self,
        port: int,
        *,
        draw_budget: Callable[[], int | None] = lambda: None,
        damage: Callable[[bytes], bytes] = lambda data: data,
        piece_bytes: int = 16_384,
    ) -> None:
        self._target = ("127.0.0.1", port)
        self._draw_budget = draw_budget
        self._damage = damage
        self._piece_bytes = piece_bytes
        self._stop = threading.Event()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(0.05)
        self._threads: list[threading.Thread] = []
        self._accepting = threading.Thread(target=self._accept)
        self.port = self._listener.getsockname()[1]
        self.n_connections = 0
        self.n_cuts = 0

    @property
    def address(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def __enter__(self) -> "BadNetwork":
        self._accepting.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._accepting.join()
        for thread in self._threads:
            thread.join()
        self._listener.close()

    def _accept(self) -> None:
        while not self._stop.is_set():
            try:
                host, _ = self._listener.accept()
            except TimeoutError:
                continue
            self.n_connections += 1
            self._threads = [t for t in self._threads if t.is_alive()]
            thread = threading.Thread(target=self._forward, args=(host,))
            self._threads.append(thread)
            thread.start()

    def _forward(self, host: socket.socket) -> None:
        budget = self._draw_budget()
        with host, contextlib.suppress(OSError), socket.create_connection(self._target) as unit:
            while not self._stop.is_set():
                for ready in select.select([host, unit], [], [], 0.05)[0]:
                    data = ready.recv(self._piece_bytes)
                    if not data:
                        return
                    if ready is host:
                        unit.sendall(data)
                        continue
                    if budget is not None:
                        data, budget = data[:budget], budget - len(data)
                    host.sendall(self._damage(data))
                    if budget is not None and budget <= 0:
                        self.n_cuts += 1
                        for side in (host, unit):
                            side.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
                        return


class BitFlips:
    """Damage that flips one bit in so many bytes, on the average."""

    def __init__(self, draw: random.Random, *, every_bytes: int) -> None:
        self._draw = draw
        self._every_bytes = every_bytes
        self.n_flips = 0

    def __call__(self, data: bytes) -> bytes:
        if self._draw.random() >= len(data) / self._every_bytes:
            return data
        self.n_flips += 1
        damaged = bytearray(data)
        damaged[self._draw.randrange(len(data))] ^= 1 << self._draw.randrange(8)
        return bytes(damaged)
