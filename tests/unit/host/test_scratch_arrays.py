import faulthandler
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import copy_context
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from bricktrack_common.arrays import FloatArray
from bricktrack_host import scratch_arrays
from bricktrack_host.scratch_arrays import large_arrays_on_disk

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="arrays lie on the disk on Linux only")

_LARGE = 1 << 17  # numbers: a megabyte
_IN_FILE, _IN_MEMORY = "file", "memory"


def _place(array: FloatArray) -> str:
    """Return where an array lies, by what the kernel says is mapped there."""
    address = array.ctypes.data
    for line in Path("/proc/self/maps").read_text(encoding="ascii").splitlines():
        begin, end = (int(x, 16) for x in line.split(maxsplit=1)[0].split("-"))
        if begin <= address < end:
            return _IN_FILE if "(deleted)" in line or "#" in line else _IN_MEMORY
    raise AssertionError("nothing is mapped there")


@contextmanager
def _fresh(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Use a file that no test before has used."""
    monkeypatch.setattr(scratch_arrays, "_OF_DISK", {})
    with large_arrays_on_disk(folder):
        yield


class TestPlaces:
    def test_large_arrays_lie_in_a_file_without_a_name_and_small_ones_in_memory(self, tmp_path: Path) -> None:
        with large_arrays_on_disk(tmp_path):
            places = [_place(make(_LARGE)) for make in (np.empty, np.zeros, np.ones)]
            small = _place(np.empty(10))
        assert places == [_IN_FILE] * 3
        assert small == _IN_MEMORY
        assert list(tmp_path.iterdir()) == []

    def test_after_the_block_arrays_lie_in_memory_again_and_those_of_before_stay(
        self, tmp_path: Path
    ) -> None:
        with large_arrays_on_disk(tmp_path):
            kept = np.arange(float(_LARGE))
        assert _place(np.empty(_LARGE)) == _IN_MEMORY
        assert _place(kept) == _IN_FILE
        assert kept.sum() == _LARGE * (_LARGE - 1) / 2

    def test_after_an_error_too(self, tmp_path: Path) -> None:
        with pytest.raises(KeyboardInterrupt), large_arrays_on_disk(tmp_path):
            raise KeyboardInterrupt
        assert _place(np.empty(_LARGE)) == _IN_MEMORY
        assert "scratch" not in [thread.name for thread in threading.enumerate()]

    def test_of_this_thread_and_those_that_it_gives_its_context(self, tmp_path: Path) -> None:
        found: list[str] = []

        def look() -> None:
            found.append(_place(np.empty(_LARGE)))

        with large_arrays_on_disk(tmp_path):
            context = copy_context()
            for target in (look, lambda: context.run(look)):
                thread = threading.Thread(target=target)
                thread.start()
                thread.join()
        assert found == [_IN_MEMORY, _IN_FILE]


class TestContents:
    def test_zeros_are_zeros_in_blocks_that_were_used_before(self, tmp_path: Path) -> None:
        with large_arrays_on_disk(tmp_path):
            first = np.full(_LARGE, 7.0)
            at = first.ctypes.data
            del first
            again = np.zeros(_LARGE)
        assert again.ctypes.data == at
        assert not again.any()

    def test_no_two_arrays_overlap_whatever_comes_and_goes(self, tmp_path: Path) -> None:
        rng = np.random.default_rng(3)
        with large_arrays_on_disk(tmp_path):
            held: dict[int, FloatArray] = {}
            for i in range(600):
                held[i] = np.full(int(rng.integers(1 << 14, 1 << 18)), float(i))
                if len(held) > 25:
                    gone = int(rng.choice(list(held)))
                    assert (held.pop(gone) == gone).all()
            assert all((array == i).all() for i, array in held.items())
            spans = sorted((a.ctypes.data, a.ctypes.data + a.nbytes) for a in held.values())
        assert all(end <= begin for (_, end), (begin, _) in pairwise(spans))

    @pytest.mark.parametrize("n", [10, _LARGE // 2, 4 * _LARGE])
    def test_an_array_made_longer_or_shorter_keeps_what_it_holds(self, tmp_path: Path, n: int) -> None:
        with large_arrays_on_disk(tmp_path):
            array = np.arange(float(_LARGE))
            array.resize(n, refcheck=False)
        both = min(n, _LARGE)
        np.testing.assert_array_equal(array[:both], np.arange(float(both)))
        assert not array[both:].any()

    def test_what_is_given_back_to_the_system_stays_with_the_file(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(scratch_arrays, "_RESIDENT_BYTES", 4 << 20)
        with _fresh(tmp_path, monkeypatch):
            start = _resident_bytes()
            arrays = [np.full(_LARGE, float(i)) for i in range(100)]
            before = _resident_bytes()
            total = sum(float(array.sum()) for array in arrays)
            after = _resident_bytes()
        assert total == _LARGE * 99 * 100 / 2
        assert max(before, after) - start < 60 << 20  # of the hundred megabytes

    def test_arrays_may_be_left_when_the_process_ends(self, tmp_path: Path) -> None:
        program = (
            "import sys, numpy as np; from pathlib import Path\n"
            "from bricktrack_host.scratch_arrays import large_arrays_on_disk\n"
            "with large_arrays_on_disk(Path(sys.argv[1])): kept = [np.ones(1 << 18) for _ in range(9)]\n"
            "sys.left = kept; np.left = kept[1:]; print(sum(map(np.sum, kept)))"
        )
        done = subprocess.run(
            [sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=False
        )
        assert (done.returncode, done.stdout.strip()) == (0, str(9.0 * (1 << 18))), done.stderr


class TestNoPlace:
    def test_on_a_full_disk_large_arrays_lie_in_memory(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(scratch_arrays, "_MOST_BYTES", 3 << 20)
        with _fresh(tmp_path, monkeypatch):
            places = [_place(array) for array in [np.zeros(_LARGE) for _ in range(5)]]
        assert places == [_IN_FILE] * 3 + [_IN_MEMORY] * 2

    def test_where_no_file_can_be_made_processing_goes_on_in_memory(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        with caplog.at_level(logging.INFO), _fresh(tmp_path / "missing", monkeypatch):
            place = _place(np.empty(_LARGE))
        assert place == _IN_MEMORY
        assert "large arrays lie in memory" in caplog.text

    def test_a_forked_process_has_no_part_in_it(self, tmp_path: Path) -> None:
        with large_arrays_on_disk(tmp_path):
            shared = np.ones(_LARGE)
        child = os.fork()
        if child == 0:
            faulthandler.disable()
            shared[0] = 2.0
            os._exit(0)
        _, status = os.waitpid(child, 0)
        assert os.WIFSIGNALED(status)
        assert shared[0] == 1.0


def _resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")
