import threading
import time

import pytest

from bricktrack_common.errors import HardwareError
from bricktrack_device import in_time as in_time_module
from bricktrack_device.in_time import in_time


class StoppingError(Exception):
    pass


def test_a_call_returns_its_value_or_raises_its_error() -> None:
    assert in_time("start", lambda: 7, 5.0, beat=lambda: None) == 7

    def fail() -> int:
        raise OSError("no camera")

    with pytest.raises(OSError, match="no camera"):
        in_time("start", fail, 5.0, beat=lambda: None)


def test_a_call_that_hangs_is_left_to_its_thread() -> None:
    over = threading.Event()
    with pytest.raises(HardwareError, match=r"start hangs: no answer within 0.05 s"):
        in_time("start", over.wait, 0.05, beat=lambda: None)
    over.set()


def test_a_call_that_is_given_up_has_returned_before_the_caller_goes_on() -> None:
    given_up = threading.Event()
    returned = []

    def start() -> None:
        given_up.wait()
        time.sleep(0.05)  # as a camera that is half-way through its start
        returned.append(True)

    def beat() -> None:
        given_up.set()
        raise StoppingError

    with pytest.raises(StoppingError):
        in_time("start", start, 5.0, beat=beat)
    assert returned


def test_giving_up_does_not_wait_for_a_call_that_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(in_time_module, "_GIVE_UP_S", 0.05)
    over = threading.Event()

    def beat() -> None:
        raise StoppingError

    with pytest.raises(StoppingError):
        in_time("start", over.wait, 5.0, beat=beat)
    assert not over.is_set()
    over.set()
