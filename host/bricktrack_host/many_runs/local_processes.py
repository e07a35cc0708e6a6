"""Works done on this machine, each in a process of its own.

A process for each keeps them apart: one that fails, or is ended by the system for want of memory, takes
nothing of the others with it, and its memory is given back when it ends. The standard pool of processes does
not: when one of its processes dies, all works given to it fail.
"""

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import FrameType
from typing import TYPE_CHECKING, Any

from bricktrack_host.many_runs.workers import Attempt, RunProgress, Work, WorkerLostError, attempt

if TYPE_CHECKING:
    from multiprocessing.context import ForkServerContext, SpawnContext

_END_S = 20.0  # for a stopped process to take back what it has half written


class LocalProcesses:
    """So many works at once, each in a process of its own; a `Workers`.

    Parameters
    ----------
    n_at_once : int
    preload : sequence of str
        Modules that the processes need: loaded once and shared, where the system can (not on Windows).
    """

    attempts = 3

    def __init__(self, n_at_once: int, *, preload: Sequence[str] = ()) -> None:
        self._n_at_once = n_at_once
        self._context = _context(preload)
        self._threads = ThreadPoolExecutor(n_at_once, "run")
        self._lock = threading.Lock()
        self._active: set[BaseProcess] = set()
        self._stopped = False

    def room(self) -> int:
        """Return how many works are done at once."""
        return self._n_at_once

    def submit(self, work: Work[Any], progress: RunProgress) -> "Future[Attempt[Any]]":
        """Do a work in a new process, as soon as there is room for it."""
        return self._threads.submit(self._in_a_process, work, progress)

    def stop(self) -> None:
        """End what is under way, and wait until it has taken back what it had half written."""
        with self._lock:
            self._stopped = True
            for process in self._active:
                process.terminate()
        self._threads.shutdown(cancel_futures=True)

    def _in_a_process(self, work: Work[Any], progress: RunProgress) -> Attempt[Any]:
        receiver, sender = self._context.Pipe(duplex=False)
        process = self._context.Process(target=_work, args=(work, sender), name="run")
        with self._lock:
            if self._stopped:
                raise WorkerLostError("stopped")
            process.start()
            self._active.add(process)
        sender.close()  # the child's end alone stays open: its death is seen as the end of the pipe
        try:
            return _heard(receiver, process, progress)
        finally:
            process.terminate()  # nothing to one that has ended
            process.join(_END_S)
            if process.is_alive():
                process.kill()
                process.join()
            with self._lock:
                self._active.discard(process)
            receiver.close()


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


def _heard(connection: Connection, process: BaseProcess, progress: RunProgress) -> Attempt[Any]:
    """Pass on what a process says of its progress, and return what its work came to."""
    while True:
        try:
            kind, *values = connection.recv()
        except (EOFError, ConnectionResetError):
            process.join()
            code = process.exitcode or 0
            words = f"its process ended with {code}"
            if code < 0:
                words = f"its process was ended by signal {-code} ({signal.strsignal(-code)})"
            if code == -9:
                words += ". Memory may have run out: try fewer at once, with --jobs"
            raise WorkerLostError(words) from None
        if kind == "stage":
            progress.stage(*values)
        elif kind == "done":
            progress.advance_to(*values)
        else:
            process.join()
            came: Attempt[Any] = values[0]
            return came


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


def _work(work: Work[Any], connection: Connection) -> None:
    """Do one work in this process and send what became of it."""
    # Ctrl-C reaches every process of the terminal: the parent decides, and ends this one by SIGTERM.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    logging.basicConfig(level=logging.ERROR)  # what matters is among the results' problems
    connection.send(("end", attempt(work, _Sending(connection))))
    connection.close()


def _end_with_parent() -> None:
    """End this process when the one that wants its result is no more, as after a kill.

    The same command given again must not meet it at work on the same run.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _leave(_signal: int, _frame: FrameType | None) -> None:
    raise SystemExit(1)
