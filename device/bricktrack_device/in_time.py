"""Calls that may hang, waited for by a thread that must go on saying that it lives."""

import threading
import time
from collections.abc import Callable
from typing import TypeVar

from bricktrack_common.errors import HardwareError

_POLL_S = 0.01
_GIVE_UP_S = 5.0
"""How long a call that is given up may still take to return: what comes next must not meet it half-way."""

T = TypeVar("T")


class HangsError(HardwareError):
    """A call did not return in time; it is left to its thread."""


def in_time(what: str, call: Callable[[], T], timeout_s: float, *, beat: Callable[[], None]) -> T:
    """Return what a call returns; one that hangs is left to its thread.

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
    results: list[T] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            results.append(call())
        except BaseException as e:  # noqa: BLE001 - raised again in the caller's thread
            errors.append(e)

    thread = threading.Thread(target=run, name=f"camera-{what}", daemon=True)
    thread.start()
    deadline = time.monotonic() + timeout_s
    try:
        while thread.is_alive() and time.monotonic() < deadline:
            beat()
            thread.join(_POLL_S)
    except BaseException:
        thread.join(_GIVE_UP_S)
        raise
    if errors:
        raise errors[0]
    if not results:
        raise HangsError(f"{what} hangs: no answer within {timeout_s:g} s. Restart bricktrackd")
    return results[0]
