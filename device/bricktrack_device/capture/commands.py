"""What other threads ask of the recorder, and how it answers what it does not do."""

import errno
from collections.abc import Callable
from dataclasses import dataclass

from bricktrack_common.errors import BricktrackError, StorageError
from bricktrack_common.wire_messages import ErrorCode, Refusal, Reply
from bricktrack_device.refusals import RequestRefusedError

Answer = Callable[[Reply], None]

_MAX_WORDS = 2000


@dataclass(frozen=True, slots=True)
class ArmCommand:
    """Get ready for the next first edge; ``duration_s`` overrides the configured one."""

    label: str
    duration_s: float | None
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
