"""Many runs processed by one and by two processes of this machine, and by a Dask cluster of two workers on it.

A short run is recorded once with ``bricktrack demo``: the real daemon, simulated sensors, the pull. The runs
are copies of it under other ids, so their contents are alike and the work is not. Each way processes the same
runs through the command itself; then the results of all ways are compared byte for byte. In the last pass a
worker is killed with SIGKILL in the middle, and the results must still be the same:

    python scripts/bench_scale.py
    python scripts/bench_scale.py --runs 4 --duration 15
"""

import argparse
import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import msgspec
import psutil
from recording_to_time import simulated_recording

from bricktrack_common.checksums import sha256_file
from bricktrack_common.run_folder import read_run
from bricktrack_common.run_manifest import MANIFEST_NAME, read_manifest, write_manifest
from bricktrack_host.many_runs.processing_record import RECORD_NAME, Took, read_record
from bricktrack_host.results.result_store import TIMINGS_NAME

MAY_DIFFER = (RECORD_NAME, TIMINGS_NAME, "report.html")
"""How long it took, and the page that quotes it."""


@dataclass(frozen=True)
class Pass:
    """One way of processing all runs: wall time, and the hashes of all results."""

    name: str
    wall_s: float
    hashes: dict[str, str]
    took: list[Took]


def copies(run: Path, folder: Path, n_runs: int) -> list[Path]:
    """Return copies of a run, each under an id of its own."""
    manifest = read_manifest(run / MANIFEST_NAME)
    made = []
    for i in range(1, n_runs + 1):
        copy = folder / f"{manifest.run_id}-{i:02d}"
        copy.mkdir(parents=True)
        for path in run.iterdir():
            if path.is_file() and path.name != MANIFEST_NAME:
                os.link(path, copy / path.name) if _same_disk(path, folder) else shutil.copy2(path, copy)
        write_manifest(copy / MANIFEST_NAME, msgspec.structs.replace(manifest, run_id=copy.name))
        made.append(copy)
    return made


def _same_disk(path: Path, folder: Path) -> bool:
    return path.stat().st_dev == folder.stat().st_dev


def process(name: str, runs: list[Path], belongings: list[str], *options: str) -> Pass:
    """Process all runs with the command, from nothing, and return what that took and gave."""
    for run in runs:
        shutil.rmtree(run / "results", ignore_errors=True)
    command = [sys.executable, "-m", "bricktrack_host.cli", "process", *map(str, runs), *belongings, *options]
    start = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    wall_s = time.perf_counter() - start
    if done.returncode:
        raise SystemExit(
            f"{name}: ended with {done.returncode}:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
        )
    hashes = {
        f"{run.name}/{path.name}": sha256_file(path)
        for run in runs
        for path in sorted((run / "results").iterdir())
        if path.name not in MAY_DIFFER
    }
    records = [read_record(run / "results") for run in runs]
    return Pass(name, wall_s, hashes, [record.took for record in records if record is not None])


@contextlib.contextmanager
def dask_cluster(folder: Path, n_workers: int) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Run a scheduler and workers as programs of their own; give the address, and what starts the workers."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    dask = [sys.executable, "-m", "dask"]
    place = ["--no-dashboard"]
    log = (folder / "dask.log").open("wb")
    scheduler = subprocess.Popen(
        [*dask, "scheduler", "--host", "127.0.0.1", "--port", str(port), *place], stderr=log, stdout=log
    )
    workers = subprocess.Popen(
        [*dask, "worker", address, "--nthreads", "1", "--nworkers", str(n_workers), *place,
         "--local-directory", str(folder / "dask")], stderr=log, stdout=log,
    )  # fmt: skip
    try:
        yield address, workers
    finally:
        for program in (workers, scheduler):
            program.terminate()
            try:
                program.wait(20)
            except subprocess.TimeoutExpired:
                program.kill()
        log.close()


