"""Works given to processes of this machine: each outcome told, failures apart, nothing half-written when stopped."""

import os
import subprocess
import sys
import threading
import time
from concurrent.futures import Future
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest
import run_works
from heard_progress import Heard
from run_works import dies_once, half_written, together, work

from bricktrack_common.errors import ConfigError
from bricktrack_host.many_runs import memory
from bricktrack_host.many_runs.local_processes import LocalProcesses
from bricktrack_host.many_runs.memory import container_memory_mb, default_workers
from bricktrack_host.many_runs.workers import Attempt, Instead, WorkerLostError, do_all


def as_it_came(index, value):
    return value


def process_side_by_side(works, *, workers=2, progress, finish=as_it_came):
    return do_all(len(works), lambda i: works[i], LocalProcesses(workers), progress=progress, finish=finish)


def run_all(works, workers=2):
    heard = {}

    def begin(i):
        heard[i] = Heard()
        return heard[i]

    outcomes = {o.index: o for o in process_side_by_side(works, workers=workers, progress=begin)}
    return outcomes, heard


def test_each_run_gives_its_value_or_its_own_failure():
    outcomes, heard = run_all([partial(work, kind) for kind in ("a", "lost", "bug", "killed", "b")])
    assert sorted(outcomes) == [0, 1, 2, 3, 4]
    assert (outcomes[0].value, outcomes[4].value) == ("aa", "bb")
    assert outcomes[1].failure == "none of 5 frames gave a pose"
    assert not outcomes[1].is_bug
    assert outcomes[2].is_bug
    assert "ZeroDivisionError: of mine" in outcomes[2].failure
    assert "signal 9" in outcomes[3].failure
    assert "--jobs" in outcomes[3].failure
    assert "given up after 3 attempts" in outcomes[3].failure
    assert all(h.stages == [("decode", 200)] for h in heard.values())
    assert heard[4].done[-1] == 200
    assert len(heard[4].done) == 100


class OneFate:
    """Workers of which two share a machine: it dies with both, whichever of them was deadly."""

    attempts = 3

    def __init__(self):
        self._begun = []

    def room(self):
        return 2

    def submit(self, what, progress):
        future = Future()
        self._begun.append((future, what))
        if len(self._begun) == 1:
            threading.Timer(0.05, self._end).start()
        return future

    def _end(self):
        ended, self._begun = self._begun, []
        dies = any(what == "deadly" for _, what in ended)
        for future, what in ended:
            if dies:
                future.set_exception(WorkerLostError("its machine died"))
            else:
                future.set_result(Attempt(what))

    def stop(self):
        pass


def test_a_run_that_met_deadly_ones_each_time_gets_its_last_try_alone():
    works = ["deadly", "a", "deadly", "b", "c"]
    outcomes = do_all(len(works), works.__getitem__, OneFate(), progress=lambda i: Heard(), finish=as_it_came)
    came = {o.index: o for o in outcomes}
    assert sorted(came) == [0, 1, 2, 3, 4]
    assert [came[i].value for i in (1, 3, 4)] == ["a", "b", "c"]
    assert all("given up after 3 attempts" in came[i].failure for i in (0, 2))


def test_two_runs_are_at_work_at_once_in_processes_of_their_own(tmp_path):
    outcomes, _ = run_all([partial(together, tmp_path, i) for i in range(2)])
    assert len({outcomes[0].value, outcomes[1].value, os.getpid()}) == 3


def test_no_more_runs_than_asked_for_are_at_work():
    begun, ended = [], []
    for outcome in process_side_by_side(
        [partial(work, "a")] * 3, workers=1, progress=lambda i: begun.append(i) or Heard()
    ):
        ended.append(outcome.index)
        assert len(begun) == len(ended)
    assert ended == [0, 1, 2]


def test_stopping_lets_each_run_take_back_what_it_has_half_written(tmp_path):
    class Stop(Heard):
        def stage(self, name, total):
            assert (tmp_path / "part").exists()
            raise KeyboardInterrupt

    outcomes = process_side_by_side([partial(half_written, tmp_path)], workers=1, progress=lambda i: Stop())
    with pytest.raises(KeyboardInterrupt), closing(outcomes):
        list(outcomes)
    assert not (tmp_path / "part").exists()


def test_a_work_whose_process_was_killed_is_done_again(tmp_path):
    outcomes, _ = run_all([partial(dies_once, tmp_path / "been"), partial(work, "b")])
    assert outcomes[0].value == "done at last"
    assert outcomes[1].value == "bb"


