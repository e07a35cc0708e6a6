"""What the daemon costs: memory with the ring full, and the time from a recording's end to the saved run.

The unit is the real daemon and recorder with a camera that only hands out bytes at the rate of a real encoder
(12 Mbit/s unless told otherwise), so that memory and time are the daemon's own and not the simulation's.
Inertial samplers are processes of their own: theirs is on a table of registers. Nothing here is a Pi: the card
is this machine's disk. With --black-box it is measured once without and once with the copy of the run in memory that
outlives a daemon that is killed.
"""

import argparse
import queue
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from device_fakes import FakeBusOpener, FakeCamera, FakeRig

from bricktrack_common.run_folder import read_run
from bricktrack_common.wire_messages import Armed, Reply
from bricktrack_device.capture.recorder import Recorder
from bricktrack_device.config import (
    CameraTable,
    DeviceConfig,
    ImuTable,
    RecordingTable,
    SamplerTable,
    StorageTable,
)
from bricktrack_device.storage.run_store import RunStore

MB = 1e6
FRAME_PERIOD_S = 0.033327


def memory_mb(key: str, process: str = "self") -> float:
    """Return a figure of /proc/<process>/status, as VmRSS or VmHWM, in MB."""
    for line in Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines():
        if line.startswith(f"{key}:"):
            return int(line.split()[1]) * 1024 / MB
    raise OSError(f"/proc/{process}/status has no {key}")


def children() -> list[str]:
    me = Path("/proc/self/task")
    return [pid for task in me.iterdir() for pid in (task / "children").read_text().split()]


def wait_for(recorder: Recorder, state: str) -> None:
    while recorder.state != state:
        if recorder.state == "fault":
            raise SystemExit(f"the unit went to fault: {recorder.status().reason}")
        time.sleep(0.02)


def measure(storage: Path, *, duration_s: float, bitrate_bps: int, black_box: str) -> None:
    config = DeviceConfig(
        storage=StorageTable(folder=str(storage), margin_mb=1, black_box=black_box),
        camera=CameraTable(bitrate_bps=bitrate_bps),
        recording=RecordingTable(duration_s=duration_s),
        imu=[ImuTable(name="brick", bus="a")],
        sampler=SamplerTable(priority=0, lock_memory=False),
    )
    camera = FakeCamera(iperiod=12, n_bytes=round(bitrate_bps / 8 * FRAME_PERIOD_S))
    rig = FakeRig(camera=camera, buses={"a": FakeBusOpener()})
    idle_mb = memory_mb("VmRSS")
    recorder = Recorder(config, rig, RunStore(config.storage_folder, config.unit.name))
    recorder.start()
    answers: queue.Queue[Reply] = queue.Queue()
    began = time.perf_counter()
    recorder.arm("bench", None, answers.put)
    armed = answers.get(timeout=60)
    if not isinstance(armed, Armed):
        raise SystemExit(f"the unit does not arm: {armed}")
    arming_s = time.perf_counter() - began
    # Until the ring is as full as it gets while the unit waits for its trigger.
    time.sleep(config.span_s() + 6.0)
    waiting_mb = memory_mb("VmRSS")
    sampler_mb = [memory_mb("VmRSS", pid) for pid in children()]
    rig.pulse(3)
    wait_for(recorder, "recording")
    used_s = time.process_time()
    wait_for(recorder, "saving")
    used_s = time.process_time() - used_s
    began = time.perf_counter()
    wait_for(recorder, "idle")
    saving_s = time.perf_counter() - began
    recorder.stop()
    run = read_run(config.storage_folder / "runs" / armed.run_id, verify_hashes=True)
    if run.manifest.state != "complete" or run.frames is None:
        raise SystemExit(f"the run is not complete: {run.problems}")
    video = run.manifest.file("video.h264")
    if video is None:
        raise SystemExit("the run has no video")
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / MB
    copied = "with a copy in memory" if black_box else "without a copy in memory"
    print(
        f"a run of {duration_s:g} s at {bitrate_bps / 1e6:g} Mbit/s, {copied}: {video.n_bytes / MB:.1f} MB of video"
    )
    print(f"  arming, until every sensor delivers   {arming_s:8.2f} s")
    print(f"  daemon, before arming                 {idle_mb:8.1f} MB")
    print(f"  daemon, armed with the ring full      {waiting_mb:8.1f} MB")
    print(
        f"  daemon, peak over the whole run       {peak_mb:8.1f} MB  ({(peak_mb - idle_mb) / video.n_bytes * MB:.2f} x the video above idle)"
    )
    print(f"  sampler and its helper processes      {' + '.join(f'{m:.1f}' for m in sampler_mb)} MB")
    print(
        f"  processor, while it recorded          {used_s:8.2f} s  ({100 * used_s / duration_s:.1f} % of a core)"
    )
    print(f"  end of the recording to saved run     {saving_s:8.2f} s  (stop, write, hash, fsync, rename)")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--duration", type=float, default=15.0, help="s of recording (default 15)")
    parser.add_argument("--bitrate", type=int, default=12_000_000, help="bit/s (default 12 million)")
    parser.add_argument("--black-box", action="store_true", help="measure with the copy in memory too")
    parser.add_argument("--inside", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.inside is not None:
        with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory(dir="/dev/shm") as memory:
            measure(
                Path(folder),
                duration_s=arguments.duration,
                bitrate_bps=arguments.bitrate,
                black_box=memory if arguments.inside == "copy" else "",
            )
        return 0
    # A process of its own: peak memory is of its whole life.
    command = [
        sys.executable,
        __file__,
        "--duration",
        str(arguments.duration),
        "--bitrate",
        str(arguments.bitrate),
    ]
    for how in ("plain", "copy") if arguments.black_box else ("plain",):
        if code := subprocess.run([*command, "--inside", how], check=False).returncode:
            return code
    return 0


if __name__ == "__main__":
    sys.exit(main())
