import queue
import shutil
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
from recorder_bench import Bench, MakeBench, wait_until

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import StorageError
from bricktrack_common.run_folder import read_run
from bricktrack_common.wire_messages import Disarmed, Refusal, Reply
from bricktrack_device.boot import kernel_boot_id
from bricktrack_device.capture.black_box import BlackBox
from bricktrack_device.capture.commands import DisarmCommand, Inbox, OtherWork, put_unless_many
from bricktrack_device.capture.session import Session
from bricktrack_device.capture.standing_order import ArmOrder, StandingOrder
from bricktrack_device.config import StorageTable
from bricktrack_device.storage.recovery import recover_runs
from bricktrack_device.storage.run_store import RunStore

NAME = ".armed-unit-1.json"
RUN = "unit-1_000000_0001"
HOUR_NS = 3600 * 10**9


def armed_in(bench: MakeBench, folder: Path, box: Path) -> Bench:
    return bench(storage=StorageTable(folder=str(folder), margin_mb=1, black_box=str(box)))


def order_in(folder: Path | None, *, boot_id: str = "this boot", runs: Sequence[str] = ()) -> StandingOrder:
    return StandingOrder(folder, "unit-1", max_age_s=3600.0, has_run=lambda r: r in runs, boot_id=boot_id)


def runs_of(bench: Bench) -> list[str]:
    return [p.name for p in bench.store.runs.iterdir()]


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
    order_in(box, boot_id=kernel_boot_id()).note(ArmOrder(label="old", duration_s=None), RUN)
    monkeypatch.setattr("bricktrack_device.capture.run_cycle._RETRY_S", 0.05)
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


def test_an_order_is_taken_up_once_and_a_damaged_one_not_at_all(tmp_path: Path) -> None:
    order = ArmOrder(label="a", duration_s=None)
    order_in(tmp_path).note(order, RUN)
    left = order_in(tmp_path)
    assert left.stands and left.take_up() == ""
    assert left.left == order and "killed while it was armed, 0 s after the command" in left.why
    assert not (tmp_path / NAME).exists() and not left.stands
    for damaged in (
        b"{",
        b'{"label": "a", "duration_s": null}\n',
    ):  # the second one is of an older bricktrackd
        (tmp_path / NAME).write_bytes(damaged)
        assert not left.stands and "not armed again" in left.take_up()
        assert left.left is None and not (tmp_path / NAME).exists()


def test_an_order_has_an_age_which_arming_again_does_not_renew(tmp_path: Path) -> None:
    for age_ns, is_old in ((HOUR_NS - 10**9, False), (HOUR_NS + 10**9, True)):
        order = ArmOrder(label="impact", duration_s=None, t_ns=monotonic_ns() - age_ns)
        order_in(tmp_path).note(order, RUN)
        again = order_in(tmp_path)
        assert again.stands is not is_old
        words = again.take_up()
        if is_old:
            assert again.left is None and "for 'impact', and is not armed again" in words
            assert "the command came 1.0 h ago, and recording.arm_again_within_s is 3600" in words
        else:
            assert again.left == order and words == "" and "1.0 h after the command" in again.why


def test_an_order_of_another_boot_or_with_a_run_is_not_armed_for(tmp_path: Path) -> None:
    for left, words in (
        (order_in(tmp_path, boot_id="the next"), "the unit was switched off since"),
        (order_in(tmp_path, runs=[RUN]), f"its wave had begun; what there is of it is run {RUN}"),
    ):
        order_in(tmp_path).note(ArmOrder(label="", duration_s=None), RUN)
        assert not left.stands and words in left.take_up()
        assert left.left is None and left.why == "" and not (tmp_path / NAME).exists()


def test_nothing_is_kept_where_there_is_no_memory_for_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    nowhere = order_in(None)
    nowhere.note(ArmOrder(label="", duration_s=1.0), RUN)
    nowhere.forget()
    assert nowhere.take_up() == "" and nowhere.left is None
    (tmp_path / "file").write_text("")
    barred = order_in(tmp_path / "file")
    barred.note(ArmOrder(label="", duration_s=1.0), RUN)
    assert barred.take_up() == "" and barred.left is None
    assert "will not arm again" in caplog.text


@pytest.mark.parametrize(
    ("killed_before", "is_first_kept"),
    [
        ((Session, "note_trigger"), False),  # nothing of the run has left the daemon's memory
        ((BlackBox, "begin"), False),
        ((BlackBox, "take_if_due"), False),  # the copy's folder is empty
        ((StandingOrder, "forget"), True),
    ],
)
def test_a_daemon_killed_at_the_first_edge_keeps_its_run_or_arms_again_for_it(
    bench: MakeBench,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    killed_before: tuple[type, str],
    is_first_kept: bool,
) -> None:
    box, left = tmp_path / "box", tmp_path / "left"
    killed = armed_in(bench, tmp_path, box)
    first = killed.arm("impact", 0.4).run_id
    kind, name = killed_before
    go_on = getattr(kind, name)

    def leave(*args: object, **more: object) -> object:
        if not left.exists():
            shutil.copytree(box, left)  # what is in memory when a process is killed here
        return go_on(*args, **more)

    monkeypatch.setattr(kind, name, leave)
    killed.rig.pulse(3)
    killed.wait_for_run()
    monkeypatch.undo()

    b = armed_in(bench, tmp_path / "card", left)
    if is_first_kept:
        wait_until(lambda: f"what there is of it is run {first}" in b.recorder.status().last_error)
        assert recover_runs(b.store, left) == [first]
        run = read_run(b.store.runs / first, verify_hashes=True)
        assert run.manifest.trigger.t0_ns is not None and run.manifest.state == "interrupted"
        time.sleep(0.5)  # some looks of an idle recorder
        assert b.recorder.state == "idle" and runs_of(b) == [first]
    else:
        b.wait_for("armed")
        again = b.recorder.status()
        assert again.run_id.endswith("_impact") and "killed while it was armed" in again.reason
        assert runs_of(b) == []
        b.n_runs_before = 0
        b.rig.pulse(3)
        b.wait_for_run()
        assert runs_of(b) == [again.run_id]


def test_a_bug_at_the_first_edge_leaves_no_order_and_costs_no_copy(
    bench: MakeBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = tmp_path / "box"
    b = armed_in(bench, tmp_path, box)
    armed = b.arm("impact", 30.0)

    def break_down(self: Session) -> None:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(Session, "note_trigger", break_down)
    b.rig.pulse(3)
    wait_until(lambda: (box / armed.run_id / "frames.msgpack").exists())
    wait_until(lambda: not (box / NAME).exists())
    assert b.recorder.state == "recording"


def test_other_work_never_makes_a_long_queue_before_an_arming() -> None:
    inbox: Inbox = queue.SimpleQueue()
    answers: list[Reply] = []
    for _ in range(30):
        put_unless_many(inbox, OtherWork("taking a picture", lambda: None, answers.append))
    assert len(answers) == 14 and all(isinstance(a, Refusal) and a.code == "busy" for a in answers)
    inbox.put(DisarmCommand(answers.append))
    assert inbox.qsize() == 17
