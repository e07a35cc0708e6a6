import threading
from pathlib import Path

import pytest

from bricktrack_device.capture import arming
from bricktrack_device.capture.arming import BringIn
from bricktrack_device.capture.black_box import BlackBox
from bricktrack_device.in_time import HangsError
from bricktrack_device.storage.run_store import RunStore


def test_a_bring_in_that_hangs_is_waited_for_and_not_begun_beside_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arming, "_BRING_IN_TIMEOUT_S", 0.05)
    answers, begun = threading.Event(), []

    def bring_in(self: BlackBox, store: RunStore) -> None:
        begun.append(store)
        answers.wait(60)

    monkeypatch.setattr(BlackBox, "bring_in", bring_in)
    once = BringIn(BlackBox(None), RunStore(tmp_path, "unit-1"))
    for _ in range(2):
        with pytest.raises(HangsError, match="bringing a run in hangs"):
            once.in_time(beat=lambda: None)
    assert len(begun) == 1
    answers.set()
    monkeypatch.setattr(arming, "_BRING_IN_TIMEOUT_S", 60.0)
    once.in_time(beat=lambda: None)
    once.in_time(beat=lambda: None)
    assert len(begun) >= 2  # what was left meanwhile is looked for too
