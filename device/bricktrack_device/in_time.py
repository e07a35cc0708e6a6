"""Calls into libraries that may never return: each in a thread of its own, waited for only so long."""

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import HardwareError

_POLL_S = 0.01
_GIVE_UP_S = 5.0
"""How long a call that is given up may still take to return: what comes next must not meet it half-way."""

T = TypeVar("T")


class HangsError(HardwareError):
    """A call did not return in time; it is left to its thread."""


class ThreadedCall(Generic[T]):
    """A call that has been started. Its thread does not keep the process alive.

    Parameters
    ----------
    action : callable
    name : str
        Of the thread.
    """

    def __init__(self, action: Callable[[], T], *, name: str) -> None:
        self._action = action
        self._results: list[T] = []
        self._errors: list[BaseException] = []
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._results.append(self._action())
        except BaseException as e:  # noqa: BLE001  raised again in the caller's thread
            self._errors.append(e)

    def has_ended(self, *, within_s: float | None) -> bool:
        """Wait for its end, at most so long; `None` waits for ever."""
        self._thread.join(within_s)
        return not self._thread.is_alive()

    def result(self) -> T:
        """Return what it returned or raise what it raised, once it has ended."""
        if self._errors:
            raise self._errors[0]
        return self._results[0]


def finishes(action: Callable[[], object], *, within_s: float, name: str) -> bool:
    """Tell whether a call ends in time; raise what it raised. What is late is left to its thread."""
    call = ThreadedCall(action, name=name)
    if not call.has_ended(within_s=within_s):
        return False
    call.result()
    return True


def in_time(what: str, action: Callable[[], T], timeout_s: float, *, beat: Callable[[], None]) -> T:
    """Return what a call returns, while the caller goes on saying that it lives.

    Parameters
    ----------
    what : str
        Names the thread, and stands in the error.
    beat : callable
        Called while waiting; raises to give up. The call is then let come to its end, where it soon does.

    Raises
    ------
    HangsError
        If the call does not return in time.
    Exception
        What the call raised.
    """
    return result_in_time(what, ThreadedCall(action, name=what), timeout_s, beat=beat)


def result_in_time(what: str, call: ThreadedCall[T], timeout_s: float, *, beat: Callable[[], None]) -> T:
    """Return what a call returns that was started before; see `in_time`."""
    deadline_ns = monotonic_ns() + round(timeout_s * 1e9)
    while not call.has_ended(within_s=_POLL_S):
        if monotonic_ns() > deadline_ns:
            raise HangsError(f"{what} hangs: no answer within {timeout_s:g} s. Restart bricktrackd")
        try:
            beat()
        except BaseException:
            call.has_ended(within_s=_GIVE_UP_S)
            raise
    return call.result()
