"""Runs side by side: each outcome told, failures apart, nothing half-written when stopped."""

import os
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest
from run_works import half_written, together, work

from bricktrack_host import many_runs
from bricktrack_host.many_runs import default_workers, process_side_by_side


class Heard:
    def __init__(self):
        self.stages = []
        self.done = []

    def stage(self, name, total):
        self.stages.append((name, total))

    def advance_to(self, done):
        self.done.append(done)


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
    assert all(h.stages == [("decode", 200)] for h in heard.values())
    assert heard[4].done[-1] == 200
    assert len(heard[4].done) == 100


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


@pytest.mark.parametrize(
    ("n_runs", "processors", "memory_mb", "expected"),
    [
        (20, 8, 64_000, 8),
        (3, 8, 64_000, 3),
        (20, 8, 4_000, 4),
        (20, 8, 100, 1),
        (20, 8, None, 8),
        (0, 8, None, 1),
    ],
)
def test_processors_and_memory_bound_how_many_run_at_once(
    monkeypatch, n_runs, processors, memory_mb, expected
):
    monkeypatch.setattr(many_runs.os, "cpu_count", lambda: processors)
    monkeypatch.setattr(many_runs, "available_memory_mb", lambda: memory_mb)
    assert default_workers(n_runs) == expected


def test_available_memory_is_that_of_the_system():
    if not Path("/proc/meminfo").exists():
        pytest.skip("no /proc/meminfo on this system")
    total_mb = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**20
    assert 0 < many_runs.available_memory_mb() <= total_mb * 1.01
