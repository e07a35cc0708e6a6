"""Ray models side by side on simulated boards and on the shared path-traced sample (simulated): error, honesty, time.

First, cameras whose rays are known (`tests/support/lens_boards.py`) see the paper's board at the paper's planes with
0.02 px of noise. Worst error at the LEDs over the paper's sweeps, and the share of covered pixels whose true ray lies
within the stated 95 %, over many seeds. Then the path-traced pictures of the 32 x 18 target, judged at the dots of
the 54 x 32 target that fills the picture. Peers: OpenCV's 14 coefficients, with the planes' poses given and found, and
mrcal's splined model where a Python with mrcal is found (Debian package python3-mrcal; BRICKTRACK_MRCAL_PYTHON names
another command). ``--seeds N`` for fewer. The folder of samples comes from ``BRICKTRACK_SAMPLES``.
"""

import argparse
import csv
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "tests" / "support"))
sys.path.insert(0, str(HERE))

import ray_model_peers as peers  # noqa: E402 (beside this script)
from lens_boards import (  # noqa: E402 (the tests' support is no package)
    A_MM,
    B_MM,
    LENSES,
    in_picture,
    picture_points,
    sweep_points,
    two_planes,
)

from bricktrack_common.camera_model import IMX219_1080P  # noqa: E402
from bricktrack_host.calibration.dots.dot_detection import detect_dots  # noqa: E402
from bricktrack_host.calibration.dots.dot_grid import GridOrigin, assign_grid  # noqa: E402
from bricktrack_host.calibration.dots.plane_pictures import read_grey  # noqa: E402
from bricktrack_host.calibration.rays.central_rays import fit_central_rays  # noqa: E402
from bricktrack_host.calibration.rays.irt import fit_two_plane_irt  # noqa: E402
from bricktrack_host.calibration.rays.ray_calibration import calibrate_rays  # noqa: E402

MODE = IMX219_1080P
INSIDE_95 = 5.991


def models() -> dict[str, Callable]:
    """Return the fits: name -> planes -> model."""
    return {
        "central, degrees held (default)": lambda p: fit_central_rays(p, sensor_mode=MODE),
        "walking pupil, degrees held": lambda p: fit_central_rays(p, sensor_mode=MODE, walks=True),
        "two-plane, degrees held": lambda p: fit_two_plane_irt(p, sensor_mode=MODE, order=None),
        "central, order 7": lambda p: fit_central_rays(p, sensor_mode=MODE, order=7),
        "two-plane, order 5 (the paper's)": lambda p: fit_two_plane_irt(p, sensor_mode=MODE),
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=50)
    seeds = parser.parse_args().seeds
    simulated_boards(seeds)
    default_choice(min(seeds, 10))
    root = os.environ.get("BRICKTRACK_SAMPLES")
    if root is None:
        print("BRICKTRACK_SAMPLES is not set: no path-traced pictures")
        return 0
    path_traced(Path(root) / "path-traced")
    return 0


def led_error_um(model, lens) -> float:
    """Return the worst distance at an LED of the sweeps between it and the ray of its pixel."""
    points = sweep_points()
    uv = lens(points)
    seen = in_picture(uv)
    return 1e3 * float(
        np.hypot(*(model.points_on_plane(uv[seen], points[seen, 2]) - points[seen, :2]).T).max()
    )


def within_95(model, lens) -> tuple[int, int]:
    """Return how many covered pixels' true points lie in the stated region, and of how many."""
    inside = total = 0
    for z_mm in (A_MM, (A_MM + B_MM) / 2, B_MM):
        xy, uv = picture_points(lens, z_mm)
        covered = model.is_covered(uv)
        d = model.points_on_plane(uv[covered], z_mm) - xy[covered]
        inverse = np.linalg.inv(model.point_covariance_mm2(uv[covered], z_mm))
        inside += int(np.count_nonzero(np.einsum("ni,nij,nj->n", d, inverse, d) < INSIDE_95))
        total += len(d)
    return inside, total


