"""A simulated recording of any length, made in seconds: the film of a short one, shown again and again.

The brick rests where it stood when the short recording begins and when it ends, so its motion can be repeated
without a jump: its film is copied behind itself, whole groups of pictures long. The inertial samples and the
square wave are simulated anew over the whole length, on clocks that run through: only the noise of the
pictures comes again.

So such a recording tells what processing it takes in time and memory, and not how well it is measured. Noise
that comes again never averages out, though it is believed to: over ten minutes and more the fused motion errs by
far more than its sd, and lies beside the motion pose by pose, by which `process` warns. In a simulated run of 600 s
and seven LEDs, whose motion comes again every 15 s, squared errors over their covariance by their degrees of
freedom (NEES/6) were 19 on the median where the centroids' noise came again too, all instants beyond their 95 %
region; and 0.8, 99 % within it, where the noise was new each time and all else the same.

Not all of it is the repetition's: where neither noise nor motion came again, four simulated runs had 0.8 to 1.4 on
the median in 60 s and 0.9 to 2.7 in 300 s (errors of a few micrometres that stand still, believed ever surer).
"""

import shutil
import sys
from pathlib import Path

import msgspec
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from daemon_runs import imu_description, read_chip
from recording_to_time import simulated_recording

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.frame_times import FrameRecord, FrameTimes, write_frames
from bricktrack_common.imu_records import write_imu
from bricktrack_common.run_folder import Run, read_run, write_edges
from bricktrack_common.run_manifest import (
    EDGES_NAME,
    FRAMES_NAME,
    MANIFEST_NAME,
    TRUTH_NAME,
    VIDEO_NAME,
    QualitySection,
    TriggerSection,
    file_entry,
    write_manifest,
)
from bricktrack_device.sim.settings import SimSettings
from bricktrack_device.sim.world import SimWorld

_REST_S = 0.2
"""Of rest at both ends of what is repeated."""


class _Epoch:
    """The first edge where no other process needs to be told of it."""

    def __init__(self, t_ns: int) -> None:
        self.value = t_ns


class _RepeatedWorld(SimWorld):
    """The world of a recording whose motion begins anew with each period."""

    def __init__(self, settings: SimSettings, first_edge_ns: int, start_ns: int, period_ns: float) -> None:
        super().__init__(settings, _Epoch(first_edge_ns))  # type: ignore[arg-type]
        self._start_ns, self._period_ns = start_ns, period_ns

    def since_first_edge_s(self, t_ns: IntArray) -> FloatArray:
        """Return seconds after the first edge, in the period that is repeated."""
        ahead_s = (self._start_ns - self._epoch.value) * 1e-9
        since_s = super().since_first_edge_s(t_ns) - ahead_s
        return np.asarray(np.where(since_s < 0, since_s, since_s % (self._period_ns * 1e-9)) + ahead_s)


def long_recording(folder: Path, duration_s: float) -> tuple[Path, Path, Path]:
    """Return run folder, calibration and layout of a recording of about this length, made in ``folder``."""
    short_folder, calibration, layout = simulated_recording()
    short = read_run(short_folder)
    if short.frames is None or short.video is None or short.manifest.window_ns is None:
        raise SystemExit(f"{short_folder}: no whole recording")
    frames = short.frames
    n = int(np.flatnonzero(frames.keyframe)[-1])  # prediction begins anew with the copy's first picture
    stamps = frames.sensor_timestamp_ns
    period_ns = n * float(np.median(np.diff(stamps)))
    n_frames = max(round(duration_s * 1e9 / float(np.median(np.diff(stamps)))), n)
    world = _world(short, int(stamps[0]), period_ns)
    _require_rest(world, int(stamps[0]), period_ns)
    run = folder / short_folder.name
    run.mkdir(parents=True)
    with (run / FRAMES_NAME).open("wb") as file:
        write_frames(file, _frames(frames, n, n_frames, period_ns))
    _write_video(run / VIDEO_NAME, short.video, frames, n, n_frames)
    end_ns = round(stamps[0] + n_frames / n * period_ns)
    _write_streams(run, short, world, end_ns)
    return run, calibration, layout


