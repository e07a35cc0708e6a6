"""How long an armed unit has been without what it cannot do without."""

import time
from collections.abc import Callable

from bricktrack_device.capture.session import Session

PATIENCE_S = 5.0
"""A sensor that is silent for a moment comes again; a shake that goes by meanwhile does not."""


class LostSensors:
    """Asked again and again while the unit is armed.

    Parameters
    ----------
    clock : callable
        Seconds, monotonic.
    """

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._since_s: float | None = None

    def words(self, session: Session, *, auto_arm: bool) -> str:
        """Return why the unit should not stay armed, ``""`` unless it was so each time for `PATIENCE_S`.

        A unit that arms itself again is to do so where a required sensor is lost; another one records with
        what there is.
        """
        found = ""
        if not session.has_sensors:
            found = "no sensor is left: " + "; ".join(session.missing)
        elif auto_arm and (lost := session.lost_required):
            found = f"lost while armed: {lost}"
        if not found:
            self._since_s = None
            return ""
        now_s = self._clock()
        if self._since_s is None:
            self._since_s = now_s
        return found if now_s - self._since_s >= PATIENCE_S else ""
