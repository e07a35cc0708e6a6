import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

from bricktrack_host import compiled as module
from bricktrack_host.compiled import compiled, sources_behind

TRACKING = Path(module.__file__).parent / "tracking"


def names_behind(source):
    return {"/".join(path.parts[-2:]) for path in sources_behind(source)}


def test_code_is_kept_for_what_a_module_imports_however_indirectly():
    behind = names_behind(TRACKING / "pose" / "refine_kernel.py")
    assert "led_model/led_view.py" in behind
    assert "bricktrack_host/compiled.py" in behind
    assert "pictures/light_kernel.py" not in behind
    # A module taken from a package by name, and what that imports in its turn.
    assert "pictures/light_kernel.py" in names_behind(TRACKING / "pictures" / "segment.py")


@pytest.mark.parametrize("line", ["from bricktrack_host.tracking.pose import finite, p3p as k",
                                  "from bricktrack_host.tracking.pose import (\n    finite,\n    p3p as k,\n)"])  # fmt: skip
def test_all_names_of_an_import_are_followed(tmp_path, line):
    source = tmp_path / "a.py"
    source.write_text(f"{line}\n")
    behind = {path.name for path in sources_behind(source)}
    assert {"a.py", "finite.py", "p3p.py"} <= behind


def test_a_changed_source_is_compiled_in_a_folder_of_its_own(tmp_path, monkeypatch):
    folders = []
    for number in (1, 2):
        source = tmp_path / f"{number}" / "numbers_of.py"
        source.parent.mkdir()
        source.write_text(f"def number():\n    return {number}\n")
        monkeypatch.syspath_prepend(str(source.parent))
        monkeypatch.delitem(sys.modules, "numbers_of", raising=False)
        import numbers_of

        function = compiled(numbers_of.number)
        assert function() == number
        folders.append(module.numba.config.CACHE_DIR)
    assert folders[0] != folders[1]


COMPILE_AND_TELL = """
import counted
counted.total(counted.numbers)
print(sum(counted.total.stats.cache_misses.values()))
"""


def test_of_two_processes_one_compiles_and_the_other_loads(tmp_path):
    (tmp_path / "counted.py").write_text(
        "import numpy as np\nfrom bricktrack_host.compiled import compiled\nnumbers = np.arange(5.0)\n\n\n"
        "@compiled\ndef total(values):\n    return np.sort(values).sum()\n"
    )
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    both = [
        subprocess.Popen(
            [sys.executable, "-c", COMPILE_AND_TELL], cwd=tmp_path, env=environment, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
        )
        for _ in range(2)
    ]  # fmt: skip
    told = [process.communicate(timeout=120) for process in both]
    assert [process.returncode for process in both] == [0, 0], told
    assert sorted(int(out) for out, _ in told) == [0, 1]
    # Whoever compiles says so; the other may have begun before anything was kept.
    assert any("only once" in err for _, err in told)


def test_a_lock_that_is_never_given_back_holds_nobody_up(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(module, "PATIENCE_S", 0.3)
    path = tmp_path / "total.lock"
    with path.open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with module._lock_between_processes(path):
            pass
    assert "total.lock: another process holds it" in caplog.text
    caplog.clear()
    with module._lock_between_processes(path):
        pass
    assert not caplog.records
