"""How much the server does: per connection, and in all while a run is recorded."""

import time
from collections import OrderedDict
from collections.abc import Callable

PER_SECOND = 200.0
BURST = 500.0
MAX_REMEMBERED = 256
BUSY_SLOT_S = 0.1
BUSY_REQUESTS_PER_SLOT = 10


class PeerRates:
    """Lets each connection ask so often: ``burst`` at once, ``per_second`` in the long run.

    Parameters
    ----------
    clock : callable
        Seconds, monotonic.
    """

    def __init__(
        self,
        *,
        per_second: float = PER_SECOND,
        burst: float = BURST,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._per_second = per_second
        self._burst = burst
        self._clock = clock
        self._peers: OrderedDict[bytes, tuple[float, float]] = OrderedDict()

    def allows(self, peer: bytes) -> bool:
        """Tell whether a connection may ask once more, and count it."""
        now = self._clock()
        left, then = self._peers.pop(peer, (self._burst, now))
        left = min(self._burst, left + (now - then) * self._per_second)
        allowed = left >= 1.0
        self._peers[peer] = (left - 1.0 if allowed else left, now)
        while len(self._peers) > MAX_REMEMBERED:
            self._peers.popitem(last=False)
        return allowed


class BusyBudget:
    """How many requests may still be served in this slot of time, while the unit has better things to do.

    What is over waits in the sockets' bounded queues, and then in the hosts'.
    """

    def __init__(
        self,
        *,
        slot_s: float = BUSY_SLOT_S,
        n_requests: int = BUSY_REQUESTS_PER_SLOT,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._slot_s = slot_s
        self._n_requests = n_requests
        self._clock = clock
        self._slot_start_s = 0.0
        self._left = n_requests

    def wait_s(self) -> float:
        """Return how long to wait before the next request, s; 0 if it may be served now."""
        now = self._clock()
        if now - self._slot_start_s >= self._slot_s:
            self._slot_start_s, self._left = now, self._n_requests
        return 0.0 if self._left > 0 else self._slot_start_s + self._slot_s - now

    def spend(self) -> None:
        """Count one request."""
        self._left -= 1
