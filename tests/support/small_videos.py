"""Small H.264 videos for tests; the grey of each picture tells which it is."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np

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
