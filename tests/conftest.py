"""For all tests: small matrices are not spread over threads, which slows them many times on a busy machine."""

import os
import signal
from pathlib import Path

import pytest

# Simulated cameras, samplers and units run in real time there: one after the other, or they disturb each other.
_IN_REAL_TIME = ("contract", "end_to_end", "unit/device", "virtual_pi")
_AT_LEISURE = (  # of these, what only computes
    "test_docs_commands.py",
    "test_moving_camera.py",
    "test_notebook.py",
    "test_pages_in_a_browser.py",
    "test_process.py",
    "test_shared_sample.py",
    "test_tutorial.py",
)

# A shell's background job ignores Ctrl-C, and hands that on to the programs that tests interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # NumPy reads it once, when it is loaded


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--rig",
        metavar="ADDRESS",
        help="also run the tests marked 'hardware': on the hardware of this computer, given its bricktrackd.toml "
        "(service stopped), or on a running unit elsewhere, given tcp://HOST:PORT",
    )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give all tests in real time to one worker of pytest-xdist, and of the others a file as a whole to any."""
    tests = Path(__file__).parent
    real_time = [tests / folder for folder in _IN_REAL_TIME]
    for item in items:
        keeps_time = item.path.name not in _AT_LEISURE and any(map(item.path.is_relative_to, real_time))
        item.add_marker(pytest.mark.xdist_group("real time" if keeps_time else str(item.path)))
