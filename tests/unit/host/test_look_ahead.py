"""Looking ahead changes neither the items, nor their order, nor how iteration ends."""

import threading

import pytest

from bricktrack_common.errors import VideoError
from bricktrack_host.tracking.pictures.look_ahead import look_ahead


def test_items_come_in_order_and_all():
    assert list(look_ahead(range(1000))) == list(range(1000))
    assert list(look_ahead([])) == []
    assert list(look_ahead([None, None])) == [None, None]


def test_an_error_comes_after_the_items_before_it():
    def items():
        yield 1
        yield 2
        raise VideoError("the file ends here")

    seen = []
    with pytest.raises(VideoError, match="the file ends here"):
        for item in look_ahead(items()):
            seen.append(item)
    assert seen == [1, 2]


def test_it_runs_ahead_by_its_depth_and_no_further():
    asked = threading.Semaphore(0)
    taken = []

    def items():
        for i in range(100):
            taken.append(i)
            asked.release()
            yield i

    ahead = look_ahead(items(), depth=3)
    assert next(ahead) == 0
    for _ in range(5):  # the one given, three that wait, one in the thread's hand
        assert asked.acquire(timeout=10)
    assert not asked.acquire(timeout=0.3)
    assert taken == [0, 1, 2, 3, 4]
    ahead.close()


def test_stopping_early_closes_the_iterator_and_ends_the_thread():
    closed_in = []

    def items():
        try:
            yield from range(10**9)
        finally:
            closed_in.append(threading.current_thread().name)

    before = threading.active_count()
    ahead = look_ahead(items())
    assert next(ahead) == 0
    ahead.close()
    assert closed_in == ["look-ahead"]
    assert threading.active_count() == before
