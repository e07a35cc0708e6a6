"""For all tests: what keeps them quick, and the same, on a busy machine."""

import os
import signal

import pytest
from hypothesis import HealthCheck, settings

# A shell's background job ignores Ctrl-C, and hands that on to the programs that tests interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Small matrices spread over threads are many times slower there. NumPy reads it once, when it is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# How long an example takes is the machine's business: on a busy one a file's first reading takes half a second.
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--rig",
        metavar="ADDRESS",
        help="also run the tests marked 'hardware': on the hardware of this computer, given its bricktrackd.toml "
        "(service stopped), or on a running unit elsewhere, given tcp://HOST:PORT",
    )
