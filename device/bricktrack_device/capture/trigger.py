"""The square wave's edges, as stamped where they happened: the wave's first one after arming is t = 0.

gpiozero's ``when_activated`` hands on no stamp, so the pin-level hook is taken: it is called with the edge's
time in seconds (the kernel's stamp under the lgpio factory) and the level. That hook holds a **weak**
reference, hence the bound method of an object that the recorder keeps.
"""

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import gpiozero

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import HardwareError
from bricktrack_device.capture.first_edge import FirstEdgeFinder
from bricktrack_device.config import TriggerTable

logger = logging.getLogger(__name__)

MAX_EDGES = 5_000_000
_MAX_STAMP_AGE_NS = 2_000_000_000
_MAX_STAMP_AHEAD_NS = 5_000_000


@dataclass(frozen=True, slots=True)
class EdgeTrain:
    """What the trigger saw since arming.

    Attributes
    ----------
    t0_ns : int or None
        The first edge that counts.
    edges_ns : list of int
        That edge and every later rising one, in step or not.
    n_ignored : int
        Rising edges before it that did not count: line not seen low, no quiet gap, or out of step.
    rejected_ns : list of int
        The newest of these.
    problems : list of str
    """

    t0_ns: int | None
    edges_ns: list[int]
    n_ignored: int
    problems: list[str]
    rejected_ns: list[int] = field(default_factory=list)


