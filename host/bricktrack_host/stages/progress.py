"""How far the processing of a run is, and how long its stages took."""

import ctypes
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol


class ProcessProgress(Protocol):
    """Hears how far the processing of one run is."""

    def stage(self, name: str, total: int | None) -> None:
        """Hear that a stage begins; ``total`` steps are expected, if that is known."""
        ...

    def advance_to(self, done: int) -> None:
        """Hear that so many steps of the stage are done."""
        ...


class Silent:
    """Listens to nothing."""

    def stage(self, name: str, total: int | None) -> None:
        """Hear nothing."""

    def advance_to(self, done: int) -> None:
        """Hear nothing."""


@dataclass(slots=True)
class Stages:
    """Tells what begins, and keeps the seconds that it took."""

    progress: ProcessProgress
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, name: str, total: int | None = None) -> Iterator[None]:
        """Surround a stage."""
        _give_back_memory()
        self.progress.stage(name, total)
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = time.perf_counter() - start


def _give_back_memory() -> None:
    """Give the system what lies unused between what is used, where the C library can (glibc).

    It would stay with the process, and the next stage's larger arrays would come on top of it.
    """
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (AttributeError, OSError, TypeError):  # another C library; TypeError: Windows
        return
