"""Small H.264 videos for tests; the grey of each picture tells which it is."""

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from bricktrack_common.frame_times import FrameTimes
from bricktrack_host.recordings.annex_b import split_access_units

WIDTH, HEIGHT = 160, 96
PERIOD_US = 33_327


def grey_of(i: int) -> int:
    """Return the luma of picture ``i``: neighbours differ by far more than the codec's error."""
    return 30 + (37 * i) % 180


def pictures(n: int) -> list[np.ndarray]:
    """Return pictures as planar YUV 4:2:0 with texture, so that packets have some size."""
    noise = np.random.default_rng(5).integers(-12, 13, (HEIGHT, WIDTH))
    out = []
    for i in range(n):
        luma = np.clip(grey_of(i) + np.roll(noise, 3 * i, axis=1), 16, 235).astype(np.uint8)
        out.append(np.vstack([luma, np.full((HEIGHT // 2, WIDTH), 128, np.uint8)]))
    return out


def write_video(
    path: Path,
    n: int,
    *,
    gop: int = 10,
    stamps_us: list[int] | None = None,
    options: dict[str, str] | None = None,
) -> None:
    """Encode ``n`` pictures; ``.h264`` gives a bare stream, ``.mp4`` and ``.mkv`` keep the stamps."""
    container = av.open(str(path), "w", format="h264" if path.suffix == ".h264" else None)
    with container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.gop_size = gop
        stream.codec_context.time_base = Fraction(1, 1_000_000)
        stream.time_base = Fraction(1, 1_000_000)
        stream.options = {"bf": "0", "crf": "18", "preset": "fast", "threads": "1", "sc_threshold": "0"} | (
            options or {}
        )
        for i, picture in enumerate(pictures(n)):
            frame = av.VideoFrame.from_ndarray(picture, format="yuv420p")
            frame.pts = stamps_us[i] if stamps_us else i * PERIOD_US
            frame.time_base = Fraction(1, 1_000_000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def frame_times(path: Path) -> FrameTimes:
    """Return records for the pictures of a video, one each."""
    units = split_access_units(path.read_bytes())
    i = np.arange(len(units))
    return FrameTimes(
        pts_us=i * PERIOD_US, sensor_timestamp_ns=10**12 + i * PERIOD_US * 1000, exposure_us=np.full(len(i), 4000),
        analogue_gain=np.ones(len(i)), keyframe=np.array([u.keyframe for u in units]),
        byte_offset=np.array([u.byte_offset for u in units]), n_bytes=np.array([u.n_bytes for u in units]),
        flags=np.zeros(len(i), np.int64), leftover_bytes=0,
    )  # fmt: skip


def damage(path: Path, frames: FrameTimes, i: int, change: Callable[[bytes], bytes]) -> None:
    """Change the bytes of picture ``i``."""
    data = bytearray(path.read_bytes())
    start, n = int(frames.byte_offset[i]), int(frames.n_bytes[i])
    data[start : start + n] = change(bytes(data[start : start + n]))
    path.write_bytes(data)


def write_cut_scenes(path: Path, refs: int, *, n: int = 32) -> None:
    """Encode two scenes; at the cut, picture 16, x264 puts an intra picture that is no IDR."""
    draw = np.random.default_rng(0)
    options = f"keyint=200:min-keyint=100:scenecut=80:ref={refs}:repeat-headers=1"
    with av.open(str(path), "w", format="h264") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.options = {"bf": "0", "crf": "18", "preset": "fast", "threads": "1", "x264-params": options}
        for i in range(n):
            if i % 16 == 0:
                picture = draw.integers(20, 220, (HEIGHT * 3 // 2, WIDTH)).astype(np.uint8)
            frame = av.VideoFrame.from_ndarray(picture, format="yuv420p")
            frame.pts = i
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    assert split_access_units(path.read_bytes())[16].keyframe is False
