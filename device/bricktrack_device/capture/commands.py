"""What other threads ask of the recorder, and how it answers what it does not do."""

import errno
import queue
from collections.abc import Callable
from dataclasses import dataclass

from bricktrack_common.errors import BricktrackError, StorageError
from bricktrack_common.wire_messages import ErrorCode, Refusal, Reply
from bricktrack_device.capture.standing_order import ArmOrder
from bricktrack_device.refusals import RequestRefusedError

Answer = Callable[[Reply], None]

_MAX_WORDS = 2000
_MOST_WAITING = 16


@dataclass(frozen=True, slots=True)
class ArmCommand:
    """Get ready for the next first edge."""

    order: ArmOrder
    answer: Answer


@dataclass(frozen=True, slots=True)
class DisarmCommand:
    """Go back to idle, or leave a fault."""

    answer: Answer


@dataclass(frozen=True, slots=True)
class OtherWork:
    """Work with the unit's sensors that is no run; it answers by itself, and ``answer`` gets refusals."""

    doing: str
    work: Callable[[], None]
    answer: Answer


Command = ArmCommand | DisarmCommand | OtherWork
Inbox = queue.SimpleQueue[Command | None]
"""`None` only wakes the recorder up."""


def put_unless_many(inbox: Inbox, work: OtherWork) -> None:
    """Ask for other work, or refuse it: many pictures would keep the unit from being armed for minutes."""
    if inbox.qsize() < _MOST_WAITING:
        inbox.put(work)
    else:
        words = f"{_MOST_WAITING} commands wait already; ask again later"
        work.answer(Refusal(code="busy", message=words))


def refuse_all(inbox: Inbox, words: str) -> None:
    """Answer whatever still waits that the unit is not ready."""
    while not inbox.empty():
        command = inbox.get()
        if command is not None:
            command.answer(Refusal(code="not-ready", message=words))


def refusal_of(error: Exception) -> Refusal:
    """Return an error as it goes to the host: one raised on purpose in its own words, others as bugs."""
    code: ErrorCode = "internal"
    words = f"{type(error).__name__}: {error}"
    if isinstance(error, BricktrackError):
        code, words = "not-ready", str(error)
    if isinstance(error, RequestRefusedError):
        code = error.code
    elif isinstance(error, StorageError) and error.errno == errno.ENOSPC:
        code = "no-space"
    return Refusal(code=code, message=words[:_MAX_WORDS])
