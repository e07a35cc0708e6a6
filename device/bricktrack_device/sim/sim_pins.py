"""The simulated trigger line: gpiozero's mock pins, driven by a square wave with kernel-like stamps.

An edge is stamped with the instant of the wave, not with that of the thread that delivers it, as a kernel
stamps in its interrupt and reports later.
"""

import threading
from collections.abc import Iterator
from typing import Any

import gpiozero.pins.mock
import numpy as np

from bricktrack_common.clocks import monotonic_ns
from bricktrack_device.sim.world import SimWorld

_LINE_DELAY_NS = 100_000
_EDGES_AT_A_TIME = 200
_UNHEARD_WAIT_S = 0.02


class StampedPin(gpiozero.pins.mock.MockPin):  # type: ignore[misc]
    """A mock pin whose changes carry the stamp that they are given."""

    def drive_at(self, high: bool, ticks_s: float) -> None:
        """Set the line's level as of ``ticks_s``, s of CLOCK_MONOTONIC, and fire the handler on a change."""
        if self._function == "input" and bool(self.state) != high:
            self._state = high
            self._last_change = ticks_s
            if self.is_heard:
                self._call_when_changed()

    @property
    def is_heard(self) -> bool:
        """Whether somebody listens to the changes."""
        return self._when_changed is not None


class SquareWave:
    """A thread that drives all input pins of a factory with the world's square wave."""

    def __init__(self, world: SimWorld, factory: gpiozero.pins.mock.MockFactory) -> None:
        self._world = world
        self._factory = factory
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Drive the wave from the world's first edge on until `stop`; a wave that runs already ends first."""
        self.stop()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(self._stop,), name="sim-wave", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Let the line fall and stay low."""
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout=2)
        self._thread = None
        self._drive(False, monotonic_ns())

    def _run(self, stop: threading.Event) -> None:
        heard_since_ns: int | None = None
        for high, stamp_ns in self._changes():
            while not self._is_heard() and monotonic_ns() <= stamp_ns:
                if stop.wait(_UNHEARD_WAIT_S):
                    return
            if not self._is_heard():
                heard_since_ns = None
                continue  # over before anybody listened
            if heard_since_ns is None:
                heard_since_ns = monotonic_ns()
            if stamp_ns < heard_since_ns - _LINE_DELAY_NS:
                continue  # likewise, if only just
            left_s = (stamp_ns + _LINE_DELAY_NS - monotonic_ns()) * 1e-9
            if (left_s > 0 and stop.wait(left_s)) or stop.is_set():
                return
            self._drive(high, stamp_ns)

    def _changes(self) -> Iterator[tuple[bool, int]]:
        """Yield level and stamp of the line's changes, for ever."""
        s = self._world.settings
        missed, late_us = set(s.faults.missed_edges), dict(s.faults.late_edges)
        half_ns = round(0.5e9 / s.square_wave_hz)
        first = 0
        while True:
            rng = np.random.default_rng([s.seed, 4, first])
            jitter_us = rng.normal(size=_EDGES_AT_A_TIME) * s.edge_jitter_us
            edges = self._world.edge_times_ns(first, first + _EDGES_AT_A_TIME).tolist()
            for i, edge_ns in enumerate(edges, start=first):
                if i in missed:
                    continue  # neither change was heard: the line seems to have stayed low
                yield True, edge_ns + round((jitter_us[i - first] + late_us.get(i, 0.0)) * 1e3)
                yield False, edge_ns + half_ns
            first += _EDGES_AT_A_TIME

    def _is_heard(self) -> bool:
        return any(pin.is_heard for pin in self._pins())

    def _pins(self) -> list[Any]:
        return list(self._factory.pins.values())

    def _drive(self, high: bool, t_ns: int) -> None:
        for pin in self._pins():
            pin.drive_at(high, t_ns * 1e-9)


def make_factory() -> gpiozero.pins.mock.MockFactory:
    """Return a factory of stamped pins."""
    return gpiozero.pins.mock.MockFactory(pin_class=StampedPin)
