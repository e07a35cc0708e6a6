"""Cut the shared path-traced sample down to what the repository carries in ``tests/data/path-traced``.

Run with the environment variable ``BRICKTRACK_SAMPLES`` naming the folder of the full samples. The video is
decoded and encoded again at a lower rate; everything else is copied or cut, not changed.
"""

import os
import shutil
import sys
from pathlib import Path

import av

N_FRAMES = 48
LAST_DENSE_US = 1_700_000
TARGET = Path(__file__).resolve().parents[1] / "tests" / "data" / "path-traced"
NOTE = f"""# Shortened copy

This folder is a shortened copy of the sample described below, small enough for the repository: the first
{N_FRAMES} frames of `motion.h264` (decoded, then encoded again with x264 at CRF 22, so the picture noise
differs from the original's), the two plane images of the 32x18 target, the inertial samples, the edges and the
truth of that time (`truth/motion_dense.csv` from -0.2 s to 1.7 s). `scripts/make_test_sample.py` made it.
The README of the whole sample follows unchanged; figures in it are of the whole sample.

---

"""


def main() -> None:
    samples = os.environ.get("BRICKTRACK_SAMPLES")
    if not samples:
        sys.exit("BRICKTRACK_SAMPLES is not set; it names the folder that holds path-traced/")
    source = Path(samples) / "path-traced"
    (TARGET / "truth").mkdir(parents=True, exist_ok=True)
    for name in (
        "calib_A_32x18.png",
        "calib_B_32x18.png",
        "layout.toml",
        "rig.toml",
        "imu_motion.csv",
        "edges_motion.csv",
    ):
        shutil.copyfile(source / name, TARGET / name)
        (TARGET / name).chmod(0o644)
    (TARGET / "README.md").write_text(NOTE + (source / "README.md").read_text())
    pts = (source / "motion_pts_us.txt").read_text().splitlines()[:N_FRAMES]
    (TARGET / "motion_pts_us.txt").write_text("\n".join(pts) + "\n")
    last_us = int(pts[-1])

    def keep(name: str, column: int, lowest: float, highest: float) -> None:
        head, *rows = (source / "truth" / name).read_text().splitlines()
        rows = [r for r in rows if lowest <= float(r.split(",")[column]) <= highest]
        (TARGET / "truth" / name).write_text("\n".join([head, *rows]) + "\n")

    keep("motion_poses.csv", 0, 0, last_us)
    keep("motion_leds.csv", 1, 0, last_us)
    keep("motion_dense.csv", 0, -200_000, LAST_DENSE_US)

    with (
        av.open(str(source / "motion.mp4")) as video,
        av.open(str(TARGET / "motion.h264"), "w", format="h264") as out,
    ):
        stream = out.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 1920, 1080, "yuv420p"
        stream.options = {"crf": "22", "preset": "slow", "bf": "0", "g": "30"}
        for i, frame in enumerate(video.decode(video=0)):
            if i == N_FRAMES:
                break
            frame.pict_type = 0
            out.mux(stream.encode(frame))
        out.mux(stream.encode())
    total = sum(p.stat().st_size for p in TARGET.rglob("*") if p.is_file())
    print(f"{TARGET}: {total / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
