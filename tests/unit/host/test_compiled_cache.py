import os
import subprocess
import sys

KERNELS = """
import numpy as np
from bricktrack_host.compiled import compiled, compiled_in_place

@compiled_in_place
def twice(values, at):
    return 2.0 * values[at]

@compiled
def doubled(values):
    out = np.empty(len(values))
    for i in range(len(values)):
        out[i] = twice(values, i)
    return out

@compiled
def doubled_sum(values):
    total = 0.0
    for i in range(len(values)):
        total += twice(values, i)
    return total

values = np.arange(5.0)
def how(function):
    return sum(function.stats.cache_hits.values()), sum(function.stats.cache_misses.values())
"""


OTHER_NUMBA = "import numba; numba.__version__ = '0.99.0'"


def told(tmp_path, *lines, before=""):
    """Return what lines after `KERNELS` print, in a process of their own; ``before``: a line before them."""
    (tmp_path / "kernels.py").write_text(KERNELS)
    environment = {
        **os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": os.pathsep.join(sys.path)
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", "\n".join([before, "from kernels import *", *lines])], cwd=tmp_path,
        env=environment, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.split("\n")[:-1]


def test_what_was_loaded_is_taken_into_what_is_compiled_after_it(tmp_path):
    assert told(tmp_path, "print(twice(values, 3), doubled(values)[4])") == ["6.0 8.0"]
    lines = told(
        tmp_path, "print(twice(values, 2), doubled(values)[1])", "print(how(twice), how(doubled))",
        "print(doubled_sum(values), how(doubled_sum))",
    )  # fmt: skip
    assert lines == ["4.0 2.0", "(1, 0) (1, 0)", "20.0 (0, 1)"]


def test_loading_does_not_get_ready_to_compile(tmp_path):
    told(tmp_path, "doubled(values)")
    lines = ["print(doubled(values)[3], 'numba.np.linalg' in sys.modules)", "import sys"]
    assert told(tmp_path, *reversed(lines)) == ["6.0 False"]
    assert told(tmp_path, "import sys", "doubled_sum(values)", "print('numba.np.linalg' in sys.modules)") == [
        "True"
    ]


def test_another_type_is_compiled_where_one_was_loaded(tmp_path):
    told(tmp_path, "doubled(values)")
    assert told(tmp_path, "print(doubled(values)[1], doubled(np.arange(3))[2], how(doubled))") == [
        "2.0 4.0 (1, 1)"
    ]


def test_a_version_of_numba_that_is_not_known_uses_its_own_cache_beside_ours(tmp_path):
    lines = ["print(doubled(values)[4], how(doubled), type(doubled._cache).__name__)"]
    lines += ["print('bricktrack_host.compiled_cache' in sys.modules)"]
    for before, name, quick in [("import sys", "QuickCache", True), (OTHER_NUMBA, "FunctionCache", False)]:
        for how in ("(0, 1)", "(1, 0)"):  # compiled, then loaded: neither reads what the other keeps
            expected = [f"8.0 {how} {name}", str(quick)]
            assert told(tmp_path, "import sys", *lines, before=before) == expected
