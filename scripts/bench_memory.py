"""How much memory processing a run takes, stage by stage, against the recording's length.

Simulated recordings of several lengths (`long_recording.py`) are processed as `bricktrack process` does it, from
reading the run folder to the report, each in a process of its own. The peak of each stage is its own: the kernel
is asked to forget the peak when a stage begins (Linux). A warning that the motions LED by LED and pose by pose
are apart is of these recordings' making, whose noise comes again (see `long_recording.py`). Ten minutes of
recording take 3 GB on the disk while they are processed, and two minutes:

    python scripts/bench_memory.py
    python scripts/bench_memory.py --seconds 16 600
"""

import argparse
import multiprocessing
import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before NumPy is loaded

from long_recording import long_recording
from rich.console import Console
from rich.progress import track
from rich.table import Table

from bricktrack_host.pipeline import process_run

LENGTHS_S = (16.0, 60.0, 180.0)
_STATUS, _FORGET = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_FORGET_PEAK = "5"  # proc(5): reset the peak resident set size to the current one


class StagePeaks:
    """Hears which stage of the processing begins, and notes the most memory that each one took, MB."""

    def __init__(self) -> None:
        self.peak_mb: dict[str, float] = {}
        self._now = ""

    def stage(self, name: str, total: int | None) -> None:
        """End the stage before and begin another."""
        self.end()
        _FORGET.write_text(_FORGET_PEAK)
        self._now = name

    def advance_to(self, done: int) -> None:
        """Hear nothing."""

    def end(self) -> None:
        """Note what the stage took."""
        if self._now:
            self.peak_mb[self._now] = _peak_mb()
        self._now = ""


def peaks_mb(run: Path, calibration: Path, layout: Path, results: Path) -> tuple[dict[str, float], float]:
    """Return the peak memory of each stage of processing a run, MB, and the processor's seconds in all."""
    peaks, start_s = StagePeaks(), time.process_time()
    process_run(run, calibration=calibration, layout=layout, output=results, progress=peaks)
    peaks.end()
    return peaks.peak_mb, time.process_time() - start_s


def _peak_mb() -> float:
    lines = _STATUS.read_text(encoding="ascii").splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1024


def main() -> None:
    """Print the peaks, and what a second of recording adds to them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, nargs="+", default=LENGTHS_S, help="lengths of recordings")
    lengths_s = sorted(parser.parse_args().seconds)
    if not sys.platform.startswith("linux"):
        raise SystemExit("peaks of single stages are told by Linux only")
    found: dict[float, tuple[dict[str, float], float]] = {}
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for length_s in track(lengths_s, "processing", console=Console(stderr=True)):
            with tempfile.TemporaryDirectory(prefix="bricktrack-memory-") as scratch:
                paths = pool.apply(long_recording, (Path(scratch), length_s))
                if not found:
                    pool.apply(peaks_mb, (*paths, Path(scratch) / "first"))  # compiles, on a new machine
                found[length_s] = pool.apply(peaks_mb, (*paths, Path(scratch) / "results"))
    stages = list(found[lengths_s[0]][0])
    table = Table("s", *stages, "MB at most", "s CPU", title="Peak memory of processing, MB (simulated)")
    for length_s, (peak_mb, cpu_s) in found.items():
        of_stages = [f"{peak_mb[stage]:.0f}" for stage in stages]
        table.add_row(f"{length_s:.0f}", *of_stages, f"{max(peak_mb.values()):.0f}", f"{cpu_s:.0f}")
    if len(lengths_s) > 1:
        longer_s = lengths_s[-1] - lengths_s[0]
        first, last = ({**found[s][0], "": max(found[s][0].values())} for s in (lengths_s[0], lengths_s[-1]))
        a_second = [f"{(last[stage] - first[stage]) / longer_s:.2f}" for stage in [*stages, ""]]
        table.add_section()
        table.add_row("a second", *a_second, "")
    Console().print(table)


if __name__ == "__main__":
    main()