def _world(short: Run, start_ns: int, period_ns: float) -> _RepeatedWorld:
    with np.load(short.folder / TRUTH_NAME) as truth:
        settings = msgspec.json.decode(str(truth["settings_json"]), type=SimSettings)
    first_edge_ns = short.manifest.trigger.t0_ns
    if first_edge_ns is None:
        raise SystemExit(f"{short.folder}: no first edge")
    return _RepeatedWorld(settings, first_edge_ns, start_ns, period_ns)


def _require_rest(world: SimWorld, start_ns: int, period_ns: float) -> None:
    """Refuse a motion that would jump where it is repeated."""
    at_ns = start_ns + np.array([0, _REST_S * 1e9, period_ns - _REST_S * 1e9, period_ns - 1]).astype(np.int64)
    if np.ptp(world.pose(at_ns)[1], axis=0).max() > 1e-6:
        raise SystemExit("the short recording does not begin and end at rest in one place")


def _frames(short: FrameTimes, n: int, n_frames: int, period_ns: float) -> list[FrameRecord]:
    n_bytes = short.n_bytes[np.arange(n_frames) % n]
    offset = np.concatenate([[0], np.cumsum(n_bytes)[:-1]])
    records = []
    for i in range(n_frames):
        times, k = divmod(i, n)
        records.append(
            FrameRecord(
                pts_us=int(short.pts_us[k]) + round(times * period_ns / 1000),
                sensor_timestamp_ns=int(short.sensor_timestamp_ns[k]) + round(times * period_ns),
                exposure_us=int(short.exposure_us[k]),
                analogue_gain=float(short.analogue_gain[k]),
                keyframe=bool(short.keyframe[k]),
                byte_offset=int(offset[i]),
                n_bytes=int(n_bytes[i]),
                flags=int(short.flags[k]),
            )
        )
    return records


def _write_video(path: Path, short_video: Path, short: FrameTimes, n: int, n_frames: int) -> None:
    film = short_video.read_bytes()
    with path.open("wb") as file:
        times, k = divmod(n_frames, n)
        for _ in range(times):
            file.write(memoryview(film)[: short.byte_offset[n]])
        file.write(memoryview(film)[: short.byte_offset[k]])


def _write_streams(run: Path, short: Run, world: SimWorld, end_ns: int) -> None:
    """Write samples, edges and manifest of what lasts from the short recording's beginning to an instant."""
    manifest, first_edge_ns = short.manifest, int(short.manifest.trigger.t0_ns or 0)
    rng = np.random.default_rng([world.settings.seed, 90])
    described = imu_description(manifest.imus[0].t0_ns)
    n_slots = (end_ns - described.t0_ns) // described.period_ns
    records = read_chip(world, described, rng, n_slots, on_ns=described.t0_ns - 2_000_000_000)
    with (run / f"imu_{described.name}.msgpack").open("wb") as file:
        write_imu(file, described, records)
    n_edges = int((end_ns - first_edge_ns) * 1e-9 * world.settings.square_wave_hz)
    jitter_ns = rng.normal(0, 1e3 * world.settings.edge_jitter_us, n_edges)
    edges_ns = world.edge_times_ns(0, n_edges) + np.rint(jitter_ns).astype(np.int64)
    edges_ns[0] = first_edge_ns
    with (run / EDGES_NAME).open("wb") as file:
        write_edges(file, edges_ns)
    shutil.copy(short.folder / "log.jsonl", run)
    names = [path.name for path in sorted(run.iterdir())]
    told = msgspec.structs.replace(
        manifest, imus=[described], files=[file_entry(run / name) for name in names],
        trigger=TriggerSection(
            pin=manifest.trigger.pin, t0_ns=first_edge_ns, nominal_hz=manifest.trigger.nominal_hz
        ),
        window_ns=((manifest.window_ns or (first_edge_ns, 0))[0], end_ns), quality=QualitySection(),
    )  # fmt: skip
    write_manifest(run / MANIFEST_NAME, told)
