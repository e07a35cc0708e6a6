"""Keeps asking every unit how it is, over a connection that stays open, and counts what changed."""

import threading
from collections.abc import Callable
from dataclasses import replace

import zmq

from bricktrack_common.errors import BricktrackError, UnitError
from bricktrack_host.dashboard.unit_view import UnitView, view_of
from bricktrack_host.transfer.contact import MAX_ASKED_AT_ONCE, Dialer
from bricktrack_host.transfer.fleet_config import UnitConfig
from bricktrack_host.transfer.unit_connection import Stopped

EVERY_S = 0.6
"""Between two questions to a unit; a change is on the page within a second."""
_RETRY_S = 1.0


class FleetWatch:
    """Watches units from one thread each; a context.

    A thread a unit, because one that is silent must not delay what is known of the others.

    Parameters
    ----------
    every_s : float, s
        Between two questions to a unit.
    """

    def __init__(self, units: list[UnitConfig], dialer: Dialer, *, every_s: float = EVERY_S) -> None:
        self._units = units
        self._stop = threading.Event()
        self._dialer = replace(dialer, stop=self._stop)
        self._every_s = every_s
        self._lock = threading.Lock()
        self._version = 0
        self._views = {u.name: UnitView(u.name) for u in units}
        self._changed_at = dict.fromkeys(self._views, 0)
        # Each unit that is being connected to needs several sockets, of which there are about a thousand.
        self._connecting = threading.Semaphore(MAX_ASKED_AT_ONCE)
        self._threads: list[threading.Thread] = []

    def __enter__(self) -> "FleetWatch":
        for unit in self._units:
            thread = threading.Thread(
                target=self._watch, args=(unit,), name=f"watch-{unit.name}", daemon=True
            )
            self._threads.append(thread)
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join(timeout=5.0)

    def changes_since(self, version: int) -> tuple[int, list[UnitView]]:
        """Return the version of now, and what changed after another: everything after -1."""
        with self._lock:
            if version == self._version:
                return version, []
            changed = [view for name, view in self._views.items() if self._changed_at[name] > version]
            return self._version, changed

    def views(self) -> dict[str, UnitView]:
        """Return how every unit is, by name, in the fleet's order."""
        with self._lock:
            return dict(self._views)

    def _tell(self, view: UnitView) -> None:
        with self._lock:
            if self._views[view.name] != view:
                self._version += 1
                self._views[view.name] = view
                self._changed_at[view.name] = self._version

    def _watch(self, unit: UnitConfig) -> None:
        while not self._stop.is_set():
            try:
                self._ask_until_it_fails(unit)
            except Stopped:
                return
            except BricktrackError as e:
                self._tell(view_of(unit.name, e))
            except zmq.ZMQError as e:  # no sockets left: this unit must not look as it did before
                words = f"cannot be asked: {e.strerror}. Watch fewer units, or allow more open files"
                self._tell(view_of(unit.name, UnitError(words, code="no-socket")))
            self._stop.wait(_RETRY_S)

    def _ask_until_it_fails(self, unit: UnitConfig) -> None:
        let_go = _once(self._connecting.release)
        self._connecting.acquire()
        try:
            with self._dialer.reach(unit) as contact:
                let_go()
                while not self._stop.is_set():
                    answer = contact.client.status()
                    self._tell(view_of(unit.name, answer, simulated=contact.hello.simulated))
                    self._stop.wait(self._every_s)
        finally:
            let_go()


def _once(action: Callable[[], None]) -> Callable[[], None]:
    """Return what does an action the first time that it is called, and nothing after."""
    todo = [action]
    return lambda: todo.pop()() if todo else None
