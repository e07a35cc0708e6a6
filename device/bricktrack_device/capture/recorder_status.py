"""How the recorder is at one moment, put together from the sensors of the run under way."""

from dataclasses import dataclass

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.wire_messages import DaemonState, ImuStatus
from bricktrack_device.capture.session import Session


@dataclass(frozen=True, slots=True)
class RecorderStatus:
    """See the module's first line, and `bricktrack_common.wire_messages.StatusReply` for the fields."""

    state: DaemonState
    reason: str
    run_id: str
    frames: int
    frame_age_ms: float | None
    imus: list[ImuStatus]
    edges: int
    line_is_high: bool | None
    last_error: str
    disk_needed_bytes: int
    auto_arm: bool


def status_of(
    session: Session | None,
    state: DaemonState,
    reason: str,
    *,
    last_error: str,
    disk_needed_bytes: int,
    auto_arm: bool,
) -> RecorderStatus:
    """Return how things are; where ``reason`` is empty, what the trigger waits for and what is missing."""
    newest_us = session.camera.ring.newest_us if session else None
    trigger = session.trigger if session else None
    return RecorderStatus(
        state=state,
        reason=reason or _waiting_words(session),
        run_id=session.run_id if session else "",
        frames=session.camera.ring.n_packets if session else 0,
        frame_age_ms=None if newest_us is None else (monotonic_ns() - newest_us * 1000) / 1e6,
        imus=[i.status() for i in list(session.imus)] if session else [],
        edges=trigger.n_edges if trigger else 0,
        line_is_high=trigger.line_is_high if trigger else None,
        last_error=last_error,
        disk_needed_bytes=disk_needed_bytes,
        auto_arm=auto_arm,
    )


def _waiting_words(session: Session | None) -> str:
    if session is None or session.trigger is None:
        return ""
    return "; ".join(words for words in (session.trigger.waiting_words(), *session.missing) if words)
