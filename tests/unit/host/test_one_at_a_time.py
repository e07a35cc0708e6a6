"""A run that one process is at is refused to another, until the first one ends, however it ends."""

import subprocess
import sys

import pytest

from bricktrack_common.errors import ConfigError
from bricktrack_host.many_runs.one_at_a_time import alone_with

HOLD = """
import sys
from pathlib import Path
from bricktrack_host.many_runs.one_at_a_time import alone_with
with alone_with(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_another_process_is_refused_until_the_first_is_gone(tmp_path):
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, tmp_path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(ConfigError, match="is being processed by another command"), alone_with(tmp_path):
        pass
    holder.kill()
    holder.communicate()
    with alone_with(tmp_path):
        pass


def test_it_is_let_go_of_after_an_error(tmp_path):
    with pytest.raises(ZeroDivisionError), alone_with(tmp_path):
        raise ZeroDivisionError
    with alone_with(tmp_path):
        pass