class Trigger:
    """One input pin, watched from `arm` to `close`.

    Parameters
    ----------
    factory : gpiozero.Factory
        lgpio on a Pi; other real factories stamp late, in Python.
    settings : TriggerTable
    clock : callable
        CLOCK_MONOTONIC, ns; stamps that are not on it are refused.
    """

    def __init__(
        self,
        factory: gpiozero.Factory,
        settings: TriggerTable,
        *,
        clock: Callable[[], int] = monotonic_ns,
    ) -> None:
        self._settings = settings
        self._clock = clock
        self._lock = threading.Lock()
        # Apart from the other: closing may wait for a call of _on_change to end.
        self._close_lock = threading.Lock()
        self._on_first_edge: Callable[[], None] | None = None
        self._armed_ns: int | None = None
        self._low_since_ns: int | None = None
        self._last_change_ns = 0
        self._t0_ns: int | None = None
        self._edges_ns: list[int] = []
        self._finder = self._new_finder()
        self._newest_rising_ns = 0
        self._n_out_of_order = 0
        self._n_off_clock = 0
        self._worst_off_ns = 0
        self._bug = ""
        try:
            pull_up, active = {"down": (False, None), "up": (True, None), "none": (None, True)}[settings.pull]
            self._device = gpiozero.DigitalInputDevice(
                settings.pin, pull_up=pull_up, active_state=active, bounce_time=None, pin_factory=factory
            )
        except (gpiozero.GPIOZeroError, OSError, ValueError) as e:
            raise HardwareError(
                f"trigger pin {settings.pin}: {e}. Check trigger.pin, and that no other program holds the pin"
            ) from e
        self._device.pin.when_changed = self._on_change

    @property
    def pin_name(self) -> str:
        """The pin as gpiozero names it."""
        return str(self._device.pin.info.name)

    @property
    def line_is_high(self) -> bool | None:
        """The line's level now; `None` once closed."""
        with self._close_lock:
            return None if self._device.closed else bool(self._device.pin.state)

    @property
    def t0_ns(self) -> int | None:
        """The first edge that counts, once it has come."""
        return self._t0_ns

    @property
    def n_edges(self) -> int:
        """Rising edges logged so far, the first included."""
        return len(self._edges_ns)

    @property
    def newest_edge_ns(self) -> int | None:
        """Stamp of the newest edge of the train; `None` before the first that counts."""
        with self._lock:
            return self._edges_ns[-1] if self._edges_ns else None

    def waiting_words(self) -> str:
        """Return in words what the line does while the first edge is waited for; ``""`` once it has come."""
        if self._armed_ns is None or self._t0_ns is not None:
            return ""
        is_high = self.line_is_high
        with self._lock:
            now, armed_ns, finder = self._clock(), self._armed_ns, self._finder
            if armed_ns is None:
                return ""
            never_low = self._low_since_ns is None
            provisional, n_rejected = finder.provisional_t0_ns, finder.n_rejected
            since_s = (now - armed_ns) / 1e9
            unchanged_s = (now - self._last_change_ns) / 1e9
        level = "high" if is_high else "low"
        if never_low and is_high and self._settings.require_low:
            words = (
                f"armed for {since_s:.0f} s and the line was high all the time: nothing can trigger until it "
                "goes low. Check the wiring, or that the wave rests low"
            )
        else:
            words = f"armed for {since_s:.0f} s; the line is {level}, unchanged for {unchanged_s:.0f} s"
        if provisional is not None:
            words += f"; an edge {(now - provisional) / 1e9:.1f} s ago waits for others in step"
        if n_rejected:
            words += f"; {n_rejected} edges did not count"
        if self._bug:
            words += f"; edges were lost: internal error: {self._bug}"
        return words

    def arm(self, on_first_edge: Callable[[], None]) -> int:
        """Wait for the first edge from now on, and call ``on_first_edge`` from the pin's thread then.

        Returns
        -------
        t_armed_ns : int
        """
        with self._lock:
            now = self._clock()
            self._on_first_edge = on_first_edge
            self._armed_ns = now
            self._last_change_ns = now
            # Read after the clock: a line low here was low at or after arming.
            self._low_since_ns = None if self.line_is_high else now
            self._t0_ns = None
            self._edges_ns = []
            self._finder = self._new_finder()
            self._newest_rising_ns = 0
            self._n_out_of_order = self._n_off_clock = self._worst_off_ns = 0
            self._bug = ""
            return now

    def disarm(self) -> EdgeTrain:
        """Stop logging and return what was seen."""
        with self._lock:
            train = self._train()
            self._armed_ns = None
            return train

    def snapshot(self) -> EdgeTrain:
        """Return what was seen so far."""
        with self._lock:
            return self._train()

    def close(self) -> None:
        """Give the pin back. Calling it twice does no harm."""
        with self._close_lock:
            self._device.close()

    def _new_finder(self) -> FirstEdgeFinder:
        s = self._settings
        return FirstEdgeFinder(1e9 / s.nominal_hz if s.nominal_hz else None, round(s.quiet_gap_ms * 1e6))

    def _train(self) -> EdgeTrain:
        problems = []
        if self._n_out_of_order:
            problems.append(
                f"trigger: {self._n_out_of_order} edges were stamped before the one ahead; left out"
            )
        if self._n_off_clock:
            problems.append(
                f"trigger: {self._n_off_clock} edges have stamps up to {self._worst_off_ns / 1e9:.3f} s off "
                "CLOCK_MONOTONIC and were left out; kernel 5.7 or newer and the lgpio factory are needed"
            )
        if self._bug:
            problems.append(f"trigger: edges were lost: internal error: {self._bug}")
        if len(self._edges_ns) >= MAX_EDGES:
            problems.append(f"trigger: only the first {MAX_EDGES} edges were kept")
        finder = self._finder
        return EdgeTrain(self._t0_ns, list(self._edges_ns), finder.n_rejected, problems, finder.rejected_ns)

    def _on_change(self, ticks_s: float, state: int) -> None:
        """Take one change of the line; called by gpiozero, in the pin's thread.

        Nothing is raised here: lgpio has one thread for all its calls, and an error ends it. No edge would be
        heard any more, in this run and all later ones.
        """
        try:
            self._take_change(round(ticks_s * 1e9), state)
        except Exception as e:
            if not self._bug:
                logger.exception("trigger: a bug; edges are lost")
            self._bug = f"{type(e).__name__}: {e}"

    def _take_change(self, t_ns: int, state: int) -> None:
        first_edge = None
        with self._lock:
            if self._armed_ns is None:
                return
            off_ns = self._clock() - t_ns
            # A report may be late by any time that the unit stood still, but not from before it was armed.
            may_be_old = off_ns <= _MAX_STAMP_AGE_NS or t_ns >= self._armed_ns
            if off_ns < -_MAX_STAMP_AHEAD_NS or not may_be_old:
                self._n_off_clock += 1
                self._worst_off_ns = max(self._worst_off_ns, abs(off_ns))
                return
            if state:
                if self._take_rising(t_ns):
                    first_edge = self._on_first_edge
            elif self._low_since_ns is None and t_ns >= self._armed_ns:
                self._low_since_ns = t_ns
            self._last_change_ns = max(self._last_change_ns, t_ns)
        if first_edge is not None:
            first_edge()

    def _take_rising(self, t_ns: int) -> bool:
        """Log one rising edge; tell whether the first one that counts is known by it."""
        if self._t0_ns is not None:
            if t_ns <= self._edges_ns[-1]:
                self._n_out_of_order += 1
            elif len(self._edges_ns) < MAX_EDGES:
                self._edges_ns.append(t_ns)
            return False
        if t_ns <= self._newest_rising_ns:
            self._n_out_of_order += 1
            return False
        self._newest_rising_ns = t_ns
        armed_ns = self._armed_ns or 0
        seen_low = self._low_since_ns is not None or not self._settings.require_low
        since_ns = self._low_since_ns if self._low_since_ns is not None else armed_ns
        if not seen_low or t_ns < since_ns:
            self._finder.reject(t_ns)
            return False
        believed = self._finder.take(
            t_ns, quiet_ns=t_ns - self._last_change_ns, since_armed_ns=t_ns - armed_ns
        )
        if believed is None:
            return False
        self._edges_ns = believed.edges_ns
        self._t0_ns = believed.t0_ns
        return True
