import queue
import shutil
import threading
import time
from pathlib import Path

import pytest
from recorder_bench import Bench, MakeBench, wait_until

from bricktrack_common.errors import StorageError
from bricktrack_common.run_folder import read_run
from bricktrack_common.wire_messages import Disarmed, Refusal, Reply
from bricktrack_device.capture.commands import DisarmCommand, Inbox, OtherWork, put_unless_many
from bricktrack_device.capture.standing_order import ArmOrder, StandingOrder
from bricktrack_device.config import StorageTable
from bricktrack_device.storage.run_store import RunStore

NAME = ".armed-unit-1.json"


def armed_in(bench: MakeBench, folder: Path, box: Path) -> Bench:
    return bench(storage=StorageTable(folder=str(folder), margin_mb=1, black_box=str(box)))


def refuse(*args: object) -> str:
    raise StorageError("card")


def test_a_daemon_that_was_killed_while_armed_arms_again_for_the_same_run_and_says_so(
    bench: MakeBench, tmp_path: Path
) -> None:
    killed = armed_in(bench, tmp_path, tmp_path / "box")
    first = killed.arm("impact", 0.4)
    (tmp_path / "left").mkdir()
    shutil.copy(tmp_path / "box" / NAME, tmp_path / "left")

    b = armed_in(bench, tmp_path / "card", tmp_path / "left")
    b.n_runs_before = 0
    b.wait_for("armed")
    status = b.recorder.status()
    assert status.run_id.endswith("_impact") and "killed while it was armed" in status.reason
    wait_until(lambda: (tmp_path / "left" / NAME).exists())  # it may be killed again
    b.rig.pulse(3)
    b.wait_for_run()
    run = read_run(b.store.runs / status.run_id, verify_hashes=True)
    assert run.manifest.trigger.t0_ns is not None and run.manifest.window_ns is not None
    assert run.manifest.window_ns[1] - run.manifest.trigger.t0_ns == 500_000_000  # 0.4 s and 0.1 s after it
    assert any("killed while it was armed" in words for words in run.manifest.missing)
    assert not (tmp_path / "left" / NAME).exists() and b.recorder.state == "idle"
    assert killed.recorder.status().run_id == first.run_id


def test_what_is_disarmed_or_ended_on_purpose_is_not_armed_again(bench: MakeBench, tmp_path: Path) -> None:
    box = tmp_path / "box"
    b = armed_in(bench, tmp_path, box)
    b.arm()
    assert (box / NAME).exists()
    assert isinstance(b.ask("disarm"), Disarmed) and not (box / NAME).exists()
    b.arm()
    b.recorder.stop()
    assert not (box / NAME).exists()


def test_what_a_killed_daemon_left_is_not_armed_for_after_a_newer_order_was_refused(
    bench: MakeBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = tmp_path / "box"
    StandingOrder(box, "unit-1").note(ArmOrder(label="old", duration_s=None))
    monkeypatch.setattr("bricktrack_device.capture.recorder._RETRY_S", 0.05)
    monkeypatch.setattr(RunStore, "new_run_id", refuse)
    b = armed_in(bench, tmp_path, box)
    wait_until(lambda: "cannot arm itself: card" in b.recorder.status().last_error)
    assert isinstance(b.ask("arm", "new", None), Refusal)
    monkeypatch.undo()
    tried = threading.Event()
    b.recorder.do_when_idle("looking", tried.set, lambda reply: None)
    assert tried.wait(60)
    time.sleep(0.6)  # some times as long as until it would try again
    assert b.recorder.state == "idle" and b.recorder.status().run_id == ""


def test_an_order_is_taken_up_once_and_a_damaged_one_not_at_all(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    order = ArmOrder(label="a", duration_s=None)
    StandingOrder(tmp_path, "unit-1").note(order)
    left = StandingOrder(tmp_path, "unit-1")
    left.take_up()
    assert left.left == order and not (tmp_path / NAME).exists()
    (tmp_path / NAME).write_bytes(b"{")
    left.take_up()
    assert left.left is None and "not armed again" in caplog.text and not (tmp_path / NAME).exists()


def test_nothing_is_kept_where_there_is_no_memory_for_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    nowhere = StandingOrder(None, "unit-1")
    nowhere.note(ArmOrder(label="", duration_s=1.0))
    nowhere.forget()
    nowhere.take_up()
    assert nowhere.left is None
    (tmp_path / "file").write_text("")
    barred = StandingOrder(tmp_path / "file", "unit-1")
    barred.note(ArmOrder(label="", duration_s=1.0))
    barred.take_up()
    assert "will not arm again" in caplog.text


def test_other_work_never_makes_a_long_queue_before_an_arming() -> None:
    inbox: Inbox = queue.SimpleQueue()
    answers: list[Reply] = []
    for _ in range(30):
        put_unless_many(inbox, OtherWork("taking a picture", lambda: None, answers.append))
    assert len(answers) == 14 and all(isinstance(a, Refusal) and a.code == "busy" for a in answers)
    inbox.put(DisarmCommand(answers.append))
    assert inbox.qsize() == 17
