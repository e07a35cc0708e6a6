import os
import threading
from collections.abc import Iterator

import pytest

from bricktrack_device.sim.following_worker import FollowingWorker


@pytest.fixture
def worker() -> Iterator[FollowingWorker]:
    made = FollowingWorker("helper")
    yield made
    made.shutdown()


def seen_by(worker: FollowingWorker) -> tuple[int, int, set[int], int]:
    def look() -> tuple[int, int, set[int], int]:
        return (
            os.sched_getscheduler(0), os.sched_getparam(0).sched_priority, os.sched_getaffinity(0),
            threading.get_ident(),
        )  # fmt: skip

    return worker.submit(look).result(timeout=10)


def in_a_thread(work) -> None:
    """Run something in a thread of its own: what it does to its scheduling ends with it."""
    errors: list[BaseException] = []

    def run() -> None:
        try:
            work()
        except BaseException as e:  # noqa: BLE001 - raised again below
            errors.append(e)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    if errors:
        raise errors[0]


def test_it_follows_a_thread_that_changes_its_policy_and_cores_later(worker: FollowingWorker) -> None:
    def work() -> None:
        before = seen_by(worker)
        assert before[:2] == (os.SCHED_OTHER, 0)
        core = min(os.sched_getaffinity(0))
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))  # needs no rights
        os.sched_setaffinity(0, {core})
        after = seen_by(worker)
        assert after == (os.SCHED_BATCH, 0, {core}, before[3])  # the same thread

    in_a_thread(work)


def test_it_takes_over_a_samplers_fixed_priority(worker: FollowingWorker) -> None:
    def work() -> None:
        seen_by(worker)
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(7))
        except PermissionError:
            pytest.skip("needs the right to SCHED_FIFO")
        assert seen_by(worker)[:2] == (os.SCHED_FIFO, 7)

    in_a_thread(work)


def test_results_and_errors_pass_through(worker: FollowingWorker) -> None:
    assert worker.submit(divmod, 7, 2).result(timeout=10) == (3, 1)
    with pytest.raises(ZeroDivisionError):
        worker.submit(divmod, 7, 0).result(timeout=10)
