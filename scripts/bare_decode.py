"""FFmpeg's decode of a video with nothing done with its pictures: what benchmarks hold processing against.

python scripts/bare_decode.py runs/b2_9f31c2_0007_shake/video.h264 --threads 2
"""

import argparse
from pathlib import Path

import av


def bare_decode(video: Path, threads: int) -> int:
    """Decode with PyAV's own container reader, drop the pictures, and return how many there were."""
    n = 0
    with av.open(str(video)) as container:
        context = container.streams.video[0].codec_context
        context.thread_type, context.thread_count = "AUTO", threads
        for _ in container.decode(video=0):
            n += 1
    return n


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("video", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    print(bare_decode(options.video, options.threads), "pictures")
