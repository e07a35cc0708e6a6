"""Calls into libraries that may never return, bounded in time."""

import threading
from collections.abc import Callable


def finishes(action: Callable[[], object], *, within_s: float, name: str) -> bool:
    """Run ``action`` in a thread of its own and tell whether it ended in time.

    What is late is left behind in a daemon thread, which does not keep the process alive.

    Raises
    ------
    Exception
        What the action raised in time.
    """
    raised: list[BaseException] = []

    def run() -> None:
        try:
            action()
        except BaseException as e:  # noqa: BLE001  handed to the caller below
            raised.append(e)

    thread = threading.Thread(target=run, name=name, daemon=True)
    thread.start()
    thread.join(within_s)
    if thread.is_alive():
        return False
    if raised:
        raise raised[0]
    return True
