"""The tutorial is run as a reader would run it: every command of the page, in order, in an empty folder."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "tutorials" / "first-recording.md"


def commands_of(page: str) -> list[str]:
    """Return the commands of the page's console blocks: lines behind ``$ ``, continued by a backslash."""
    commands = []
    for block in re.findall(r"```console\n(.*?)```", page, flags=re.S):
        commands += re.findall(r"^\$ ((?:.*\\\n)*.*)$", block, flags=re.M)
    return commands


@pytest.mark.slow
def test_every_command_of_the_tutorial_works(tmp_path):
    (tmp_path / "tests").symlink_to(ROOT / "tests")
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "COLUMNS": "140",
        "NO_COLOR": "1",
    }
    commands = commands_of(PAGE.read_text())
    assert len(commands) >= 4
    output = ""
    for command in commands:
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", command],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0, f"$ {command}\n{done.stdout}\n{done.stderr}"
        output = done.stdout
    # The last command prints the errors against truth, marked as simulated.
    assert "simulated" in output.lower()
    assert re.search(r"\bx\b.*mm", output)