def kill_one(workers: subprocess.Popen[bytes], after_s: float) -> threading.Timer:
    """Kill one worker process some time from now; return the timer."""

    def kill() -> None:
        family = psutil.Process(workers.pid).children(recursive=True)
        busy = [p for p in family if p.cpu_times().user > 1.0]
        if busy:
            busy[-1].send_signal(signal.SIGKILL)
            killed.append(busy[-1].pid)

    killed: list[int] = []
    timer = threading.Timer(after_s, kill)
    timer.killed = killed  # type: ignore[attr-defined]
    timer.start()
    return timer


def main() -> None:
    """Print wall times side by side, and whether all results are the same."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--duration", type=int, default=3, help="seconds that the recording lasts")
    parser.add_argument("--run", type=Path, help="another short run, with its calibration and layout")
    parser.add_argument("--calibration", type=Path)
    parser.add_argument("--layout", type=Path)
    options = parser.parse_args()
    if options.run is None:
        recorded, calibration, layout = simulated_recording(options.duration)
    elif options.calibration is None or options.layout is None:
        parser.error("--run needs --calibration and --layout")
    else:
        recorded, calibration, layout = options.run, options.calibration, options.layout
    belongings = ["--calibration", str(calibration), "--layout", str(layout)]
    with tempfile.TemporaryDirectory(prefix="bricktrack-scale-") as name:
        folder = Path(name)
        runs = copies(recorded, folder / "runs", options.runs)
        n_bytes = sum(p.stat().st_size for p in runs[0].iterdir() if p.is_file())
        print(
            f"{len(runs)} runs of {_length_s(recorded):.1f} s{_simulated(recorded)}, copies of one under other "
            f"ids, {n_bytes / 1e6:.1f} MB each; {os.cpu_count()} processors\n"
        )
        process("first", runs[:1], belongings, "--jobs", "1")  # compiles, where nothing has yet
        passes = [
            process("1 local process", runs, belongings, "--jobs", "1"),
            process("2 local processes", runs, belongings, "--jobs", "2"),
        ]
        with dask_cluster(folder, 2) as (address, workers):
            cluster = ["--scheduler", address]
            process("first", runs[:2], belongings, *cluster)  # its workers load what computes
            for send in ("path", "bytes"):
                passes.append(process(f"2 Dask workers, {send}", runs, belongings, *cluster, "--send", send))
            timer = kill_one(workers, passes[-1].wall_s / 2)
            passes.append(process("... one killed halfway", runs, belongings, *cluster))
            timer.join()
            if not timer.killed:  # type: ignore[attr-defined]
                raise SystemExit("no worker was at work when one should have been killed")
        _report(passes, len(runs))
        results = list((runs[0] / "results").iterdir())
        print(
            f"results of a run: {sum(p.stat().st_size for p in results) / 1e6:.1f} MB in {len(results)} files"
        )


def _length_s(run: Path) -> float:
    frames = read_run(run).frames
    if frames is None:
        raise SystemExit(f"{run}: no frame times")
    return float(frames.sensor_timestamp_ns[-1] - frames.sensor_timestamp_ns[0]) / 1e9


def _simulated(run: Path) -> str:
    return " (simulated)" if read_manifest(run / MANIFEST_NAME).simulated else ""


def _report(passes: list[Pass], n_runs: int) -> None:
    alone_s = passes[0].wall_s
    print(
        f"{'way':26s} {'wall s':>8s} {'s a run':>8s} {'of one':>7s} {'CPU s a run':>12s} {'peak MB':>8s}  results"
    )
    for p in passes:
        same = "the same" if p.hashes == passes[0].hashes else "DIFFERENT"
        print(
            f"{p.name:26s} {p.wall_s:8.1f} {p.wall_s / n_runs:8.2f} {p.wall_s / alone_s:7.2f} "
            f"{median(t.cpu_s for t in p.took):12.2f} {max(t.peak_memory_mb for t in p.took):8.0f}  {same}"
        )
    print(
        f"\n{len(passes[0].hashes)} files of results compared byte for byte, all but {', '.join(MAY_DIFFER)}"
    )
    if any(p.hashes != passes[0].hashes for p in passes):
        raise SystemExit("results depend on who made them")


if __name__ == "__main__":
    main()
