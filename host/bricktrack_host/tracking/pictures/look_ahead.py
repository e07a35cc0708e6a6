"""Run an iterator ahead of its consumer, in a thread of its own: decoding goes on while LEDs are measured."""

import queue
import threading
from collections.abc import Generator, Iterable
from typing import TypeVar

T = TypeVar("T")


def look_ahead(items: Iterable[T], *, depth: int = 2) -> Generator[T, None, None]:
    """Yield the items in order, taken from their iterator up to ``depth`` ahead of the consumer.

    An error of the iterator is raised here, after the items before it. When the consumer stops early and
    closes this generator, the iterator is taken no further and is closed, in its thread, before it returns.

    Worth it where the iterator waits or works outside Python's lock, as a decoder does.
    """
    ready: queue.Queue[tuple[bool, T | BaseException | None]] = queue.Queue(depth)
    stop = threading.Event()

    def put(is_item: bool, value: T | BaseException | None) -> None:
        while not stop.is_set():
            try:
                ready.put((is_item, value), timeout=0.1)
            except queue.Full:
                continue
            return

    def take() -> None:
        iterator = iter(items)
        error: BaseException | None = None
        try:
            for item in iterator:
                put(True, item)
                if stop.is_set():
                    break
        except BaseException as e:  # noqa: BLE001 - raised again in the consumer's thread
            error = e
        finally:
            if isinstance(iterator, Generator):
                iterator.close()
        put(False, error)

    thread = threading.Thread(target=take, name="look-ahead", daemon=True)
    thread.start()
    try:
        while True:
            is_item, value = ready.get()
            if is_item:
                yield value  # type: ignore[misc]
            elif isinstance(value, BaseException):
                raise value
            else:
                return
    finally:
        stop.set()
        thread.join()
