"""The simulated trigger line: gpiozero's mock pins, driven by a square wave with kernel-like stamps.

An edge is stamped with the instant of the wave, not with that of the thread that delivers it, as a kernel
stamps in its interrupt and reports later.
"""

import threading
from typing import Any

import gpiozero.pins.mock
import numpy as np

from bricktrack_common.clocks import monotonic_ns
from bricktrack_device.sim.world import SimWorld

_TAIL_S = 30.0  # the wave goes on after the shake, as a laboratory's does
_LINE_DELAY_NS = 100_000


class StampedPin(gpiozero.pins.mock.MockPin):  # type: ignore[misc]
    """A mock pin whose changes carry the stamp that they are given."""

    def drive_at(self, high: bool, ticks_s: float) -> None:
        """Set the line's level as of ``ticks_s``, s of CLOCK_MONOTONIC, and fire the handler on a change."""
        if self.state != high:
            self._state = high
            self._last_change = ticks_s
            if self._when_changed is not None:
                self._call_when_changed()


class SquareWave:
    """A thread that drives all pins of a factory with the world's square wave."""

    def __init__(self, world: SimWorld, factory: gpiozero.pins.mock.MockFactory) -> None:
        self._world = world
        self._factory = factory
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Drive the wave from the world's first edge on; a wave that runs already ends first."""
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
        s = self._world.settings
        rng = np.random.default_rng([s.seed, 4])
        missed = set(s.faults.missed_edges)
        half_ns = round(0.5e9 / s.square_wave_hz)
        n_edges = int((s.quiet_s + s.shake_s + _TAIL_S) * s.square_wave_hz)
        for i, edge in enumerate(self._world.edge_times_ns(0, n_edges).tolist()):
            jitter = round(float(rng.normal()) * s.edge_jitter_us * 1e3)
            if i in missed:
                continue
            for high, t_ns in ((True, edge + jitter), (False, edge + half_ns)):
                left_s = (t_ns + _LINE_DELAY_NS - monotonic_ns()) * 1e-9
                if left_s > 0 and stop.wait(left_s):
                    return
                if stop.is_set():
                    return
                self._drive(high, t_ns)

    def _drive(self, high: bool, t_ns: int) -> None:
        pins: list[Any] = list(self._factory.pins.values())
        for pin in pins:
            pin.drive_at(high, t_ns * 1e-9)


def make_factory() -> gpiozero.pins.mock.MockFactory:
    """Return a factory of stamped pins."""
    return gpiozero.pins.mock.MockFactory(pin_class=StampedPin)
