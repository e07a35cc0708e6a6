"""How fast the simulated camera is: frames a second against its 30, and what rendering and encoding cost.

Run from the repository: ``python scripts/bench_sim_camera.py [--seconds 10] [--picture out.png]``. All figures are
simulated pictures'; the machine should have little else to do.
"""

import argparse
import os
import time
from pathlib import Path

import av
import numpy as np
from av.video.frame import VideoFrame

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.clocks import monotonic_ns
from bricktrack_device.config import CameraTable
from bricktrack_device.interfaces import EncodedPacket, FrameMetadata
from bricktrack_device.sim.led_renderer import LedRenderer
from bricktrack_device.sim.lens import lens_of
from bricktrack_device.sim.settings import SimSettings
from bricktrack_device.sim.sim_camera import SimCamera, VideoEncoder
from bricktrack_device.sim.world import SimWorld, make_epoch

N_COST_FRAMES = 60


class CountingSink:
    """Keeps what a camera gives."""

    def __init__(self) -> None:
        self.packets: list[EncodedPacket] = []
        self.metadata: list[FrameMetadata] = []
        self.late_ms: list[float] = []

    def on_packet(self, packet: EncodedPacket) -> None:
        """Take one encoded picture."""
        self.packets.append(packet)
        self.late_ms.append(monotonic_ns() / 1e6 - packet.abs_us / 1e3)

    def on_metadata(self, metadata: FrameMetadata) -> None:
        """Take one frame's metadata."""
        self.metadata.append(metadata)


def cost_ms(world: SimWorld, first_ns: int, camera: CameraTable) -> tuple[float, float, float]:
    """Return CPU time a frame of rendering and of encoding, ms, and Mbit/s, shake or rest from ``first_ns`` on."""
    renderer = LedRenderer(
        world.settings, world, lens=lens_of(world.settings.seed), mode=IMX219_1080P,
        exposure_ns=camera.exposure_us * 1000,
    )  # fmt: skip
    period_ns = 33_326_871
    encoder = VideoEncoder(camera, 1920, 1080)
    n_bytes, rendering, encoding = 0, 0.0, 0.0
    for k in range(N_COST_FRAMES):
        c0 = time.process_time()
        luma = renderer.luma(first_ns + k * period_ns)
        c1 = time.process_time()
        n_bytes += sum(len(p.data) for p in encoder.encode(k, luma, renderer.chroma_u, renderer.chroma_v))
        rendering, encoding = rendering + c1 - c0, encoding + time.process_time() - c1
    mbps = n_bytes * 8 / (N_COST_FRAMES * period_ns * 1e-9) / 1e6
    return rendering / N_COST_FRAMES * 1e3, encoding / N_COST_FRAMES * 1e3, mbps


def write_png(path: Path, luma: np.ndarray) -> None:
    """Write a luma plane as a grey picture, limited range spread to full."""
    grey = np.clip((luma.astype(np.float64) - 16) * 255 / 219, 0, 255).astype(np.uint8)
    with av.open(str(path), "w", format="image2") as container:
        stream = container.add_stream(
            "png", rate=1, width=grey.shape[1], height=grey.shape[0], pix_fmt="gray"
        )
        for packet in [*stream.encode(VideoFrame.from_ndarray(grey, format="gray")), *stream.encode(None)]:
            container.mux(packet)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--picture", type=Path, help="write a frame of the shake here, as PNG")
    arguments = parser.parse_args()
    camera = CameraTable()
    settings = SimSettings()

    world = SimWorld(settings, make_epoch())
    world.schedule(0)
    first_ns = world.first_edge_ns or 0
    print(
        f"{os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}; exposure {camera.exposure_us} us (simulated)"
    )
    for name, start_s in (("at rest", 0.1), ("shaking", 5.0)):
        render, encode, mbps = cost_ms(world, first_ns + round(start_s * 1e9), camera)
        print(f"{name}: render {render:.1f} + encode {encode:.1f} ms CPU a frame of 33.3; {mbps:.1f} Mbit/s")

    live = SimWorld(settings, make_epoch())
    sink = CountingSink()
    sim = SimCamera(live, camera)
    live.schedule(monotonic_ns())
    sim.start(sink)
    c0, t0 = time.process_time(), time.monotonic()
    time.sleep(arguments.seconds)
    cpu, wall = time.process_time() - c0, time.monotonic() - t0
    sim.stop()
    print(
        f"live, {wall:.1f} s: {len(sink.packets) / wall:.2f} frames/s of 30.01, {sim.frames_dropped} dropped, "
        f"{cpu / wall:.2f} CPUs busy, packets {np.median(sink.late_ms):.0f} ms after their stamps "
        f"(largest {np.max(sink.late_ms):.0f})"
    )
    if arguments.picture:
        renderer = LedRenderer(
            settings, world, lens=lens_of(settings.seed), mode=IMX219_1080P,
            exposure_ns=camera.exposure_us * 1000,
        )  # fmt: skip
        write_png(arguments.picture, renderer.luma(first_ns + 5_000_000_000))


if __name__ == "__main__":
    main()
