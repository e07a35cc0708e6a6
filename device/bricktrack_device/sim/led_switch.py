"""The simulated unit's LEDs as a switch: when they went on and off, and how long rows saw them lit.

They glow from the start, as LEDs wired to a supply do, until somebody opens them on pins and switches them.
Light follows the switch at once: an LED's rise takes well under a microsecond.
"""

import threading
from types import TracebackType
from typing import Self

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.clocks import monotonic_ns


class LedSwitch:
    """What the renderer asks: instants of switching, shared between the unit's and the camera's threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._changes: list[tuple[int, bool]] = []

    def set(self, on: bool, t_ns: int) -> None:
        """Switch at an instant, which must not come before the last one."""
        with self._lock:
            if self._changes and t_ns < self._changes[-1][0]:
                raise ValueError(f"LEDs switched at {t_ns} ns, before the last change")
            self._changes.append((t_ns, on))

    @property
    def changes(self) -> list[tuple[int, bool]]:
        """Every change so far: instant, ns, CLOCK_MONOTONIC, and whether they glow from then on."""
        with self._lock:
            return list(self._changes)

    def share_lit(self, start_ns: FloatArray, end_ns: FloatArray) -> FloatArray | None:
        """Return which share of each interval, shape (n,), the LEDs glowed; `None`: all the time.

        Parameters
        ----------
        start_ns, end_ns : ndarray, shape (n,), ns, CLOCK_MONOTONIC
        """
        first, last = float(np.min(start_ns)), float(np.max(end_ns))
        with self._lock:
            changes = self._changes
            i = len(changes)
            while i > 0 and changes[i - 1][0] > first:
                i -= 1
            is_on = changes[i - 1][1] if i else True
            inside = [c for c in changes[i:] if c[0] < last]
        if is_on and not inside:
            return None
        lit = np.zeros(np.shape(start_ns))
        since = -np.inf
        for t_ns, on in [*inside, (np.inf, False)]:
            if is_on:
                lit += np.clip(np.minimum(end_ns, t_ns) - np.maximum(start_ns, since), 0, None)
            since, is_on = t_ns, on
        return np.asarray(lit / (end_ns - start_ns))


class SimLeds:
    """The LEDs on a simulated unit's pins, meeting `interfaces.Leds`.

    Parameters
    ----------
    switch : LedSwitch
    lit_afterwards : bool
        Whether they glow again when the pins are given back: those of a unit that has none on pins do.
    """

    def __init__(self, switch: LedSwitch, *, lit_afterwards: bool = True) -> None:
        self._switch: LedSwitch | None = switch
        self._lit_afterwards = lit_afterwards
        switch.set(False, monotonic_ns())

    def switch(self, on: bool) -> tuple[int, int]:
        """Switch; return CLOCK_MONOTONIC before and after, ns."""
        if self._switch is None:
            raise ValueError("these LEDs are closed")
        now = monotonic_ns()
        self._switch.set(on, now)
        return now, monotonic_ns()

    def close(self) -> None:
        """Give the pins back. Calling it twice does no harm."""
        switch, self._switch = self._switch, None
        if switch is not None:
            switch.set(self._lit_afterwards, monotonic_ns())

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give the pins back."""
        self.close()