def test_what_cannot_be_read_or_written_here_fails_alone():
    def work_of(i):
        if i == 0:
            raise ConfigError("no such layout")
        return partial(work, "ab"[i - 1])

    def finish(i, value):
        if i == 1:
            raise ConfigError("no room")
        return value

    outcomes = {
        o.index: o for o in do_all(3, work_of, LocalProcesses(1), progress=lambda i: Heard(), finish=finish)
    }
    assert [outcomes[i].failure for i in range(3)] == ["no such layout", "no room", ""]
    assert outcomes[2].value == "bb"


def test_another_work_can_be_done_instead():
    def finish(i, value):
        return Instead(partial(work, "x")) if value == "aa" else value

    outcomes = process_side_by_side([partial(work, "a")], progress=lambda i: Heard(), finish=finish)
    assert [o.value for o in outcomes] == ["xx"]


def test_a_process_ends_when_the_one_that_started_it_is_killed(tmp_path):
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from functools import partial\nfrom pathlib import Path\nimport run_works\n"
        "from bricktrack_host.many_runs.local_processes import LocalProcesses\n"
        "class Quiet:\n    stage = advance_to = lambda *a: None\n"
        "if __name__ == '__main__':\n"
        "    LocalProcesses(1).submit(partial(run_works.stays, Path(sys.argv[2])), Quiet()).result()\n"
    )
    script = tmp_path / "parent.py"
    script.write_text(code)
    note = tmp_path / "pid"
    parent = subprocess.Popen([sys.executable, script, Path(run_works.__file__).parent, note])
    deadline = time.monotonic() + 30
    while not note.exists() or not note.read_text():
        assert time.monotonic() < deadline and parent.poll() is None
        time.sleep(0.02)
    pid = int(note.read_text())
    parent.kill()
    parent.wait()
    while Path(f"/proc/{pid}").exists() and "zombie" not in Path(f"/proc/{pid}/status").read_text():
        assert time.monotonic() < deadline, "it is still there"
        time.sleep(0.02)


@pytest.mark.parametrize(
    ("recorded_s", "processors", "memory_mb", "expected"),
    [
        ([45] * 20, 8, 64_000, 8),
        ([45] * 3, 8, 64_000, 3),
        ([45] * 20, 8, 4_000, 6),  # 3200 MB hold six of 489 MB
        ([16] * 20, 8, 4_000, 6),  # ... six of 483 MB
        ([600] * 20, 8, 4_000, 5),  # ... five of 600 MB
        ([16] * 18 + [1600, 1600], 8, 4_000, 5),  # ... the two long ones of 800 MB may meet, and three more
        ([16] * 20, 8, 100, 1),
        ([16] * 20, 8, None, 8),
        ([], 8, None, 1),
    ],
)
def test_processors_and_the_memory_for_the_longest_bound_how_many_run_at_once(
    monkeypatch, recorded_s, processors, memory_mb, expected
):
    monkeypatch.setattr(memory, "_RUN_MEMORY_MB_PER_S", 0.2)
    monkeypatch.setattr(memory, "usable_processors", lambda: processors)
    monkeypatch.setattr(memory, "available_memory_mb", lambda: memory_mb)
    assert default_workers(recorded_s) == expected


@pytest.mark.parametrize(("recorded_s", "measured_mb"), [(16, 333), (180, 409), (600, 441)])
@pytest.mark.skipif(sys.platform != "linux", reason="large arrays lie in memory elsewhere")
def test_a_run_is_given_more_than_was_measured(recorded_s, measured_mb):
    assert measured_mb < memory.run_memory_mb(recorded_s) < 1.5 * measured_mb


def test_available_memory_is_that_of_the_system():
    if not Path("/proc/meminfo").exists():
        pytest.skip("no /proc/meminfo on this system")
    total_mb = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**20
    assert 0 < memory.available_memory_mb() <= total_mb * 1.01


def test_a_container_has_what_its_limit_leaves_and_files_that_can_go(tmp_path):
    assert container_memory_mb(tmp_path) is None
    (tmp_path / "memory.current").write_text(f"{300 * 2**20}\n")
    (tmp_path / "memory.stat").write_text(f"anon 5\ninactive_file {100 * 2**20}\n")
    (tmp_path / "memory.max").write_text("max\n")
    assert container_memory_mb(tmp_path) is None
    (tmp_path / "memory.max").write_text(f"{1000 * 2**20}\n")
    assert container_memory_mb(tmp_path) == 800
