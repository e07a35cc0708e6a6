"""Feeds systemd's watchdog, as long as the daemon's threads make progress and it can have its camera."""

import logging
from typing import Protocol

from bricktrack_common.wire_messages import DaemonState
from bricktrack_device.health.storage import MAX_SAVING_S
from bricktrack_device.systemd_notify import notify

logger = logging.getLogger(__name__)

MAX_BEAT_AGE_S = 8.0
"""A thread that did nothing for so long hangs: systemd's watchdog is not fed any more."""


class Watched(Protocol):
    """The recorder, as far as its progress goes."""

    @property
    def state(self) -> DaemonState:
        """The present state."""
        ...

    @property
    def beat_age_s(self) -> float:
        """Seconds since it was last seen at work."""
        ...

    @property
    def restart_reason(self) -> str:
        """Why only a restart helps; empty while it does not."""
        ...


class Beating(Protocol):
    """Another thread that says when it was last at work."""

    @property
    def beat_age_s(self) -> float:
        """Seconds since it was last seen at work."""
        ...


class Watchdog:
    """Tells systemd of progress; what stops it is logged once.

    Parameters
    ----------
    recorder : Watched
        Its beat is given only by a loop that looks at every sensor.
    server : Beating
    """

    def __init__(self, recorder: Watched, server: Beating) -> None:
        self._recorder = recorder
        self._server = server
        self._told = ""

    def complaint(self) -> str:
        """Return why the daemon should be started anew, in words; empty while all is well."""
        state = self._recorder.state
        limit_s = MAX_SAVING_S if state == "saving" else MAX_BEAT_AGE_S
        if self._recorder.beat_age_s >= limit_s:
            return f"the recorder's thread made no progress for {limit_s:g} s"
        # A run is worth more than an answer: the server's thread is not waited for before it is on the card.
        if state not in ("recording", "saving") and self._server.beat_age_s >= MAX_BEAT_AGE_S:
            return f"the server's thread made no progress for {MAX_BEAT_AGE_S:g} s"
        return self._recorder.restart_reason

    def feed(self) -> bool:
        """Tell systemd that all is well, if it is; return whether it is."""
        complaint = self.complaint()
        if not complaint:
            notify(f"WATCHDOG=1\nSTATUS={self._recorder.state}")
        elif complaint != self._told:
            notify(f"STATUS=to be started anew: {complaint}".replace("\n", " "))
            logger.error("systemd's watchdog is not fed any more: %s", complaint)
        self._told = complaint
        return not complaint
