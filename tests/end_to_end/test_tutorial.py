"""The tutorials are run as a reader would run them: every command of a page, in order, in an empty folder."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TUTORIALS = ROOT / "docs" / "tutorials"


def commands_of(page: str) -> list[str]:
    """Return the commands of the page's console blocks: lines behind ``$ ``, continued by a backslash."""
    commands = []
    for block in re.findall(r"```console\n(.*?)```", page, flags=re.S):
        commands += re.findall(r"^\$ ((?:.*\\\n)*.*)$", block, flags=re.M)
    return commands


def run_page(name: str, folder: Path) -> list[str]:
    """Run a tutorial's commands in a folder that sees the repository's tests; return what each printed."""
    (folder / "tests").symlink_to(ROOT / "tests")
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "COLUMNS": "140",
        "NO_COLOR": "1",
    }
    outputs = []
    for command in commands_of((TUTORIALS / name).read_text()):
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", command],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0, f"$ {command}\n{done.stdout}\n{done.stderr}"
        outputs.append(done.stdout + done.stderr)
    return outputs


@pytest.mark.slow
def test_every_command_of_the_first_recording_works(tmp_path):
    outputs = run_page("first-recording.md", tmp_path)
    assert len(outputs) >= 4
    # The last command prints the errors against truth, marked as simulated.
    assert "simulated" in outputs[-1].lower()
    assert re.search(r"\bx\b.*mm", outputs[-1])


@pytest.mark.slow
def test_the_calibration_holds_and_a_turned_lens_is_told(tmp_path):
    _, fitted, held, turned = run_page("calibrate-a-unit.md", tmp_path)
    assert "Calibration of unit sample" in fitted
    assert (tmp_path / "maps" / "coverage.png").exists()
    assert "The calibration holds." in held
    # The rig's own depth (rig.toml), found although the command line says 103 mm.
    assert "101.12 mm, not 103 mm" in " ".join(turned.split())
