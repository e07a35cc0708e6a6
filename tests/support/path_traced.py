"""Recordings of the path-traced sample, whole or shortened, as run folders."""

from pathlib import Path

from bricktrack_host.recordings.import_recording import Recording, import_recording
from bricktrack_host.recordings.loose_files import read_rig

SAMPLE = Path(__file__).resolve().parents[1] / "data" / "path-traced"
"""The shortened one of this repository."""


def import_motion(runs_folder: Path, sample: Path = SAMPLE) -> None:
    """Import ``motion`` as ``sample_motion``, with its IMU and the square wave."""
    _import(runs_folder, sample, "motion", {"brick": sample / "imu_motion.csv"}, sample / "edges_motion.csv")


def import_static(runs_folder: Path, sample: Path) -> None:
    """Import ``static`` as ``sample_static``; only the whole sample has it."""
    _import(runs_folder, sample, "static", {}, None)


def _import(runs_folder: Path, sample: Path, name: str, imus: dict[str, Path], edges: Path | None) -> None:
    import_recording(
        Recording(
            video=sample / f"{name}.h264",
            timestamps=sample / f"{name}_pts_us.txt",
            imus=imus,
            edges=edges,
            rig=read_rig(sample / "rig.toml", table=name),
            unit="sample",
            label=name,
            simulated=True,
        ),
        runs_folder,
    )
