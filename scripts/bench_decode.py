"""How much pairing, checking and viewing pictures costs beside FFmpeg's bare decode, on one recording.

Runs by turns, with the same number of threads: the bare decode; pictures paired in order, by a decoder of
frame threads; and in parts side by side, by a decoder of one thread each, as runs are processed. Prints the
ratios of their times, which say more than times on a machine with other work:

    python scripts/bench_decode.py runs/sample_motion --threads 2

Without a run it takes the simulated recording that ``bench_process.py`` takes.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path

from bare_decode import bare_decode
from recording_to_time import simulated_recording

from bricktrack_common.run_folder import read_run
from bricktrack_host.recordings.video_frames import DecodedFrame, decode_run_video
from bricktrack_host.recordings.video_parts import work_on_frames


def main() -> None:
    """Print times and ratio."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, nargs="?")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=5)
    options = parser.parse_args()
    folder = options.run
    if folder is None:
        folder, _, _ = simulated_recording()
    run = read_run(folder)
    if run.video is None or run.frames is None:
        raise SystemExit(f"{folder}: no video with frame times")
    print(("Simulated recording" if run.manifest.simulated else "Recording") + f" {folder.name}")
    video, frames, threads = run.video, run.frames, options.threads
    ways: dict[str, Callable[[], int]] = {
        "bare": lambda: bare_decode(video, threads),
        "in order": lambda: sum(map(_has_picture, decode_run_video(video, frames, threads=threads))),
        "in parts": lambda: sum(work_on_frames(video, frames, _has_picture, threads=threads)),
    }
    wall: dict[str, list[float]] = {name: [] for name in ways}
    cpu: dict[str, list[float]] = {name: [] for name in ways}
    n: dict[str, int] = {}
    for _ in range(options.repeat):
        for name, decode in ways.items():
            began, began_cpu = time.perf_counter(), time.process_time()
            n[name] = decode()
            wall[name].append(time.perf_counter() - began)
            cpu[name].append(time.process_time() - began_cpu)
    for name in ways:
        print(
            f"{name:8} {n[name]} pictures, {1e3 * statistics.median(wall[name]) / n[name]:.2f} ms wall and "
            f"{1e3 * statistics.median(cpu[name]) / n[name]:.2f} ms CPU a picture"
        )
    for name in ("in order", "in parts"):
        for unit, taken in (("wall", wall), ("CPU", cpu)):
            ratios = [ours / bare for ours, bare in zip(taken[name], taken["bare"], strict=True)]
            print(
                f"{name} / bare, {unit}: median {statistics.median(ratios):.3f}, from {min(ratios):.3f} to "
                f"{max(ratios):.3f}"
            )


def _has_picture(frame: DecodedFrame) -> bool:
    return frame.picture is not None


if __name__ == "__main__":
    main()
