"""A recording (simulated) whose camera is shaken too: pictures through the encoder, two chips, edges, truth.

Made by the simulator's own world, renderer, encoder and sensors, as fast as the machine can; imported as any
recording is. The sensor on the camera's component can be in the unit's own run, or in that of another unit with
another clock; the laboratory's table of the same acceleration can be written too.
"""

import csv
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bricktrack_common.arrays import IntArray
from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.rotations import continuous_quaternions, quaternion_from_matrix
from bricktrack_device.config import CameraTable
from bricktrack_device.sim.imu_signal import ImuSensors, SensorSetup
from bricktrack_device.sim.led_renderer import LedRenderer
from bricktrack_device.sim.lens import lens_of
from bricktrack_device.sim.settings import SimImu, SimSettings
from bricktrack_device.sim.sim_camera import LINES_A_FRAME
from bricktrack_device.sim.sim_kit import write_sim_kit
from bricktrack_device.sim.video_encoder import VideoEncoder
from bricktrack_device.sim.world import SimWorld, make_epoch
from bricktrack_host.cli import calibrate
from bricktrack_host.recordings.import_recording import Recording, import_recording
from bricktrack_host.recordings.loose_files import LooseRig

_ARMED_NS = 1_000_000_000_000
_SETUP = SensorSetup(acc_range_g=16.0, acc_bandwidth_hz=62.5, gyro_range_dps=2000.0, gyro_bandwidth_hz=32.0)
_MODE = IMX219_1080P
OTHER_OFFSET_NS, OTHER_RATE = 777_000_000_000, 1 + 45e-6
"""The other unit's clock less this one's, and how fast it goes."""


@dataclass(frozen=True, slots=True)
class ShakenPair:
    """Where everything is: two run folders, what belongs to the unit, and the truth."""

    folder: Path
    run: Path
    other_run: Path
    calibration: Path
    layout: Path
    truth: Path
    table: Path
    to_camera_mm: tuple[float, float, float]
    rig: LooseRig


