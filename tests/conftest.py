"""For all tests: small matrices are not spread over threads, which slows them many times on a busy machine."""

import os
import signal

import pytest

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
