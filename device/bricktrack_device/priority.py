"""Work that must not be in the way of a recording: threads that are nice to the others."""

import os
import threading
from collections.abc import Callable

from bricktrack_device.in_time import ThreadedCall

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

    def run() -> None:
        lower_priority()
        action()

    call = ThreadedCall(run, name="low-priority")
    call.has_ended(within_s=None)
    call.result()
