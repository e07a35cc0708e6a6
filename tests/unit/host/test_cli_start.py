"""The command line starts without what only computing needs, and keeps OpenBLAS to one thread."""

import os
import subprocess
import sys

import pytest

HEAVY = ("av", "cv2", "jinja2", "matplotlib", "pyarrow", "scipy")


def run_python(code, **environment):
    inherited = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=inherited | environment
    )
    return done.stdout.strip()


@pytest.mark.parametrize("arguments", [["--help"], ["process", "--help"], ["calibrate", "fit", "--help"]])
def test_help_loads_nothing_that_computes(arguments):
    code = (
        "import sys\nfrom bricktrack_host.cli import app\n"
        f"try:\n    app({arguments!r})\nexcept SystemExit:\n    pass\n"
        f"print([m for m in {HEAVY!r} if m in sys.modules])"
    )
    assert run_python(code).splitlines()[-1] == "[]"


LOADING = """
import sys
class CtrlC:
    def find_spec(self, name, path=None, target=None):
        if name == "typer":
            raise KeyboardInterrupt
sys.meta_path.insert(0, CtrlC())
import bricktrack_host.cli
"""
READING_COMMANDS = """
import typer.main
from bricktrack_host.cli import main
def ctrl_c(app):
    raise KeyboardInterrupt
typer.main.get_command = ctrl_c
main()
"""


@pytest.mark.parametrize("code", [LOADING, READING_COMMANDS])
def test_ctrl_c_before_a_command_begins_ends_without_a_traceback(code):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "")


def test_openblas_has_one_thread_unless_the_caller_says_otherwise():
    code = "import bricktrack_host.cli, os; print(os.environ['OPENBLAS_NUM_THREADS'])"
    assert run_python(code) == "1"
    assert run_python(code, OPENBLAS_NUM_THREADS="3") == "3"


def test_openblas_is_told_before_numpy_is_loaded():
    code = """
import os, sys
class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "numpy":
            print(os.environ.get("OPENBLAS_NUM_THREADS"))
sys.meta_path.insert(0, Watch())
import bricktrack_host.cli
assert "numpy" in sys.modules
"""
    assert run_python(code) == "1"
