"""Many consecutive short runs in one process: every one verified, memory and file descriptors flat.

``BRICKTRACK_RUNS`` says how many; 20 by default.
"""

import gc
import os
import queue
import threading
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest
from device_fakes import FakeBusOpener, FakeCamera, FakeRig
from light_unit import light_config

from bricktrack_common.imu_records import ImuFlag
from bricktrack_common.run_folder import read_run
from bricktrack_common.wire_messages import Armed, Reply
from bricktrack_device.capture.recorder import Recorder
from bricktrack_device.config import RecordingTable, TriggerTable
from bricktrack_device.storage.run_store import RunStore

RUNS = int(os.environ.get("BRICKTRACK_RUNS", "20"))
WARM_UP = 5
"""Runs until imports, caches and the allocator's arenas have settled."""

pytestmark = pytest.mark.slow


def n_descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def settled_descriptors(baseline: int | None) -> int:
    """Return how many are open, once the recorder's thread has let go of the run before (at most 2 s)."""
    deadline = time.monotonic() + 2
    while baseline is not None and n_descriptors() > baseline and time.monotonic() < deadline:
        gc.collect()
        time.sleep(0.005)
    return n_descriptors()


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def shared_memory_held() -> bool:
    """Tell whether this process still maps a sampler's buffer."""
    return "/dev/shm/psm_" in Path("/proc/self/maps").read_text()


def test_many_short_runs_leave_nothing_behind(tmp_path: Path) -> None:
    config = msgspec.structs.replace(
        light_config(tmp_path),
        trigger=TriggerTable(),
        recording=RecordingTable(duration_s=0.1, pre_roll_s=0.05, post_roll_s=0.05),
    )
    rig = FakeRig(camera=FakeCamera(n_bytes=50_000), buses={"a": FakeBusOpener()})
    store = RunStore(config.storage_folder, config.unit.name)
    recorder = Recorder(config, rig, store)
    recorder.start()
    memory, descriptors, threads = [], [], []
    try:
        for n in range(RUNS):
            answers: queue.Queue[Reply] = queue.Queue()
            recorder.arm(f"r{n}", None, answers.put)
            armed = answers.get(timeout=60)
            assert isinstance(armed, Armed), armed
            rig.pulse(2, half_period_s=0.002)
            deadline = time.monotonic() + 30
            while recorder.state != "idle":
                assert recorder.state != "fault" and time.monotonic() < deadline, recorder.status()
                time.sleep(0.002)
            run = read_run(store.runs / armed.run_id, verify_hashes=True)
            assert run.manifest.state == "complete" and run.problems == [], run.problems
            assert run.frames is not None and run.frames.n_frames >= 5 and run.edges_ns.size == 2
            # A machine that holds the sampler off costs samples; each of them must be counted as a gap.
            quality = run.manifest.quality
            present = np.count_nonzero(run.imus["brick"][1].flags & ImuFlag.GAP == 0)
            assert quality.imu_slots >= 19 and quality.imu_gaps == quality.imu_slots - present, quality
            assert present
            gc.collect()
            memory.append(resident_bytes())
            descriptors.append(settled_descriptors(min(descriptors[WARM_UP:], default=None)))
            threads.append(threading.active_count())
    finally:
        recorder.stop()
    settled = slice(min(WARM_UP, RUNS - 1), None)
    mb = np.array(memory[settled]) / 1e6
    growth_mb = float(np.polyfit(np.arange(len(mb)), mb, 1)[0]) if len(mb) > 2 else 0.0
    print(
        f"\n{store.count_runs()} runs: memory {mb[0]:.1f} -> {mb[-1]:.1f} MB ({growth_mb * 1e3:+.2f} kB a run), "
        f"{min(descriptors[settled])} to {max(descriptors[settled])} descriptors, {max(threads[settled])} threads"
    )
    assert store.count_runs() == RUNS
    assert max(descriptors[settled]) == min(descriptors[settled]), descriptors
    assert max(threads[settled]) == min(threads[settled]), threads
    # A leak of one run's video would show as 0.35 MB a run.
    assert growth_mb < 0.02 + 4.0 / len(mb), f"{growth_mb * 1e3:.1f} kB a run"
    assert not shared_memory_held()
