"""The tutorials are run as a reader would run them: every command of a page, in order, in an empty folder."""

import csv
import math
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
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
    """Run a tutorial's commands in a folder, with the files that it shows; return what each printed."""
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "COLUMNS": "140",
        "NO_COLOR": "1",
    }
    page = (TUTORIALS / name).read_text()
    for file, text in re.findall(r"```(?:toml|python)\n# (\S+\.\w+)\n(.*?)```", page, flags=re.S):
        (folder / file).write_text(text)
    outputs = []
    for command in commands_of(page):
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", command],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=900,  # loops may have to be compiled, on a machine with other work
        )
        assert done.returncode == 0, f"$ {command}\n{done.stdout}\n{done.stderr}"
        outputs.append(done.stdout + done.stderr)
    return outputs


@pytest.mark.slow
def test_every_command_of_the_first_recording_works(tmp_path):
    (tmp_path / "tests").symlink_to(ROOT / "tests")
    outputs = run_page("first-recording.md", tmp_path)
    assert len(outputs) >= 4
    # The last command prints the errors against truth, marked as simulated.
    assert "simulated" in outputs[-1].lower()
    assert re.search(r"\bx\b.*mm", outputs[-1])


@pytest.mark.slow
def test_the_calibration_holds_and_a_turned_lens_is_told(tmp_path):
    (tmp_path / "tests").symlink_to(ROOT / "tests")
    _, fitted, held, turned = run_page("calibrate-a-unit.md", tmp_path)
    assert "Calibration of unit sample" in fitted
    assert (tmp_path / "maps" / "coverage.png").exists()
    assert "The calibration holds." in held
    # The rig's own depth (rig.toml), found although the command line says 103 mm.
    assert "101.12 mm, not 103 mm" in " ".join(turned.split())


@pytest.mark.slow
def test_a_test_day_with_a_simulated_unit_ends_in_a_report(tmp_path):
    try:
        outputs = run_page("test-day.md", tmp_path)
    except BaseException:
        if (tmp_path / "unit.pid").exists():
            os.kill(int((tmp_path / "unit.pid").read_text()), signal.SIGTERM)
        raise
    assert "1 of 1 units are ready" in outputs[5]
    tracked = re.search(r"(\d+) of (\d+) frames gave a pose", outputs[7])
    assert tracked is not None and int(tracked[1]) >= 0.95 * int(tracked[2]) > 0
    [report] = (tmp_path / "runs").glob("*/results/report.html")
    assert "Errors against the simulated truth" in report.read_text()
    assert (tmp_path / "stills" / "b7-1_leds.png").exists()
    assert (tmp_path / "tests" / "shake-12" / "combined" / "report.html").exists()


@pytest.mark.slow
def test_the_parts_of_a_brick_move_as_they_were_made_to(tmp_path):
    (tmp_path / "scripts").symlink_to(ROOT / "scripts")
    *_, combined, _, wrong, _, _, amplitudes = run_page("assembly.md", tmp_path)
    # What the page says, and what the simulation was told: no run of bricktrack's made lab/truth.csv.
    peaks = true_peaks_mm(tmp_path / "lab" / "truth.csv")
    assert peaks == {"B": "4.125", "C": "8.728"}
    assert "3 on the same samples" in combined
    for component, peak_mm in peaks.items():
        [row] = [line for line in combined.splitlines() if f"│ {component} " in line]
        assert float(re.findall(r"\d+\.\d+", row)[0]) == pytest.approx(float(peak_mm), abs=0.02)
        assert f"{component}: 6 tables of 15" in amplitudes
    assert "wrong" not in combined
    assert "b7-2: the loop that it closes gapes" in wrong
    table = np.loadtxt(tmp_path / "C_ux_mm.txt", delimiter=None)
    assert table.shape[1] == 2 and np.isfinite(table).all()


def true_peaks_mm(file):
    """Return each component's largest displacement, as text with three decimals."""
    peaks = {}
    with file.open() as rows:
        for row in csv.DictReader(rows):
            mm = math.hypot(*(float(row[f"d{axis}_mm"]) for axis in "xyz"))
            peaks[row["component"]] = max(peaks.get(row["component"], 0.0), mm)
    return {component: f"{mm:.3f}" for component, mm in peaks.items()}
