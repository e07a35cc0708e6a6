"""How much pairing, checking and viewing pictures costs beside FFmpeg's bare decode, on one recording.

Runs both by turns with the same number of threads and prints the ratio of their times, which says more than
either on a machine with other work:

    python scripts/bench_decode.py runs/sample_motion --threads 2

Without a run it takes the simulated recording that ``bench_process.py`` takes.
"""

import argparse
import statistics
import time
from pathlib import Path

import av
from recording_to_time import simulated_recording

from bricktrack_common.run_folder import read_run
from bricktrack_host.recordings.video_frames import decode_run_video


def bare_decode(video: Path, threads: int) -> int:
    """Decode with PyAV's own container reader and drop the pictures."""
    n = 0
    with av.open(str(video)) as container:
        context = container.streams.video[0].codec_context
        context.thread_type, context.thread_count = "AUTO", threads
        for _ in container.decode(video=0):
            n += 1
    return n


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
    wall: dict[str, list[float]] = {"bare": [], "paired": []}
    cpu: dict[str, list[float]] = {"bare": [], "paired": []}
    n_bare = n_paired = 0
    for _ in range(options.repeat):
        for name in ("bare", "paired"):
            began, began_cpu = time.perf_counter(), time.process_time()
            if name == "bare":
                n_bare = bare_decode(run.video, options.threads)
            else:
                n_paired = sum(
                    f.picture is not None
                    for f in decode_run_video(run.video, run.frames, threads=options.threads)
                )
            wall[name].append(time.perf_counter() - began)
            cpu[name].append(time.process_time() - began_cpu)
    for name, n in (("bare", n_bare), ("paired", n_paired)):
        print(
            f"{name:7} {n} pictures, {1e3 * statistics.median(wall[name]) / n:.2f} ms wall and "
            f"{1e3 * statistics.median(cpu[name]) / n:.2f} ms CPU a picture"
        )
    ratios = [p / b for p, b in zip(cpu["paired"], cpu["bare"], strict=True)]
    print(
        f"paired / bare, CPU: median {statistics.median(ratios):.3f}, from {min(ratios):.3f} to {max(ratios):.3f}"
    )


if __name__ == "__main__":
    main()
