"""How much memory fusion LED by LED takes, against the recording's length.

Simulated runs of a unit (`tests/support/daemon_runs.py`), each aligned and fused in a process of its own; figures
of the shortest stand beside it before anything is fused. Decoding keeps no pictures: see `bench_process.py`.

Run: ``python scripts/bench_memory.py``
"""

import multiprocessing
import resource
import sys
from pathlib import Path

from rich.console import Console
from rich.progress import track
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from daemon_runs import simulate_run

from bricktrack_host.fusion.tight import fuse_tight
from bricktrack_host.tracking.optical_track import solve_poses

LENGTHS_S = (16.0, 60.0, 180.0)


def peaks_mb(duration_s: float) -> tuple[float, float]:
    """Return this process's peak memory before and after fusing a run of so many seconds, MB."""
    run = simulate_run(1, duration_s=duration_s)
    optical = solve_poses(run.observations, run.camera, run.brick)
    before = _peak_mb()
    fuse_tight(
        run.observations, optical, run.imu, run.camera, run.brick,
        lever_arm_mm=run.lever_arm_mm, output_t_ns=optical.t_ns,
    )  # fmt: skip
    return before, _peak_mb()


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    table = Table("s", "MB before fusing", "MB at most", title="Peak memory of one process (simulated)")
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        pool.apply(peaks_mb, (LENGTHS_S[0],))  # compiles, on a new machine
        for duration_s in track(LENGTHS_S, "fusing", console=Console(stderr=True)):
            before, most = pool.apply(peaks_mb, (duration_s,))
            table.add_row(f"{duration_s:.0f}", f"{before:.0f}", f"{most:.0f}")
    Console().print(table)


if __name__ == "__main__":
    main()
