"""Work that must not be in the way of a recording: threads that are nice to the others."""

import os
import threading
from collections.abc import Callable

NICENESS = 10


def lower_priority() -> None:
    """Let all ordinary threads go before the calling one; on Linux, niceness belongs to a thread."""
    thread = threading.get_native_id()
    if os.getpriority(os.PRIO_PROCESS, thread) < NICENESS:  # the way back is for root alone
        os.setpriority(os.PRIO_PROCESS, thread, NICENESS)


def at_low_priority(action: Callable[[], None]) -> None:
    """Do something in a thread of low priority, which threads made there inherit, and wait for it.

    Raises
    ------
    Exception
        What the action raised.
    """
    raised: list[BaseException] = []

    def run() -> None:
        lower_priority()
        try:
            action()
        except BaseException as e:  # noqa: BLE001  raised again in the caller's thread
            raised.append(e)

    thread = threading.Thread(target=run, name="low-priority")
    thread.start()
    thread.join()
    if raised:
        raise raised[0]
