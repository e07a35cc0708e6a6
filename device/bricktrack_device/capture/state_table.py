"""The daemon's states, and the one table of what leads from one to another and who may cause it."""

from dataclasses import dataclass
from typing import Literal

from bricktrack_common.errors import DeviceError
from bricktrack_common.wire_messages import DaemonState
from bricktrack_device.refusals import RequestRefusedError

Cause = Literal[
    "arm", "disarm", "first-edge", "window-over", "stop", "saved", "save-failed", "save-again", "failure"
]
"""What makes the unit change its state.

``arm``, ``disarm``: a host's command, or the configuration's ``auto_arm``, which also leaves a fault;
``first-edge``: the square wave; ``window-over``: the clock; ``stop``: the daemon is told to end; ``saved``,
``save-failed``, ``save-again``: the run store; ``failure``: a sensor that is needed is lost, or a bug.
"""

TRANSITIONS: dict[tuple[DaemonState, Cause], DaemonState] = {
    ("idle", "arm"): "armed",
    ("idle", "failure"): "fault",
    ("armed", "first-edge"): "recording",
    ("armed", "disarm"): "idle",
    ("armed", "stop"): "idle",
    ("armed", "failure"): "fault",
    ("recording", "window-over"): "saving",
    ("recording", "stop"): "saving",
    ("recording", "failure"): "fault",
    ("saving", "saved"): "idle",
    ("saving", "save-failed"): "fault",
    ("saving", "failure"): "fault",
    ("fault", "save-again"): "saving",
    ("fault", "disarm"): "idle",
    ("fault", "failure"): "fault",
}


@dataclass(frozen=True, slots=True)
class StateChange:
    """One change, for the log."""

    before: DaemonState
    after: DaemonState
    cause: Cause
    reason: str


class StateMachine:
    """Where the unit stands. Written by the recorder's thread alone; reading from others is safe."""

    def __init__(self) -> None:
        self._state: DaemonState = "idle"
        self._reason = ""

    @property
    def state(self) -> DaemonState:
        """The present state."""
        return self._state

    @property
    def reason(self) -> str:
        """Why the unit is in ``fault``; empty otherwise."""
        return self._reason

    def allows(self, cause: Cause) -> bool:
        """Tell whether ``cause`` leads anywhere from here."""
        return (self._state, cause) in TRANSITIONS

    def require(self, cause: Cause, *, run_id: str = "") -> None:
        """Refuse a command that leads nowhere from here, and say what does; ``run_id`` is that under way.

        Raises
        ------
        RequestRefusedError
            If the table has no such way.
        """
        if self.allows(cause):
            return
        remedies: dict[DaemonState, str] = {
            "armed": "disarm it first",
            "recording": "the recording ends by itself",
            "saving": "wait until the run is saved",
            "fault": f"{self._reason}. Disarm clears the fault",
        }
        words = remedies.get(self._state, "nothing to do")
        of_run = f" run {run_id}" if run_id else ""
        raise RequestRefusedError("wrong-state", f"the unit is {self._state}{of_run}: {words}")

    def change(self, cause: Cause, *, reason: str = "") -> StateChange:
        """Follow the table; a fault needs its reason.

        Raises
        ------
        DeviceError
            If the table has no such way.
        """
        after = TRANSITIONS.get((self._state, cause))
        if after is None:
            raise DeviceError(f"the unit is {self._state}: {cause!r} leads nowhere from there")
        if after == "fault" and not reason:
            raise DeviceError("a fault without a reason helps nobody; say what happened")
        before, self._state = self._state, after
        self._reason = reason if after == "fault" else ""
        return StateChange(before, after, cause, reason)
