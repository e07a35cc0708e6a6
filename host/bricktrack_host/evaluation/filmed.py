"""A simulated recording as `bricktrack_device.sim.film` leaves it: pictures, times, truth, target pictures.

The simulator is a program of its own, started and read like any other source of recordings; its renderer and
its lens share no code with what judges them.
"""

import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel, load_brick_model
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import ConfigError
from bricktrack_host.calibration.calibration_file import load_calibration
from bricktrack_host.tracking.led_tracker import observe_leds
from bricktrack_host.tracking.pictures.segment import Picture
from bricktrack_host.tracks import LedObservations

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class Film:
    """A filmed motion.

    Attributes
    ----------
    folder : Path
    brick : BrickModel
    rays : RayModel
        Calibrated from the film's own target pictures.
    sensor_timestamp_ns, exposure_ns : ndarray of int64, shape (n,)
    R_camera_brick, t_camera_brick_mm : ndarray, shapes (n, 3, 3) and (n, 3)
        The truth, at mid-exposure of the centre row.
    """

    folder: Path
    brick: BrickModel
    rays: RayModel
    sensor_timestamp_ns: IntArray
    exposure_ns: IntArray
    R_camera_brick: FloatArray
    t_camera_brick_mm: FloatArray

    def observe(self, progress: Progress = lambda done, of: None) -> LedObservations:
        """Decode the video, and find and identify the LEDs."""
        n = len(self.sensor_timestamp_ns)
        return observe_leds(
            self._pictures(),
            self.rays,
            self.brick,
            sensor_timestamp_ns=self.sensor_timestamp_ns,
            exposure_ns=self.exposure_ns,
            progress=lambda done: progress(done, n),
        )

    def _pictures(self) -> Iterator[tuple[int, Picture]]:
        with av.open(str(self.folder / "video.h264")) as container:
            for i, frame in enumerate(container.decode(video=0)):
                yield i, Picture(*(_plane(p) for p in frame.planes))


def _plane(plane: Any) -> NDArray[np.uint8]:
    return np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)[:, : plane.width]


def make_film(
    folder: Path,
    *,
    seed: int,
    seconds: float,
    motion: str = "csv",
    motion_csv: Path | None = None,
    progress: Progress = lambda done, of: None,
) -> None:
    """Film a motion into a folder.

    Raises
    ------
    ConfigError
        If the simulator fails, or is not installed.
    """
    command = [sys.executable, "-m", "bricktrack_device.sim.film", str(folder), "--seed", str(seed)]
    command += ["--motion", motion, "--seconds", f"{seconds:.6f}"]
    if motion_csv is not None:
        command += ["--motion-csv", str(motion_csv)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as simulator:
        assert simulator.stdout is not None and simulator.stderr is not None  # noqa: S101 - both are pipes
        for line in simulator.stdout:
            done, _, of = line.strip().partition("/")
            if done.isdigit() and of.isdigit():
                progress(int(done), int(of))
        said = simulator.stderr.read().strip()
    if simulator.returncode:
        last = said.splitlines()[-1] if said else "nothing said"
        raise ConfigError(
            f"the simulated camera ended with code {simulator.returncode}: {last}. It needs the 'sim' extra: "
            "pip install 'bricktrack[sim]'"
        )


def open_film(folder: Path) -> Film:
    """Calibrate a film's camera from its target pictures, as a user would, and return the film."""
    calibration = folder / "calibration.json"
    if not calibration.exists():
        arguments = ["calibrate", "fit", "--rig", str(folder / "rig.toml"), "--unit", "simulated"]
        arguments += ["--focus-note", "simulated", "-o", str(calibration)]
        done = subprocess.run(
            [sys.executable, "-m", "bricktrack_host.cli", *arguments],
            check=False,
            capture_output=True,
            text=True,
        )
        if done.returncode:
            raise ConfigError(f"{folder}: its camera could not be calibrated: {done.stderr.strip()}")
    truth = np.load(folder / "film.npz")
    return Film(
        folder=folder,
        brick=load_brick_model(folder / "layout.toml"),
        rays=load_calibration(calibration).ray_model,
        sensor_timestamp_ns=truth["sensor_timestamp_ns"],
        exposure_ns=truth["exposure_ns"],
        R_camera_brick=truth["R_camera_brick"],
        t_camera_brick_mm=truth["t_camera_brick_mm"],
    )
