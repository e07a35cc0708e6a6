"""Make what a test day of one cracked brick leaves behind: three recordings (simulated), and what they need.

    python scripts/simulate_assembly.py FOLDER

A brick in three parts. B slides and rocks on A, C on B; unit b7-1 sees B from A, b7-2 sees C from B, and b7-3 sees
C from A, which closes a loop. Pictures, inertial samples and edges are those of the simulated unit's world, made as
fast as the machine can and not in real time; every camera stands still, as only the motion of one part against
the other counts. FOLDER then holds ``fleet.toml``, the units' calibrations, the layout, ``runs/`` and, to compare
with, ``truth.csv``: the motion of B's and C's middle against A, from rest, in brick axes.
"""

import argparse
import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from rich.progress import track

from bricktrack_common.arrays import FloatArray
from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.poses import Pose
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix
from bricktrack_common.run_manifest import MANIFEST_NAME, WaveSection, write_manifest
from bricktrack_device.config import CameraTable
from bricktrack_device.sim.led_renderer import LedRenderer
from bricktrack_device.sim.lens import lens_of
from bricktrack_device.sim.settings import SimSettings
from bricktrack_device.sim.sim_kit import write_sim_kit
from bricktrack_device.sim.video_encoder import VideoEncoder
from bricktrack_device.sim.world import SimWorld, make_epoch
from bricktrack_host.calibration.calibration_file import load_calibration, save_calibration
from bricktrack_host.cli import calibrate
from bricktrack_host.recordings.import_recording import Recording, import_recording
from bricktrack_host.recordings.loose_files import LooseRig

LABEL = "shake-12"
SHAKE_S, REST_S, AFTER_S = 2.4, 0.4, 0.4
WAVE_HZ = 50.0
N_QUIET = 8  # periods that the wave stops before the recordings end
FRAME_HZ = 20.0
EXPOSURE_NS = 2_000_000
IMU_HZ = 100.0
GYRO_NOISE_RADPS, ACC_NOISE_MPS2 = 0.002, 0.02
TURNED = ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0))  # about y, by half a turn
AS_DRAWN = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
POINTS_MM = {"B": (25.0, 25.0, 60.0), "C": (25.0, 25.0, 120.0)}

Motion = Callable[[FloatArray], Pose]


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit: what it sees, in brick axes, and where its layout sits in the whole brick."""

    name: str
    motion: Motion
    position_mm: tuple[float, float, float]
    rotation: tuple[tuple[float, float, float], ...]
    clock_ppm: float
    boot_ns: int

    @property
    def pose_brick_layout(self) -> Pose:
        """Where the layout's frame stands in the whole brick."""
        return Pose(np.array(self.rotation), np.array(self.position_mm))


def shaking(t_s: FloatArray, mm: FloatArray, deg: FloatArray, hz: FloatArray) -> Pose:
    """Return sines of three displacements and three rotations, which grow and fade within the shake."""
    grown = np.sin(np.pi * np.clip(t_s / SHAKE_S, 0.0, 1.0)) ** 2
    waves = grown[:, None] * np.sin(2 * np.pi * t_s[:, None] * hz)
    return Pose(matrix_from_rvec(np.deg2rad(deg) * waves[:, 3:]), mm * waves[:, :3])


def b_on_a(t_s: FloatArray) -> Pose:
    return shaking(
        t_s, np.array([3.0, 0.4, 0.8]), np.array([0.4, 1.0, 0.3]), np.array([3.0, 2.0, 4.0, 3.5, 3.0, 2.5])
    )


def c_on_b(t_s: FloatArray) -> Pose:
    return shaking(
        t_s, np.array([-2.0, 0.3, 0.6]), np.array([0.3, -1.4, 0.5]), np.array([4.0, 3.0, 5.0, 2.5, 4.0, 3.0])
    )


def c_on_a(t_s: FloatArray) -> Pose:
    return b_on_a(t_s) @ c_on_b(t_s)


