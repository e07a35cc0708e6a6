"""A simulated recording that the benchmarks share: made once, kept in the system's temporary folder."""

import subprocess
import sys
import tempfile
from pathlib import Path

DURATION_S = 15


def simulated_recording(duration_s: int = DURATION_S) -> tuple[Path, Path, Path]:
    """Return run folder, calibration and layout of a simulated recording, made now or at an earlier time."""
    folder = Path(tempfile.gettempdir()) / f"bricktrack-bench-{duration_s}s"
    found = sorted(folder.glob("runs/*/manifest.json"))
    if not found or not (folder / "calibration.json").is_file():
        print(f"recording {duration_s} s with 'bricktrack demo' into {folder} ...", flush=True)
        command = [sys.executable, "-m", "bricktrack_host.cli", "demo"]
        done = subprocess.run(
            [*command, "--folder", str(folder), "--duration", str(duration_s)],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        found = sorted(folder.glob("runs/*/manifest.json"))
        if done.returncode or not found:
            raise SystemExit(f"'bricktrack demo' ended with {done.returncode}:\n{done.stderr}")
    return found[0].parent, folder / "calibration.json", folder / "kit" / "layout.toml"
