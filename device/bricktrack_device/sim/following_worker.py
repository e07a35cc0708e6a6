"""A thread of the simulation that is scheduled like the thread that gives it work."""

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

_Scheduling = tuple[int, int, frozenset[int]]


class FollowingWorker(ThreadPoolExecutor):
    """One thread, for work between the slots of a sampler.

    The sampler asks for a fixed priority when its sensor is set up. A helper with ordinary priority would be
    held off by other programs while it has the interpreter's lock, and the sampler would wait for it.

    Parameters
    ----------
    name : str
    """

    def __init__(self, name: str) -> None:
        super().__init__(1, thread_name_prefix=name)

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Do something soon, with the policy, priority and cores of the calling thread."""
        wanted = _scheduling()

        def run() -> T:
            _follow(wanted)
            return fn(*args, **kwargs)

        return super().submit(run)


def _scheduling() -> _Scheduling:
    """Return policy, priority and cores of this thread (0 is the thread, not the process, on Linux)."""
    return os.sched_getscheduler(0), os.sched_getparam(0).sched_priority, frozenset(os.sched_getaffinity(0))


def _follow(wanted: _Scheduling) -> None:
    policy, priority, cores = wanted
    if _scheduling() == wanted:
        return
    try:
        os.sched_setscheduler(0, policy, os.sched_param(priority))
        os.sched_setaffinity(0, cores)
    except PermissionError:
        return  # it works all the same, only later
