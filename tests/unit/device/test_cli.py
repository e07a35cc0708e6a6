import importlib.metadata
import json
import subprocess
import sys
from pathlib import Path

import pytest


def bricktrackd(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "bricktrack_device.cli", *arguments], capture_output=True, text=True, timeout=60,
        check=False,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "--backend", "abacus"], "backend: 'abacus' does not exist here"),
        (["run", "--config", "/nowhere.toml"], "/nowhere.toml"),
        (["check", "--backend", "sim", "--port", "99999"], "server.port"),
    ],
)
def test_an_error_is_one_line_and_status_1(arguments: list[str], words: str) -> None:
    done = bricktrackd(*arguments)
    assert done.returncode == 1 and done.stdout == ""
    assert done.stderr.startswith("bricktrackd: ") and words in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("command", ["run", "check", "sim-kit"])
def test_help_has_an_example(command: str) -> None:
    done = bricktrackd(command, "--help")
    assert done.returncode == 0 and f"bricktrackd {command}" in done.stdout.split("Example", 1)[1]


@pytest.mark.parametrize("command", [(), ("run",), ("keys",), ("keys", "create")])
def test_help_says_no_type_of_flags(command: tuple[str, ...]) -> None:
    done = bricktrackd(*command, "--help")
    assert done.returncode == 0 and "--help" in done.stdout and "bool" not in done.stdout.lower()


def test_the_version_is_the_host_s_too() -> None:
    done = bricktrackd("--version")
    assert (done.returncode, done.stdout) == (0, f"bricktrackd {importlib.metadata.version('bricktrack')}\n")


def test_importing_the_command_line_stays_small() -> None:
    # Every sampler's process imports it again; the daemon's own parts must not come along.
    code = "import sys, bricktrack_device.cli as c; print(sorted(m for m in sys.modules if m in ('numpy', 'zmq', 'av')))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == "[]"


def test_the_simulated_unit_passes_its_own_check(tmp_path: Path) -> None:
    # Ten frames a second are rendered and encoded in time on a busy machine as well.
    config = tmp_path / "bricktrackd.toml"
    config.write_text("[camera]\nframe_rate_hz = 10.0\n")
    where = ("--config", str(config), "--storage", str(tmp_path), "--port", "0")
    done = bricktrackd("check", "--backend", "sim", *where, "--json")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("command", ["imu-test", "start-test", "timing-test"])
def test_a_timing_tool_says_what_it_does_and_how_to_call_it(command: str) -> None:
    done = bricktrackd(command, "--help")
    assert done.returncode == 0 and f"bricktrackd {command}" in done.stdout.split("Example", 1)[1]


def test_a_measurement_is_printed_as_json_and_written(tmp_path: Path) -> None:
    path = tmp_path / "imu.json"
    done = bricktrackd("imu-test", "--backend", "sim", "--slots", "100", "--json", "--output", str(path))
    assert done.returncode == 0, done.stderr
    printed = json.loads(done.stdout)
    assert printed == json.loads(path.read_text())
    assert (
        printed["tool"] == "imu-test" and printed["simulated"] and printed["figures"]["grid"]["slots"] == 100
    )
