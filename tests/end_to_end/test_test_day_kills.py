"""A test day whose host dies again and again: the same commands end with what an undisturbed day gives.

Light units that serve copies of a real short recording; the host's commands are real and process it. They are
killed with SIGKILL at random instants of their whole length: all their processes at once, as a power cut does,
or the first of them alone. ``BRICKTRACK_KILLS`` says how often, in ``collect``; 3 by default.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest
from light_fleet import LightFleet, write_fleet_file
from path_traced import SAMPLE, import_motion

from bricktrack_common.checksums import sha256_file
from bricktrack_common.run_manifest import MANIFEST_NAME, read_manifest
from bricktrack_host.calibration.calibration_file import load_calibration, save_calibration
from bricktrack_host.cli import calibrate

KILLS = int(os.environ.get("BRICKTRACK_KILLS", "3"))
SEED = int(os.environ.get("BRICKTRACK_SEED", "12"))
NAMES = ["b7-1", "b7-2"]
MAY_DIFFER = ("processing.json", "timings.json", "report.html")
"""How long it took, and the page that quotes it."""
_LONGEST_S = 400
"""Compiling on a machine's first day included."""

pytestmark = pytest.mark.slow


@pytest.fixture
def lab(tmp_path):
    """Two light units, a recording, and a fleet file that names what its processing needs."""
    import_motion(tmp_path / "recorded")
    calibrate.fit(
        tmp_path / "sample.json", "sample", rig=SAMPLE / "rig.toml", target="32x18", images_dir=SAMPLE,
        model="two-plane", report=False,
    )  # fmt: skip
    with LightFleet(tmp_path / "cards", NAMES, n_processes=1) as units:
        fleet = write_fleet_file(tmp_path / "fleet.toml", units.ports)
        text = fleet.read_text()
        for name in NAMES:
            sample = load_calibration(tmp_path / "sample.json")
            save_calibration(tmp_path / f"{name}.json", msgspec.structs.replace(sample, unit=name))
            text = text.replace(
                f'name = "{name}"\n',
                f'name = "{name}"\ncalibration = "{name}.json"\nlayout = "{SAMPLE / "layout.toml"}"\n',
            )
        fleet.write_text(text)
        yield units


class Host:
    """The command line in a folder, and what its commands take undisturbed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.draw = random.Random(SEED)
        self.length_s: dict[str, float] = {}

    def start(self, *words: str) -> "subprocess.Popen[str]":
        command = [sys.executable, "-m", "bricktrack_host.cli", "test", *words]
        return subprocess.Popen(
            command, cwd=self.folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            start_new_session=True,
        )  # fmt: skip

    def finish(self, *words: str) -> str:
        start_s = time.monotonic()
        process = self.start(*words)
        try:
            said, _ = process.communicate(timeout=_LONGEST_S)
        finally:
            kill_session(process.pid)
        assert process.returncode == 0, said
        self.length_s.setdefault(words[0], time.monotonic() - start_s)
        return said

    def kill(self, *words: str) -> None:
        """Begin a command and kill it at some instant of it."""
        process = self.start(*words)
        time.sleep(self.draw.uniform(0.0, self.length_s.get(words[0], 4.0)))
        if process.poll() is None and self.draw.random() < 0.5:
            process.kill()  # its processes are orphans then, and must not harm what is done next
        else:
            kill_session(process.pid)
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def kill_session(leader: int) -> None:
    """Kill every process of a session at once."""
    try:
        os.killpg(leader, signal.SIGKILL)
    except ProcessLookupError:
        return


def verify_what_is_here(runs: Path) -> None:
    """What bears the name of a run, or of results, is whole at any time."""
    for run in runs.glob("*_s1"):
        for entry in read_manifest(run / MANIFEST_NAME).files:
            assert sha256_file(run / entry.name) == entry.sha256
        for results in run.glob("results*"):
            assert (results / "summary.json").is_file(), results


def held(folder: Path) -> dict[str, str]:
    """Return the hashes of all files below a folder, but for what says how long it took."""
    return {
        str(path.relative_to(folder)): sha256_file(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in MAY_DIFFER
    }


def test_a_day_of_kills_ends_as_an_undisturbed_one(lab, tmp_path):
    host = Host(tmp_path)
    runs, combined = tmp_path / "runs", tmp_path / "tests" / "s1" / "combined"
    host.finish("new", "s1")
    for _ in range(1 + KILLS // 4):
        host.kill("arm", "s1", "--no-wait")
    host.finish("arm", "s1", "--no-wait")
    lab.record(tmp_path / "recorded" / "sample_motion")
    assert "all runs are saved" in host.finish("arm", "s1")

    for _ in range(KILLS):
        host.kill("collect", "s1")
        verify_what_is_here(runs)
    host.finish("collect", "s1")
    for _ in range(1 + KILLS // 4):
        host.kill("report", "s1")
    host.finish("report", "s1")
    disturbed = held(runs), held(combined)
    assert [len(list((tmp_path / "cards" / name / "runs").iterdir())) for name in NAMES] == [1, 1]
    assert not list(runs.glob("*/results_*")), "interrupted processing leaves no second results"
    assert not list(runs.glob("*/.results*")), "nothing half-written is left over"

    shutil.rmtree(runs)
    shutil.rmtree(combined)
    host.finish("collect", "s1")
    host.finish("report", "s1")
    assert (held(runs), held(combined)) == disturbed
    assert len(disturbed[0]) > 2 * 15