UNITS = (
    Unit("b7-1", b_on_a, (0.0, 0.0, 40.0), AS_DRAWN, 20.0, 3_000_000_000_000),
    Unit("b7-2", c_on_b, (50.0, 0.0, 100.0), TURNED, -12.0, 5_000_000_000_000),
    Unit("b7-3", c_on_a, (0.0, 0.0, 100.0), AS_DRAWN, 5.0, 4_000_000_000_000),
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    if folder.exists() and any(folder.iterdir()):
        parser.error(f"{folder} is not empty; name another folder")
    kit = folder / "kit"
    write_sim_kit(kit, SimSettings())
    for i, unit in enumerate(UNITS):
        if i == 0:
            calibrate.fit(folder / f"{unit.name}.json", unit.name, rig=kit / "rig.toml", report=False)
        else:  # their simulated lenses are the same
            made = load_calibration(folder / f"{UNITS[0].name}.json")
            save_calibration(folder / f"{unit.name}.json", msgspec.structs.replace(made, unit=unit.name))
        record(unit, folder / "loose" / unit.name, folder / "runs", seed=i + 1)
    write_truth(folder / "truth.csv")
    (folder / "fleet.toml").write_text(fleet_text(), encoding="utf-8")
    print(f"{folder} (simulated): fleet.toml, {len(UNITS)} calibrations, kit, runs, truth.csv")


def record(unit: Unit, loose: Path, runs: Path, *, seed: int) -> None:
    """Film one unit's view into loose files, and bring them into a run folder."""
    loose.mkdir(parents=True)
    world = make_world(unit, loose / "motion.csv")
    # The unit's clock runs at its own rate; the wave is the laboratory's.
    period_ns = 1e9 / WAVE_HZ * (1 + 1e-6 * unit.clock_ppm)
    first_ns = world.schedule(unit.boot_ns)
    end_ns = first_ns + round((REST_S + SHAKE_S + AFTER_S) * 1e9)
    edges_ns = first_ns + np.rint(np.arange(round((end_ns - first_ns) / period_ns) - N_QUIET) * period_ns)
    stamps_ns = np.arange(first_ns - 200_000_000, end_ns, round(1e9 / FRAME_HZ / 1000) * 1000)
    write_video(unit, world, stamps_ns, loose)
    write_column(loose / "edges.csv", "t_ns", edges_ns.astype(np.int64))
    write_imu(world, np.arange(first_ns - 200_000_000, end_ns, round(1e9 / IMU_HZ)), loose / "imu.csv", seed)
    made = import_recording(
        Recording(
            video=loose / "video.h264",
            timestamps=loose / "pts_us.txt",
            rig=LooseRig(
                IMX219_1080P, EXPOSURE_NS // 1000, int(stamps_ns[0]), simulated=True, square_wave_hz=WAVE_HZ
            ),
            unit=unit.name,
            label=LABEL,
            simulated=True,
            imus={"brick": loose / "imu.csv"},
            edges=loose / "edges.csv",
        ),
        runs,
    )
    # A unit also notes that it listened on after the wave had stopped; loose files cannot say so.
    wave = WaveSection(
        hz=1e9 / period_ns,
        last_edge_ns=int(edges_ns[-1]),
        n_after_last=int((end_ns - edges_ns[-1]) / period_ns),
    )
    manifest = made.manifest
    trigger = msgspec.structs.replace(manifest.trigger, wave=wave)
    write_manifest(made.folder / MANIFEST_NAME, msgspec.structs.replace(manifest, trigger=trigger))


def make_world(unit: Unit, motion_csv: Path) -> SimWorld:
    """Return a world whose brick moves before the camera as the unit's component does."""
    t_s = np.arange(0.0, SHAKE_S + 0.5, 0.005)
    X = unit.pose_brick_layout
    moved = X.inverse() @ unit.motion(t_s - 0.25) @ X  # at rest where the simulator fades in and out
    rest = SimWorld(SimSettings(), make_epoch()).rest_pose[0]
    columns = np.column_stack([t_s, moved.t_mm @ rest.T, np.rad2deg(rvec_from_matrix(moved.R))])
    np.savetxt(
        motion_csv, columns, delimiter=",", comments="", header="t_s,x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg"
    )
    settings = SimSettings(
        motion="csv", motion_csv=str(motion_csv), quiet_s=REST_S - 0.25, square_wave_hz=WAVE_HZ
    )
    return SimWorld(settings, make_epoch())


def write_video(unit: Unit, world: SimWorld, stamps_ns: np.ndarray, loose: Path) -> None:
    camera = CameraTable(frame_rate_hz=FRAME_HZ)
    renderer = LedRenderer(
        world.settings, world, lens=lens_of(world.settings.seed), mode=IMX219_1080P, exposure_ns=EXPOSURE_NS
    )
    encoder = VideoEncoder(camera, IMX219_1080P.width, IMX219_1080P.height)
    with (loose / "video.h264").open("wb") as video:
        for stamp in track(stamps_ns.tolist(), f"film {unit.name} (simulated)"):
            luma = renderer.luma(stamp)
            for packet in encoder.encode(stamp // 1000, luma, renderer.chroma_u, renderer.chroma_v):
                video.write(packet.data)
    write_column(loose / "pts_us.txt", "", (stamps_ns - stamps_ns[0]) // 1000)


def write_imu(world: SimWorld, t_ns: np.ndarray, path: Path, seed: int) -> None:
    """Write what a sensor with noise and no delay says."""
    draw = np.random.default_rng([seed, 12])
    since_s = world.since_first_edge_s(t_ns)
    felt = world.inertial(since_s)
    acc = felt.specific_force_mps2 + ACC_NOISE_MPS2 * draw.standard_normal((len(t_ns), 3))
    gyro = felt.omega_radps + GYRO_NOISE_RADPS * draw.standard_normal((len(t_ns), 3))
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["t_ns", "ax_mps2", "ay_mps2", "az_mps2", "gx_dps", "gy_dps", "gz_dps"])
        for t, a, g in zip(t_ns.tolist(), acc.tolist(), np.rad2deg(gyro).tolist(), strict=True):
            rows.writerow([t, *(f"{x:.4f}" for x in (*a, *g))])


def write_column(path: Path, head: str, values: np.ndarray) -> None:
    path.write_text("\n".join([*([head] if head else []), *map(str, values.tolist())]) + "\n")


def write_truth(path: Path) -> None:
    """Write where the middles of B and C are against A, every laboratory's sample from the first edge."""
    t_s = np.arange(round((REST_S + SHAKE_S + AFTER_S) * WAVE_HZ) + 1) / WAVE_HZ
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(
            ["component", "sample", "dx_mm", "dy_mm", "dz_mm", "drvec_x_rad", "drvec_y_rad", "drvec_z_rad"]
        )
        for component, motion in (("B", b_on_a), ("C", c_on_a)):
            at = motion(t_s - REST_S)
            point = np.array(POINTS_MM[component])
            moved = np.column_stack([at.apply(point) - point, rvec_from_matrix(at.R)])
            rows.writerows([component, i, *(f"{x:.6f}" for x in row)] for i, row in enumerate(moved.tolist()))


def fleet_text() -> str:
    units = "".join(
        f'[[unit]]\nname = "{unit.name}"\naddress = "tcp://127.0.0.1:4192{i}"  # nobody is there any more\n'
        f'calibration = "{unit.name}.json"\nlayout = "kit/layout.toml"\ncamera = "static"\n\n'
        for i, unit in enumerate(UNITS)
    )
    return f'# Three simulated units of one brick.\nruns_folder = "runs"\n\n{units}'


if __name__ == "__main__":
    main()
