"""Works handed to workers until each has come to an end: who does them is another module's choice."""

import traceback
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from bricktrack_common.errors import BricktrackError

_LOOK_S = 1.0  # between looks whether there are workers at all

T = TypeVar("T")
Work = Callable[["RunProgress"], T]
"""What a worker is given: called with who hears of its progress; picklable."""


class RunProgress(Protocol):
    """Hears how far the processing of one run is; see `stages.progress.ProcessProgress`."""

    def stage(self, name: str, total: int | None) -> None:
        """Hear that a stage begins."""
        ...

    def advance_to(self, done: int) -> None:
        """Hear that so many steps of it are done."""
        ...


class WorkerLostError(BricktrackError, RuntimeError):
    """A worker died under its work; another may do it."""


class WorkersGoneError(BricktrackError, ConnectionError):
    """Nobody is left to do any work."""


@dataclass(frozen=True, slots=True)
class Attempt(Generic[T]):
    """What one call of a work came to.

    Attributes
    ----------
    value : object or None
        What it returned; `None` where it failed.
    failure : str
        Why it failed: one line for the user, or the traceback of a bug.
    is_bug : bool
    """

    value: T | None
    failure: str = ""
    is_bug: bool = False


@dataclass(frozen=True, slots=True)
class Outcome(Generic[T]):
    """What became of one work in the end; see `Attempt`."""

    index: int
    value: T | None
    failure: str = ""
    is_bug: bool = False


@dataclass(frozen=True, slots=True)
class Instead(Generic[T]):
    """Another work to be done before the one that returned it counts as done."""

    work: Work[T]


class Workers(Protocol):
    """Who does works, several at once, over the standard ``concurrent.futures``.

    Attributes
    ----------
    attempts : int
        How often a work is given out whose worker dies under it.
    """

    attempts: int

    def room(self) -> int:
        """Return how many works may be given out at once.

        Raises
        ------
        WorkersGoneError
            If nobody is left, and has been for a while.
        """
        ...

    def submit(self, work: Work[Any], progress: RunProgress) -> "Future[Attempt[Any]]":
        """Give out a work; the future raises `WorkerLostError` if its worker died under it."""
        ...

    def stop(self) -> None:
        """Take back what is given out, and wait until nothing half-written is left of it."""
        ...


def attempt(work: Work[T], progress: RunProgress) -> Attempt[T]:
    """Do a work here; a failure is an answer too."""
    try:
        return Attempt(work(progress))
    except BricktrackError as e:
        return Attempt(None, str(e))
    except Exception:  # noqa: BLE001 - a bug in one run is told, and does not stop the others
        return Attempt(None, traceback.format_exc(), is_bug=True)


def do_all(
    n_works: int,
    work_of: Callable[[int], Work[Any]],
    workers: Workers,
    *,
    progress: Callable[[int], RunProgress],
    finish: Callable[[int, Any], "T | Instead[Any]"],
) -> Generator[Outcome[T], None, None]:
    """Have every work done, and yield what became of each as it ends.

    A work whose worker dies is given out again, as often as its ``workers`` say; the last time alone, after
    all others, so that no other one's death is blamed on it and it has all memory. Closing the iterator, or
    an exception such as `KeyboardInterrupt` in its consumer, stops the workers.

    Parameters
    ----------
    n_works : int
    work_of : callable
        Returns the work of a number, called when it is about to be given out: it may be large.
    workers : Workers
    progress : callable
        Called here with the number of a work when it is given out; returns who hears of its progress.
    finish : callable
        Called here with the number of a work and what it returned, and returns what that amounts to, or
        `Instead`. Failures are told by `BricktrackError`.
    """
    waiting = deque((index, 1, work_of) for index in range(n_works))
    last_tries: deque[tuple[int, int, Callable[[int], Work[Any]]]] = deque()
    active: dict[Future[Attempt[Any]], tuple[int, int, Callable[[int], Work[Any]]]] = {}
    try:
        while waiting or active or last_tries:
            if not waiting and not active:
                waiting.append(last_tries.popleft())
            try:
                while waiting and len(active) < workers.room():
                    index, _, make = waiting[0]
                    future = workers.submit(make(index), progress(index))
                    active[future] = waiting.popleft()
            except WorkersGoneError as e:
                for index, _, _ in [*active.values(), *waiting, *last_tries]:
                    yield Outcome(index, None, str(e))
                return
            except BricktrackError as e:  # of `work_of`: what it is made of cannot be read
                index, _, _ = waiting.popleft()
                yield Outcome(index, None, str(e))
            done, _ = wait(active, timeout=_LOOK_S, return_when=FIRST_COMPLETED)
            for future in done:
                index, n_attempt, make = active.pop(future)
                try:
                    came = future.result()
                except WorkerLostError as e:
                    if n_attempt < workers.attempts:
                        is_last = n_attempt + 1 == workers.attempts
                        (last_tries if is_last else waiting).append((index, n_attempt + 1, make))
                    else:
                        yield Outcome(index, None, f"given up after {n_attempt} attempts: {e}")
                    continue
                outcome = _finished(index, came, finish)
                if isinstance(outcome, Instead):
                    waiting.appendleft((index, n_attempt, _always(outcome.work)))
                else:
                    yield outcome
    finally:
        workers.stop()


def _finished(
    index: int, came: Attempt[Any], finish: Callable[[int, Any], "T | Instead[Any]"]
) -> "Outcome[T] | Instead[Any]":
    if came.failure:
        return Outcome(index, None, came.failure, came.is_bug)
    try:
        value = finish(index, came.value)
    except BricktrackError as e:
        return Outcome(index, None, str(e))
    return value if isinstance(value, Instead) else Outcome(index, value)


def _always(work: Work[Any]) -> Callable[[int], Work[Any]]:
    return lambda _: work
