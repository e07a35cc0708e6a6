"""The paper's sweeps on film, one step a frame: domes, rolling shutter, noise and H.264."""

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.rotations import matrix_from_rvec
from bricktrack_host.evaluation.filmed import Film, Progress, make_film, open_film
from bricktrack_host.evaluation.scores import SweepScore, score_sweep
from bricktrack_host.evaluation.sweeps import ROTATION_LIMIT_DEG, Sweep
from bricktrack_host.tracking.centroid_noise import with_measured_noise
from bricktrack_host.tracking.frame_errors import frame_errors
from bricktrack_host.tracking.optical_track import solve_poses, start_poses

_FRAME_S = 0.0333273
_STEP_MM, _STEP_DEG = 1.0, 1.0
_DEPTH_MM = (-28.0, 26.0)  # about the simulated rest, 134 mm: 106 to 160 mm
_DIAGONAL_MM = (26.0, 7.0)
_TURN_S = 0.5  # from one sweep's end to the next one's start
_MIDDLE_BRICK_MM = np.array([27.3, 24.5, 6.3])


def evaluate_film(
    folder: Path,
    *,
    seed: int,
    stage: Callable[[str], Progress],
) -> dict[str, list[SweepScore]]:
    """Film the sweeps into a folder, or take a film that is there, and score what the product makes of them.

    Parameters
    ----------
    folder : Path
    seed : int
        Of the simulated unit: its lens and noise.
    stage : callable
        Told the name of each stage; returns what is called with parts done and of all.

    Returns
    -------
    dict of list of SweepScore
        For each way of solving the same observations; the product's own first.

    Raises
    ------
    ConfigError
        If the simulator or the calibration fails.
    """
    path, names, spans = _path()
    if not (folder / "film.npz").exists():
        folder.mkdir(parents=True, exist_ok=True)
        motion = folder / "motion.csv"
        _write_motion(motion, path)
        make_film(folder, seed=seed, seconds=len(path) * _FRAME_S, motion_csv=motion, progress=stage("film"))
    stage("calibrate")(0, 1)
    film = open_film(folder)
    observations = film.observe(stage("find LEDs"))
    bare = replace(film.brick, led_profile=None)
    scores: dict[str, list[SweepScore]] = {}
    for name, brick, rows in (
        ("domes and row times", film.brick, True),
        ("no dome model", bare, True),
        ("no row times", film.brick, False),
        ("neither", bare, False),
    ):
        first = start_poses(observations, film.rays, brick)
        errors = frame_errors(observations, first, film.rays, brick, rolling_shutter=rows)
        told = with_measured_noise(observations, errors)
        track = solve_poses(told, film.rays, brick, rolling_shutter=rows, first=first)
        scores[name] = [
            score_sweep(
                _truth(film, sweep, span, path),
                track.R_camera_brick[span],
                track.t_camera_brick_mm[span],
                covariance=track.covariance[span],
            )
            for sweep, span in zip(names, spans, strict=True)
        ]
    return scores


def _path() -> tuple[FloatArray, list[str], list[IntArray]]:
    """Return displacement and rotation vector, (n, 6), mm and degrees, and the names and frames of sweeps."""
    depth = np.arange(_DEPTH_MM[0], _DEPTH_MM[1] + 1e-9, _STEP_MM)
    length = float(np.hypot(*_DIAGONAL_MM))
    along = np.arange(-length, length + 1e-9, _STEP_MM)
    angle = np.arange(-ROTATION_LIMIT_DEG, ROTATION_LIMIT_DEG + 1e-9, _STEP_DEG)
    sweeps: dict[str, FloatArray] = {"between the planes": np.zeros((len(depth), 6))}
    sweeps["between the planes"][:, 2] = depth
    sweeps["corner to corner"] = np.zeros((len(along), 6))
    sweeps["corner to corner"][:, :2] = along[:, None] * np.array(_DIAGONAL_MM) / length
    for axis, name in enumerate("xyz"):
        turn = np.zeros((len(angle), 6))
        turn[:, 3 + axis] = angle
        # About the LEDs' middle, not the origin LED.
        R = matrix_from_rvec(np.radians(turn[:, 3:]))
        turn[:, :3] = _MIDDLE_BRICK_MM - R @ _MIDDLE_BRICK_MM
        sweeps[f"rotation about {name}"] = turn
    n_turn = round(_TURN_S / _FRAME_S)
    rest = np.zeros((2, 6))
    before, parts, spans, at = rest, [], [], 0
    for sweep in sweeps.values():
        parts += [_turn(before, sweep, n_turn), sweep]
        at += n_turn - 1
        # The first and last frames of a sweep still feel the turn before and after it.
        spans.append(np.arange(at + 2, at + len(sweep) - 2))
        at += len(sweep)
        before = sweep
    parts += [_turn(before, rest, n_turn), np.zeros((10, 6))]
    return np.concatenate(parts), list(sweeps), spans


def _turn(before: FloatArray, after: FloatArray, n: int) -> FloatArray:
    """Return the ``n`` - 1 frames from one sweep's last to the next one's first, at either's speed there."""
    s = np.arange(1, n)[:, None] / n
    leaving, arriving = n * (before[-1] - before[-2]), n * (after[1] - after[0])
    away = (1 - s) ** 2 * ((1 + 2 * s) * before[-1] + s * leaving)
    return np.asarray(away + s**2 * ((3 - 2 * s) * after[0] - (1 - s) * arriving))


def _write_motion(path: Path, motion: FloatArray) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("t_s", "x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg"))
        for k, row in enumerate(motion):
            writer.writerow([f"{k * _FRAME_S:.6f}", *(f"{x:.6f}" for x in row)])


def _truth(film: Film, name: str, span: IntArray, path: FloatArray) -> Sweep:
    turned = bool(np.ptp(path[span, 3:]) > 0)
    step = (
        path[span, 3:].sum(axis=1) if turned else np.linalg.norm(path[span, :3] - path[span[0], :3], axis=1)
    )
    unit = "deg" if turned else "mm"
    return Sweep(name, step, unit, film.R_camera_brick[span], film.t_camera_brick_mm[span])
