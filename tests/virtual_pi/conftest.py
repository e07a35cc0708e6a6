"""Running things inside the virtual Pi: a real Linux kernel with emulated pins, bus and sensor."""

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

HERE = Path(__file__).parent
REPOSITORY = HERE.parents[1]

if "VPI" not in os.environ:
    # These are run inside the virtual Pi, by test_virtual_pi.py and run_camera.sh.
    collect_ignore_glob = ["guest_*.py", "virtual_sensor.py"]

Guest = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="session")
def kernel(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return what the virtual Pi must be told of its kernel on this machine; see `uml_on_amx.c`."""
    uml = Path(os.environ.get("BRICKTRACK_VIRTUAL_PI", "")) / "linux-uml"
    if "amx_tile" not in Path("/proc/cpuinfo").read_text() or "VPI_UML" in os.environ or not uml.exists():
        return {}
    folder = tmp_path_factory.mktemp("uml")
    library, start = folder / "uml_on_amx.so", folder / "linux-uml"
    subprocess.run(["cc", "-O2", "-shared", "-fPIC", "-o", library, HERE / "uml_on_amx.c"], check=True)
    start.write_text(f'#!/bin/sh\nLD_PRELOAD={library} exec {uml.resolve()} "$@"\n')
    start.chmod(0o755)
    return {"VPI_UML": str(start)}


@pytest.fixture
def guest(kernel: dict[str, str]) -> Guest:
    """Return what boots the virtual Pi, runs this Python there with some arguments, and returns how it went."""
    folder = os.environ.get("BRICKTRACK_VIRTUAL_PI")
    if not folder:
        pytest.skip("needs the virtual Pi: set BRICKTRACK_VIRTUAL_PI to its folder")

    def run(
        arguments: Sequence[str], *, options: Sequence[str] = (), timeout_s: int = 120
    ) -> "subprocess.CompletedProcess[str]":
        command = [
            str(Path(folder) / "vpi"), *options, "--timeout", str(timeout_s), "--share", str(REPOSITORY),
            "--", sys.executable, *arguments,
        ]  # fmt: skip
        return subprocess.run(
            command, cwd=REPOSITORY, env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"} | kernel,
            capture_output=True, text=True, check=False, timeout=timeout_s + 30,
        )  # fmt: skip

    return run