def make_shaken_pair(
    folder: Path, *, seed: int = 4, acc_g: float = 0.3, rocking_deg: float = 1.0, shake_s: float = 3.0
) -> ShakenPair:
    """Record, calibrate and import; the camera's card hides the brick for 0.3 s in the middle."""
    settings = SimSettings(
        seed=seed, motion="sines", quiet_s=0.6, shake_s=shake_s, camera_acc_g=acc_g,
        camera_rocking_deg=rocking_deg, dropouts=[(0.6 + 0.5 * shake_s, 0.3)], imu=SimImu(clock_ppm=0.0),
    )  # fmt: skip
    world = SimWorld(settings, make_epoch())
    first_ns = world.schedule(_ARMED_NS)
    end_ns = first_ns + round((settings.quiet_s + shake_s + 0.4) * 1e9)
    kit = folder / "kit"
    write_sim_kit(kit, settings)
    calibrate.fit(folder / "calibration.json", "b7-2", rig=kit / "rig.toml")
    camera = CameraTable()
    exposure_ns = 1000 * round(
        round(camera.exposure_us * 1e3 / _MODE.line_time_ns) * _MODE.line_time_ns / 1e3
    )
    stamps = _film(folder, settings, world, camera, exposure_ns, first_ns, end_ns)
    t_ns = np.arange(first_ns - 200_000_000, end_ns + 200_000_000, 10_000_000)
    for name, stream in (("brick", 1), ("camera", 2)):
        _write_imu(folder / f"{name}.csv", ImuSensors(world, on_camera=name == "camera", stream=stream), t_ns)
    edges = world.edge_times_ns(0, round((end_ns - first_ns) / 5e6))
    _write_edges(folder / "edges.csv", edges)
    rig = LooseRig(_MODE, exposure_ns // 1000, int(stamps[0]), simulated=True, square_wave_hz=200.0)
    shared = {"rig": rig, "label": "shake-12", "simulated": True, "video": folder / "video.h264"}
    files = {"timestamps": folder / "stamps.txt", "edges": folder / "edges.csv"}
    run = import_recording(
        Recording(
            **shared, **files, unit="b7-2",
            imus={"brick": folder / "brick.csv", "camera": folder / "camera.csv"},
        ),
        folder / "runs",
    )  # fmt: skip

    _restamp(folder / "camera.csv", folder / "other_imu.csv", first_ns)
    _restamp(folder / "edges.csv", folder / "other_edges.csv", first_ns)
    other = import_recording(
        Recording(
            **shared, unit="b7-1", timestamps=folder / "stamps.txt", edges=folder / "other_edges.csv",
            imus={"brick": folder / "other_imu.csv"},
        ),
        folder / "runs",
    )  # fmt: skip
    _write_table(folder / "table.csv", world, edges)
    dense = np.arange(first_ns, end_ns, 1_000_000)
    _write_truth(folder / "truth.npz", world, dense)
    arm = settings.imu.on_camera_mm
    return ShakenPair(
        folder, run.folder, other.folder, folder / "calibration.json", kit / "layout.toml", folder / "truth.npz",
        folder / "table.csv", (-arm[0], -arm[1], -arm[2]), rig,
    )  # fmt: skip


def _film(
    folder: Path,
    settings: SimSettings,
    world: SimWorld,
    camera: CameraTable,
    exposure_ns: int,
    first_ns: int,
    end_ns: int,
) -> IntArray:
    """Write the video and the stamps of its pictures, us since the first; return the stamps, ns."""
    period_us = LINES_A_FRAME * _MODE.line_time_ns / 1e3
    n = int((end_ns - first_ns) / 1e3 / period_us)
    pts_us = np.rint(np.arange(n) * period_us).astype(np.int64)
    stamps = first_ns + 1000 * pts_us
    renderer = LedRenderer(settings, world, lens=lens_of(settings.seed), mode=_MODE, exposure_ns=exposure_ns)
    encoder = VideoEncoder(camera, _MODE.width, _MODE.height)
    with (folder / "video.h264").open("wb") as video:
        for pts, stamp in zip(pts_us.tolist(), stamps.tolist(), strict=True):
            luma = renderer.luma(stamp)
            for packet in encoder.encode(pts, luma, renderer.chroma_u, renderer.chroma_v):
                video.write(packet.data)
    (folder / "stamps.txt").write_text("".join(f"{pts}\n" for pts in pts_us.tolist()))
    return stamps


def _write_imu(path: Path, sensors: ImuSensors, t_ns: IntArray) -> None:
    names = ["t_ns", "ax_mps2", "ay_mps2", "az_mps2", "gx_dps", "gy_dps", "gz_dps"]
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        for t in t_ns.tolist():
            m = sensors.measure(t, _SETUP)
            acc, gyro = np.round(m.acc_mps2 / 0.01) * 0.01, np.round(m.gyro_dps * 16) / 16
            writer.writerow([t, *(f"{x:.2f}" for x in acc), *(f"{x:.4f}" for x in gyro)])


def by_other_clock(t_ns: int, first_ns: int) -> int:
    """Return an instant by the other unit's clock."""
    return t_ns + OTHER_OFFSET_NS + round((OTHER_RATE - 1) * (t_ns - first_ns))


def _restamp(source: Path, target: Path, first_ns: int, *, leave_out: int = 0) -> None:
    """Copy a file of instants by the other unit's clock, without its first rows."""
    head, *rows = source.read_text().splitlines()
    moved = []
    for row in rows[leave_out:]:
        t, comma, rest = row.partition(",")
        moved.append(f"{by_other_clock(int(t), first_ns)}{comma}{rest}")
    target.write_text("\n".join([head, *moved]) + "\n")


def import_twin(pair: ShakenPair, *, missed_edges: int) -> Path:
    """Import the same pictures and chips as unit b7-3 saw them: by its own clock, without the first edges."""
    folder = pair.folder
    first_ns = int((folder / "edges.csv").read_text().splitlines()[1])
    for name in ("brick", "camera"):
        _restamp(folder / f"{name}.csv", folder / f"twin_{name}.csv", first_ns)
    _restamp(folder / "edges.csv", folder / "twin_edges.csv", first_ns, leave_out=missed_edges)
    stamp = by_other_clock(pair.rig.first_sensor_timestamp_ns, first_ns)
    rig = replace(pair.rig, first_sensor_timestamp_ns=stamp)
    imus = {name: folder / f"twin_{name}.csv" for name in ("brick", "camera")}
    return import_recording(
        Recording(
            rig=rig, label="shake-12", simulated=True, video=folder / "video.h264", unit="b7-3", imus=imus,
            timestamps=folder / "stamps.txt", edges=folder / "twin_edges.csv",
        ),
        folder / "runs",
    ).folder  # fmt: skip


def _write_edges(path: Path, edges_ns: IntArray) -> None:
    path.write_text("t_ns\n" + "".join(f"{t}\n" for t in edges_ns.tolist()))


def _write_table(path: Path, world: SimWorld, edges_ns: IntArray) -> None:
    """Write what the laboratory's accelerometers say at each edge: zeroed before the shake, in g, from 1 on."""
    felt = world.camera_inertial(world.since_first_edge_s(edges_ns), at_mm=np.zeros(3)).specific_force_mps2
    g = (felt - felt[0]) / 9.80665 + np.random.default_rng(3).normal(0, 5e-4, felt.shape)
    rows = [f"{i + 1},{x:.6f},{y:.6f},{z:.6f}" for i, (x, y, z) in enumerate(g.tolist())]
    path.write_text("\n".join(["Sample,AX,AY,AZ", *rows]) + "\n")


def _write_truth(path: Path, world: SimWorld, t_ns: IntArray) -> None:
    R, t_mm = world.pose(t_ns)
    omega, v = world.twist(t_ns)
    np.savez(
        path, t_ns=t_ns, q_wxyz_camera_brick=continuous_quaternions(quaternion_from_matrix(R)),
        t_camera_brick_mm=t_mm, omega_brick_radps=omega, v_camera_mmps=v,
    )  # fmt: skip
