"""How long processing a run takes beside FFmpeg's bare decode of its video, on a simulated recording.

The first time, 15 s, or ``--seconds``, are recorded with ``bricktrack demo``: the real daemon, simulated
sensors, the pull. The recording stays under the system's temporary directory for the next time. Then, by turns,
the video is decoded with as many threads and nothing done with its pictures, and the whole run is processed,
from reading it to its report: in this process, as one of several runs is, or with ``--command`` as from a shell,
the command and the decode each in a process of its own, which loads Python and its modules. Each processing is
compared with the mean of the decodes just before and just after it. Ratios say more than times on a machine
with other work:

    python scripts/bench_process.py
    python scripts/bench_process.py --command
    python scripts/bench_process.py --seconds 60      # does memory grow with the recording?
    python scripts/bench_process.py --run runs/b2_9f31c2_0007_shake --calibration b2.json --layout brick.toml
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before NumPy is loaded

from bare_decode import bare_decode
from recording_to_time import DURATION_S, simulated_recording

from bricktrack_common.run_folder import Run, read_run
from bricktrack_host.pipeline import process_run

DECODER_THREADS = 2  # those of `decode_run_video`


@dataclass
class Taken:
    """Seconds that something took, each time: on the wall, and of the processors, child processes included."""

    wall_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)

    def time(self, work: Callable[[], object]) -> None:
        """Do the work, and note what it took."""
        wall, cpu = time.perf_counter(), _cpu_s()
        work()
        self.wall_s.append(time.perf_counter() - wall)
        self.cpu_s.append(_cpu_s() - cpu)

    def line(self, name: str, n_frames: int) -> str:
        """Return medians, whole and a frame."""
        wall, cpu = statistics.median(self.wall_s), statistics.median(self.cpu_s)
        return (
            f"{name:24s} {wall:7.2f} s wall {cpu:7.2f} s CPU   {1e3 * wall / n_frames:6.2f} and "
            f"{1e3 * cpu / n_frames:6.2f} ms a frame"
        )


def ratios(processed_s: list[float], decoded_s: list[float]) -> list[float]:
    """Return each time of processing over the mean of the decodes before and after it, one more than those."""
    around = [0.5 * (before + after) for before, after in pairwise(decoded_s)]
    return [processed / bare for processed, bare in zip(processed_s, around, strict=True)]


@dataclass
class StageClock:
    """Hears which stage of the processing begins, and notes what each took and how much memory there was."""

    wall_s: dict[str, float] = field(default_factory=dict)
    cpu_s: dict[str, float] = field(default_factory=dict)
    peak_mb: dict[str, float] = field(default_factory=dict)
    _now: tuple[str, float, float] | None = None

    def stage(self, name: str, total: int | None) -> None:
        """End the stage before and begin another."""
        self.end()
        self._now = name, time.perf_counter(), time.process_time()

    def advance_to(self, done: int) -> None:
        """Hear nothing."""

    def end(self) -> None:
        """Note what the stage took."""
        if self._now is not None:
            name, wall, cpu = self._now
            self.wall_s[name] = time.perf_counter() - wall
            self.cpu_s[name] = time.process_time() - cpu
            self.peak_mb[name] = _peak_mb()
        self._now = None


def main() -> None:
    """Print times, ratios, stages and memory."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=int, default=DURATION_S, help="length of the simulated recording")
    parser.add_argument("--run", type=Path, help="another run, with its calibration and layout")
    parser.add_argument("--calibration", type=Path)
    parser.add_argument("--layout", type=Path)
    parser.add_argument("--repeat", type=int, default=5, help="pairs, at least 2")
    parser.add_argument("--command", action="store_true", help="by the command, in a process of its own")
    options = parser.parse_args()
    if options.repeat < 2:
        parser.error(f"--repeat is {options.repeat}; medians and spread need at least 2")
    if options.run is None:
        folder, calibration, layout = simulated_recording(options.seconds)
    elif options.calibration is None or options.layout is None:
        parser.error("--run needs --calibration and --layout")
    else:
        folder, calibration, layout = options.run, options.calibration, options.layout
    run = read_run(folder)
    if run.video is None or run.frames is None:
        raise SystemExit(f"{folder}: no video with frame times")
    n = run.frames.n_frames
    length_s = float(run.frames.sensor_timestamp_ns[-1] - run.frames.sensor_timestamp_ns[0]) / 1e9
    print(("Simulated recording" if run.manifest.simulated else "Recording") + f" {folder.name}")
    print(f"{n} frames over {length_s:.1f} s{_mode(run)}; {os.cpu_count()} processors\n")
    before_mb = _peak_mb()
    video, decode, process = run.video, Taken(), Taken()
    stages: list[StageClock] = []
    with tempfile.TemporaryDirectory() as scratch:
        results = Path(scratch) / "results"

        def here() -> None:
            clock = StageClock()
            process_run(folder, calibration=calibration, layout=layout, output=results, progress=clock)
            clock.end()
            stages.append(clock)

        def command() -> None:
            _command(folder, calibration, layout, results)

        def alone() -> None:
            script = Path(__file__).with_name("bare_decode.py")
            _run([str(script), str(video), "--threads", str(DECODER_THREADS)])

        work: Callable[[], object] = command if options.command else here
        floor = alone if options.command else partial(bare_decode, video, DECODER_THREADS)
        work()  # what is compiled and loaded once, and files read from the disk
        first = stages[0] if stages else StageClock()  # memory: later peaks are those of before
        stages.clear()
        decode.time(floor)
        for _ in range(options.repeat):
            process.time(work)
            decode.time(floor)
    print(decode.line(f"bare decode, {DECODER_THREADS} threads", n))
    print(process.line("the command" if options.command else "process", n))
    print("\nprocess / bare decode by its side: median, middle half, and range")
    for name, ours, bare in (
        ("wall", process.wall_s, decode.wall_s),
        ("CPU", process.cpu_s, decode.cpu_s),
    ):
        found = ratios(ours, bare)
        low, middle, high = statistics.quantiles(found, n=4, method="inclusive")
        print(
            f"  {name:5s} {middle:5.2f}   {low:.2f} to {high:.2f}   {min(found):.2f} to {max(found):.2f}"
            f"   ({len(found)} pairs)"
        )
    print(f"process / length of the recording, wall: {statistics.median(process.wall_s) / length_s:.2f}")
    if not stages:
        return
    print("\nstage                      s wall    s CPU   ms CPU a frame   peak memory so far, MB")
    for name in stages[0].wall_s:
        wall_s = statistics.median(s.wall_s[name] for s in stages)
        cpu_s = statistics.median(s.cpu_s[name] for s in stages)
        print(f"{name:24s} {wall_s:8.2f} {cpu_s:8.2f} {1e3 * cpu_s / n:16.2f} {first.peak_mb[name]:24.0f}")
    print(f"\npeak memory {_peak_mb():.0f} MB, of which {before_mb:.0f} MB are Python and its modules")


def _mode(run: Run) -> str:
    camera = run.manifest.camera
    return "" if camera is None else f", {camera.mode.width} x {camera.mode.height} px"


def _command(folder: Path, calibration: Path, layout: Path, results: Path) -> None:
    files = ["--calibration", str(calibration), "--layout", str(layout), "--output", str(results)]
    _run(["-m", "bricktrack_host.cli", "process", str(folder), *files, "--again"])


def _run(arguments: list[str]) -> None:
    """Run Python with arguments, its modules kept compiled as on anybody's machine."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    done = subprocess.run([sys.executable, *arguments], env=kept, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"'python {' '.join(arguments)}' ended with {done.returncode}:\n{done.stderr}")


def _cpu_s() -> float:
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


def _peak_mb() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20) if sys.platform == "darwin" else peak / 1024


if __name__ == "__main__":
    main()
