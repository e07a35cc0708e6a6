"""Several runs processed side by side, each in a process of its own.

A process for each run keeps them apart: one that fails, or is ended by the system for want of memory, takes
nothing of the others with it, and its memory is given back when it ends. How many work at once is bounded by
processors and by memory.
"""

import logging
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

from bricktrack_common.errors import BricktrackError

if TYPE_CHECKING:
    from multiprocessing.context import ForkServerContext, SpawnContext

RUN_MEMORY_MB = 800
"""More than a run of 1080p and 45 s takes, simulated: 330 MB, and 9 MB a second for the smoother."""
_MEMORY_SHARE = 0.8
_END_S = 20.0  # for a stopped process to take back what it has half written

T = TypeVar("T")
Work = Callable[["RunProgress"], T]


class RunProgress(Protocol):
    """Hears how far the processing of one run is; see `pipeline.ProcessProgress`."""

    def stage(self, name: str, total: int | None) -> None:
        """Hear that a stage begins."""
        ...

    def advance_to(self, done: int) -> None:
        """Hear that so many steps of it are done."""
        ...


@dataclass(frozen=True, slots=True)
class Outcome(Generic[T]):
    """What became of one run.

    Attributes
    ----------
    index : int
        Of its work.
    value : object or None
        What the work returned; `None` where it failed.
    failure : str
        Why it failed: one line for the user, or the traceback of a bug.
    is_bug : bool
    """

    index: int
    value: T | None
    failure: str = ""
    is_bug: bool = False


def default_workers(n_runs: int) -> int:
    """Return how many runs to process at once: as many as there are processors and memory for."""
    at_most = min(n_runs, os.cpu_count() or 1)
    available_mb = available_memory_mb()
    if available_mb is not None:
        at_most = min(at_most, int(_MEMORY_SHARE * available_mb / RUN_MEMORY_MB))
    return max(at_most, 1)


def available_memory_mb() -> float | None:
    """Return how much memory programs can still have; `None` where the system does not say (not Linux)."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    kilobytes = next((line.split()[1] for line in lines if line.startswith("MemAvailable:")), None)
    return None if kilobytes is None else int(kilobytes) / 1024


def process_side_by_side(
    works: Sequence[Work[T]],
    *,
    workers: int,
    progress: Callable[[int], RunProgress],
    preload: Sequence[str] = (),
) -> Generator[Outcome[T], None, None]:
    """Do each work in a process of its own, ``workers`` at a time, and yield their outcomes as they end.

    Closing the iterator, or an exception such as `KeyboardInterrupt` in its consumer, stops what is under way
    and waits until it has taken back what it had half written.

    Parameters
    ----------
    works : sequence of callable
        Each called with its progress; picklable, as `functools.partial` of a module's function is.
    workers : int
    progress : callable
        Called here with the number of a work when that begins; returns who hears of its progress.
    preload : sequence of str
        Modules that the processes need: loaded once and shared, where the system can (not on Windows).
    """
    context = _context(preload)
    waiting = list(range(len(works)))[::-1]
    active: dict[Connection, _Active] = {}
    try:
        while waiting or active:
            while waiting and len(active) < workers:
                index = waiting.pop()
                receiver, sender = context.Pipe(duplex=False)
                process = context.Process(target=_work, args=(works[index], sender), name=f"run {index}")
                process.start()
                sender.close()  # the child's end alone stays open: its death is seen as the end of the pipe
                active[receiver] = _Active(index, process, progress(index))
            for ready in wait(list(active)):
                assert isinstance(ready, Connection)  # noqa: S101 - on Windows too, pipes are
                outcome = _hear(ready, active[ready])
                if outcome is not None:
                    active.pop(ready).process.join()
                    ready.close()
                    yield outcome
    finally:
        for a in active.values():
            a.process.terminate()
        for connection, a in active.items():
            a.process.join(_END_S)
            if a.process.is_alive():
                a.process.kill()
                a.process.join()
            connection.close()


def _context(preload: Sequence[str]) -> "ForkServerContext | SpawnContext":
    """Return how processes are started: forked off one that has loaded the modules, or each anew."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    from multiprocessing import forkserver  # not on Windows

    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(preload))
    in_main_thread = threading.current_thread() is threading.main_thread()
    # Started deaf to Ctrl-C, which would end it with a traceback while it loads.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN) if in_main_thread else None
    try:
        forkserver.ensure_running()
    finally:
        if in_main_thread:
            signal.signal(signal.SIGINT, before)
    return context


@dataclass(frozen=True, slots=True)
class _Active:
    index: int
    process: BaseProcess
    progress: RunProgress


def _hear(connection: Connection, active: _Active) -> Outcome[Any] | None:
    """Take one message of a process; return its outcome if that was it."""
    try:
        message = connection.recv()
    except EOFError:
        active.process.join()
        code = active.process.exitcode or 0
        words = f"its process ended with {code}"
        if code < 0:
            words = f"its process was ended by signal {-code} ({signal.strsignal(-code)})"
        if code == -9:
            words += ". Memory may have run out: try fewer at once, with --jobs"
        return Outcome(active.index, None, words)
    kind, *values = message
    if kind == "stage":
        active.progress.stage(*values)
    elif kind == "done":
        active.progress.advance_to(*values)
    else:
        return Outcome(active.index, *values)
    return None


class _Sending:
    """Sends progress through a pipe, a hundred times a stage at most."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._every = 1

    def stage(self, name: str, total: int | None) -> None:
        self._every = max((total or 0) // 100, 1)
        self._connection.send(("stage", name, total))

    def advance_to(self, done: int) -> None:
        if done % self._every == 0:
            self._connection.send(("done", done))


def _work(work: Work[T], connection: Connection) -> None:
    """Do one work in this process and send what became of it."""
    # Ctrl-C reaches every process of the terminal: the parent decides, and ends this one by SIGTERM.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    logging.basicConfig(level=logging.ERROR)  # what matters is among the results' problems
    value, failure, is_bug = None, "", False
    try:
        value = work(_Sending(connection))
    except BricktrackError as e:
        failure = str(e)
    except Exception:  # noqa: BLE001 - a bug in one run is told, and does not stop the others
        failure, is_bug = traceback.format_exc(), True
    connection.send(("end", value, failure, is_bug))
    connection.close()


def _leave(_signal: int, _frame: FrameType | None) -> None:
    raise SystemExit(1)
