"""What people at the page tell units to do: one order at a time, with each unit's acknowledgement kept."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from bricktrack_common.errors import BricktrackError, UnitError
from bricktrack_host.transfer.contact import Contact, Dialer, ask_units
from bricktrack_host.transfer.fleet_config import UnitConfig
from bricktrack_host.transfer.pull import PullSettings, pull_fleet


class OrderBusyError(UnitError):
    """Another order is under way."""


@dataclass(frozen=True, slots=True)
class OrderLine:
    """What became of an order at one unit.

    Attributes
    ----------
    level : "FAILED", "note", "under way", "waits" or "done"
    share : float or None
        For a pull under way: how much of the unit's runs is here, 0 to 1.
    """

    unit: str
    level: str
    words: str
    share: float | None = None


@dataclass(slots=True)
class Pulled:
    """How far the pull of one unit is: bytes verified here, and to come in all."""

    n_bytes: int = 0
    n_bytes_total: int = 0
    has_its_turn: bool = False


@dataclass(slots=True)
class Order:
    """One order to units, and what came of it so far.

    Attributes
    ----------
    doing : str
        What is done, as "arm shake-07".
    units : tuple of str
    acknowledged : dict
        The words of each unit that did as it was told.
    refused : dict
        The error of each that did not.
    notes : list of (unit, words)
    pulled : dict
        For a pull: how far each unit is.
    """

    doing: str
    units: tuple[str, ...]
    started_s: float = field(default_factory=time.monotonic)
    ended_s: float | None = None
    acknowledged: dict[str, str] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    notes: list[tuple[str, str]] = field(default_factory=list)
    pulled: dict[str, Pulled] = field(default_factory=dict)

    @property
    def n_bytes(self) -> tuple[int, int]:
        """For a pull: bytes verified here, and to come in all."""
        pulled = list(self.pulled.values())
        return sum(p.n_bytes for p in pulled), sum(p.n_bytes_total for p in pulled)

    @property
    def share(self) -> float:
        """How much of it is done, 0 to 1."""
        n_bytes, n_bytes_total = self.n_bytes
        if self.ended_s is not None:
            return 1.0
        if n_bytes_total:
            return min(n_bytes / n_bytes_total, 1.0)
        return (len(self.acknowledged) + len(self.refused)) / max(len(self.units), 1)

    @property
    def words(self) -> str:
        """One line: how far it is."""
        good = "done" if self.doing == "pull" else "acknowledged"
        parts = [f"{self.doing}: {len(self.acknowledged)} of {len(self.units)} units {good}"]
        if self.refused:
            parts.append(f"{len(self.refused)} failed")
        n_bytes, n_bytes_total = self.n_bytes
        if n_bytes_total:
            spent_s = max((self.ended_s or time.monotonic()) - self.started_s, 1e-3)
            parts.append(f"{_mb(n_bytes, n_bytes_total)}, {n_bytes / 1e6 / spent_s:.1f} MB/s")
        if self.ended_s is None:
            parts.append("under way")
        return ", ".join(parts)

    def lines(self) -> list[OrderLine]:
        """Return what became of it at each unit: what went wrong first, then what is under way."""
        found = [OrderLine(unit, "FAILED", words) for unit, words in list(self.refused.items())]
        found += [OrderLine(unit, "note", words) for unit, words in list(self.notes)]
        waiting = []
        for unit in self.units:
            if unit in self.refused or unit in self.acknowledged or self.ended_s is not None:
                continue
            pulled = self.pulled.get(unit)
            if pulled is None:
                waiting.append(OrderLine(unit, "waits", ""))
            elif not pulled.has_its_turn:
                waiting.append(OrderLine(unit, "waits", f"{pulled.n_bytes_total / 1e6:.1f} MB to come"))
            else:
                share = pulled.n_bytes / pulled.n_bytes_total if pulled.n_bytes_total else 0.0
                words = _mb(pulled.n_bytes, pulled.n_bytes_total)
                found.append(OrderLine(unit, "under way", words, min(max(share, 0.0), 1.0)))
        return [
            *found,
            *waiting,
            *(OrderLine(unit, "done", words) for unit, words in list(self.acknowledged.items())),
        ]


def _mb(n_bytes: int, n_bytes_total: int) -> str:
    return f"{n_bytes / 1e6:.1f} of {n_bytes_total / 1e6:.1f} MB"


class OrderDesk:
    """Gives orders to units, from any thread; ``version`` grows with everything that happens.

    Parameters
    ----------
    runs_folder : Path or None
        Where runs are pulled to; `None` without a fleet file.
    """

    def __init__(self, units: list[UnitConfig], dialer: Dialer, runs_folder: Path | None) -> None:
        self._units = {u.name: u for u in units}
        self.dialer = dialer
        self._busy = threading.Lock()
        self._lock = threading.Lock()
        self.runs_folder = runs_folder
        self.current: Order | None = None
        self.version = 0

    def unit(self, name: str) -> UnitConfig:
        """Return a unit by its name."""
        return self._units[name]

    def arm(self, names: list[str], label: str, duration_s: float | None) -> Order:
        """Make units ready for the next first edge; returns when all have answered."""

        def words(contact: Contact) -> str:
            armed = contact.client.arm(label, duration_s=duration_s)
            without = f", without {', '.join(armed.missing)}" if armed.missing else ""
            return f"armed, run {armed.run_id}{without}"

        return self._give(f"arm {label}".strip(), names, words)

    def disarm(self, names: list[str]) -> Order:
        """Bring units back to idle; returns when all have answered."""

        def words(contact: Contact) -> str:
            contact.client.disarm()
            return "idle"

        return self._give("disarm", names, words)

    def pull(self, names: list[str]) -> Order:
        """Bring the runs of units here, verified; those that wait for a trigger are left alone.

        Raises
        ------
        UnitError
            If there is no fleet file to name the folder.
        """
        if self.runs_folder is None:
            raise UnitError(
                "pulling needs the folder that a fleet file names. Start the page with --fleet",
                code="no-folder",
            )
        folder = self.runs_folder
        order = self._begin("pull", names)
        try:
            done = pull_fleet(
                [self._units[n] for n in names], folder, dialer=self.dialer,
                settings=PullSettings(patience_s=10.0), progress=_PullBoard(self, order),
            )  # fmt: skip
            for result in done:
                if result.errors:
                    self._note(order, result.unit, "; ".join(str(e) for e in result.errors), refused=True)
                else:
                    n = len(result.runs)
                    self._note(order, result.unit, f"{n} run{'' if n == 1 else 's'} here, verified")
        finally:
            self._end(order)
        return order

    def _give(self, doing: str, names: list[str], words: Callable[[Contact], str]) -> Order:
        order = self._begin(doing, names)

        def told(unit: UnitConfig, answer: str | BricktrackError) -> None:
            self._note(order, unit.name, str(answer), refused=isinstance(answer, BricktrackError))

        try:
            ask_units([self._units[n] for n in names], words, dialer=self.dialer, told=told)
        finally:
            self._end(order)
        return order

    def _begin(self, doing: str, names: list[str]) -> Order:
        if not self._busy.acquire(blocking=False):
            under_way = self.current.doing if self.current else "an order"
            raise OrderBusyError(f"{under_way!r} is under way. Wait until it is done", code="busy")
        self.current = Order(doing, tuple(names))
        self.touch()
        return self.current

    def _note(self, order: Order, unit: str, words: str, *, refused: bool = False) -> None:
        with self._lock:
            (order.refused if refused else order.acknowledged)[unit] = words
        self.touch()

    def _end(self, order: Order) -> None:
        order.ended_s = time.monotonic()
        self._busy.release()
        self.touch()

    def touch(self) -> None:
        """Say that something changed."""
        with self._lock:
            self.version += 1


class _PullBoard:
    """Adds up what a pull tells; see `bricktrack_host.transfer.pull_progress.PullProgress`."""

    def __init__(self, desk: OrderDesk, order: Order) -> None:
        self._desk, self._order = desk, order
        self._lock = threading.Lock()

    def unit_listed(self, unit: str, n_runs: int, n_bytes: int) -> None:
        with self._lock:
            self._of(unit).n_bytes_total += n_bytes
        self._desk.touch()

    def unit_started(self, unit: str) -> None:
        with self._lock:
            self._of(unit).has_its_turn = True
        self._desk.touch()

    def bytes_done(self, unit: str, n_bytes: int) -> None:
        with self._lock:
            self._of(unit).n_bytes += n_bytes
        self._desk.touch()

    def unit_done(self, unit: str) -> None:
        self._desk.touch()

    def note(self, unit: str, text: str) -> None:
        with self._lock:
            self._order.notes.append((unit, text))
        self._desk.touch()

    def _of(self, unit: str) -> Pulled:
        return self._order.pulled.setdefault(unit, Pulled())