def simulated_boards(seeds: int) -> None:
    """Print errors and honesty on simulated boards."""
    print(f"Simulated cameras, 32 x 18 dots at z = {A_MM} and {B_MM} mm, noise 0.02 px, {seeds} seeds")
    print(f"{'lens':9s}{'model':36s}{'worst um at LEDs: mean':>23s}{'max':>8s}{'in 95 %':>9s}{'fit s':>8s}")
    for lens_name, lens in LENSES.items():
        for name, fit in models().items():
            n = seeds if "default" in name else max(seeds // 3, 1)
            worst, inside, total, spent = [], 0, 0, 0.0
            for seed in range(n):
                planes = two_planes(lens, seed)
                start = time.perf_counter()
                model = fit(planes)
                spent += time.perf_counter() - start
                worst.append(led_error_um(model, lens))
                k, of = within_95(model, lens)
                inside, total = inside + k, total + of
            print(
                f"{lens_name:9s}{name:36s}{np.mean(worst):23.2f}{max(worst):8.2f}{inside / total:9.1%}"
                f"{spent / n:8.2f}  ({n} seeds)",
                flush=True,
            )
        planes = two_planes(lens, 0)
        for name, fit in peers.opencv_fits().items():
            start = time.perf_counter()
            model = fit(planes, (MODE.width, MODE.height))
            spent = time.perf_counter() - start
            print(f"{lens_name:9s}{name:36s}{led_error_um(model, lens):23.2f}{'':17s}{spent:8.2f}  (1 seed)")


def default_choice(seeds: int) -> None:
    """Print what the default choice takes, and how it errs."""
    print("\nDefault choice of model and order, from outliers to doubts about the rig")
    for lens_name, lens in LENSES.items():
        taken: dict[str, int] = {}
        worst, spent = [], 0.0
        for seed in range(seeds):
            planes = two_planes(lens, 1000 + seed)
            start = time.perf_counter()
            fitted = calibrate_rays(planes, sensor_mode=MODE, dot_diameter_mm=1e-3)
            spent += time.perf_counter() - start
            taken[fitted.choice.model] = taken.get(fitted.choice.model, 0) + 1
            worst.append(led_error_um(fitted.model, lens))
        listed = ", ".join(f"{model} {n}" for model, n in taken.items())
        print(
            f"{lens_name:9s}{listed:30s} worst um at LEDs: mean {np.mean(worst):.2f}, max {max(worst):.2f}; "
            f"{spent / seeds:.2f} s each",
            flush=True,
        )


def path_traced(folder: Path) -> None:
    """Print residuals, and errors at dots of the larger target, from the sample's two pictures."""
    print("\nPath-traced pictures (simulated) of the 32 x 18 target, judged at the dots of 54 x 32")
    start = time.perf_counter()
    planes = []
    for letter, z_mm in (("A", A_MM), ("B", B_MM)):
        grey, _ = read_grey(folder / f"calib_{letter}_32x18.png")
        dots = assign_grid(
            detect_dots(grey), pitch_mm=4.0, columns=32, rows=18, origin=GridOrigin((960, 540))
        )
        planes.append((z_mm, dots))
    found = time.perf_counter() - start
    start = time.perf_counter()
    fitted = calibrate_rays(planes, sensor_mode=MODE, dot_diameter_mm=2.0)
    whole = time.perf_counter() - start
    print(f"two pictures to dots {found:.2f} s; dots to the chosen model {whole:.2f} s")
    print(f"chosen: {fitted.choice.reason}")
    for r in fitted.model.residuals:
        print(f"  z = {r.z_mm} mm: {r.n_dots} dots, residual mean {r.mean_um:.2f}, max {r.max_um:.2f} um")
    fits: dict[str, Callable] = {"chosen": lambda p: fitted.model} | models()
    fits |= {
        name: (lambda p, fit=fit: fit(p, (MODE.width, MODE.height)))
        for name, fit in peers.opencv_fits().items()
    }
    mrcal = peers.mrcal_fit()
    if mrcal is None:
        print("mrcal is not installed (Debian package python3-mrcal): left out")
    else:
        fits["mrcal, splined, poses given"] = lambda p: mrcal(p, (MODE.width, MODE.height))
    print(
        f"{'model':36s}{'A: mean um':>11s}{'max':>8s}{'B: mean um':>12s}{'max':>8s}{'in 95 %':>9s}{'fit s':>8s}"
    )
    judged = {letter: true_dots(folder, letter) for letter in "AB"}
    for name, fit in fits.items():
        start = time.perf_counter()
        model = fit(fitted.planes)
        spent = time.perf_counter() - start
        cells, inside, total = "", 0, 0
        for (letter, z_mm), width in zip((("A", A_MM), ("B", B_MM)), (11, 12), strict=True):
            uv, xy = judged[letter]
            d = model.points_on_plane(uv, z_mm) - xy
            size = 1e3 * np.hypot(*d.T)
            cells += f"{size.mean():{width}.2f}{size.max():8.1f}"
            if hasattr(model, "point_covariance_mm2"):
                squares = np.einsum("ni,nij,nj->n", d, np.linalg.inv(model.point_covariance_mm2(uv, z_mm)), d)
                inside, total = inside + int(np.count_nonzero(squares < INSIDE_95)), total + len(d)
        share = f"{inside / total:9.1%}" if total else f"{'-':>9s}"
        print(f"{name:36s}{cells}{share}{spent:8.2f}", flush=True)


def true_dots(folder: Path, letter: str) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels and places of the larger target's dots in the picture, from the sample's truth."""
    with (folder / "truth" / "calib_dots.csv").open() as file:
        rows = [
            [float(r[k]) for k in ("u_px", "v_px", "x_mm", "y_mm")]
            for r in csv.DictReader(file)
            if r["target"] == "54x32" and r["plane"] == letter
        ]
    truth = np.array(rows)
    truth = truth[in_picture(truth[:, :2])]
    return truth[:, :2], truth[:, 2:]


if __name__ == "__main__":
    sys.exit(main())
