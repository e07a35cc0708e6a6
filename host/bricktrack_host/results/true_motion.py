"""The true motion of a simulated run, read from its file and taken between its samples."""

import csv
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.errors import RunFormatError
from bricktrack_common.rotations import matrix_from_quaternion, matrix_from_rvec, rvec_from_matrix
from bricktrack_host.recordings.timed_csv import refuse_longer_rows, refuse_other_separator

_MATCH_NS = 50_000  # 0.25 m/s makes this 0.0125 mm: more would not be the same instant
_MAX_STEP_NS = 5_000_000  # farther apart, samples are single poses and not a motion


@dataclass(frozen=True, slots=True, eq=False)
class TrueMotion:
    """Where the brick truly was.

    Attributes
    ----------
    t_ns : ndarray of int64, shape (n,), the unit's CLOCK_MONOTONIC, or since the first frame (`is_relative`)
    R_camera_brick : ndarray, shape (n, 3, 3)
    t_camera_brick_mm : ndarray, shape (n, 3), mm
    omega_brick_radps : ndarray, shape (n, 3), rad/s, brick axes
        NaN where it is not known and cannot be had from the neighbours.
    v_camera_mmps : ndarray, shape (n, 3), mm/s, camera axes
    dropouts_ns : ndarray of int64, shape (k, 2)
        First and last instant of each time in which the camera could not see the brick.
    is_continuous : bool
        Whether poses between the samples can be had; otherwise only at the samples.
    is_relative : bool
        Whether times count from the first frame's stamp, for files without the unit's clock.
    """

    t_ns: IntArray
    R_camera_brick: FloatArray
    t_camera_brick_mm: FloatArray
    omega_brick_radps: FloatArray
    v_camera_mmps: FloatArray
    dropouts_ns: IntArray
    is_continuous: bool
    is_relative: bool = False

    def at(self, t_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return true rotations, shape (n, 3, 3), and positions, (n, 3), mm, at instants.

        Between samples: the cubic that takes positions and velocities of both ends, and for the rotation
        the same cubic of the rotation vector from the sample before. Outside the samples, and away from
        them where the motion is not continuous: NaN.
        """
        if not self.is_continuous:
            return self._nearest(t_ns)
        k = np.clip(np.searchsorted(self.t_ns, t_ns, side="right") - 1, 0, len(self.t_ns) - 2)
        inside: BoolArray = (t_ns >= self.t_ns[0]) & (t_ns <= self.t_ns[-1])
        step_ns = self.t_ns[k + 1] - self.t_ns[k]
        inside &= step_ns <= _MAX_STEP_NS
        h = (step_ns / 1e9)[:, None]
        s = ((t_ns - self.t_ns[k]) / step_ns)[:, None]
        blend = s * s * (3 - 2 * s), h * s * (1 - s) ** 2, h * s * s * (s - 1)
        start_mm, end_mm = self.t_camera_brick_mm[k], self.t_camera_brick_mm[k + 1]
        v0, v1 = self.v_camera_mmps[k], self.v_camera_mmps[k + 1]
        t_mm = start_mm + blend[0] * (end_mm - start_mm) + blend[1] * v0 + blend[2] * v1
        R0 = self.R_camera_brick[k]
        turn = rvec_from_matrix(np.swapaxes(R0, -1, -2) @ self.R_camera_brick[k + 1])
        w0 = self.omega_brick_radps[k]
        # d(rvec)/dt = w + rvec x w / 2 + ..., to second order in the turn of one millisecond
        w1 = self.omega_brick_radps[k + 1]
        w1 = w1 + 0.5 * np.cross(turn, w1) + np.cross(turn, np.cross(turn, w1)) / 12
        R = R0 @ matrix_from_rvec(blend[0] * turn + blend[1] * w0 + blend[2] * w1)
        t_mm[~inside], R[~inside] = np.nan, np.nan
        return R, t_mm

    def _nearest(self, t_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        after = np.clip(np.searchsorted(self.t_ns, t_ns), 0, len(self.t_ns) - 1)
        before = np.maximum(after - 1, 0)
        nearer = np.abs(t_ns - self.t_ns[before]) <= np.abs(self.t_ns[after] - t_ns)
        k = np.where(nearer, before, after)
        R, t_mm = self.R_camera_brick[k].copy(), self.t_camera_brick_mm[k].copy()
        away = np.abs(t_ns - self.t_ns[k]) > _MATCH_NS
        R[away], t_mm[away] = np.nan, np.nan
        return R, t_mm


def read_true_motion(path: Path) -> TrueMotion:
    """Return the true motion in a simulated run's ``truth.npz`` or in a sample's truth CSV.

    A CSV holds ``x_mm, y_mm, z_mm, qw, qx, qy, qz`` and a time: ``t_cam_ns`` (dense), ``t_mid_ns`` (one row a
    frame) or ``t_us`` since the first frame (one row a frame, the unit's clock not being told).

    Raises
    ------
    RunFormatError
        If the file is not readable as either, or its times do not increase.
    """
    if path.suffix == ".npz":
        return _read_npz(path)
    return _read_csv(path)


def _read_npz(path: Path) -> TrueMotion:
    try:
        with np.load(path, allow_pickle=False) as file:
            data = {name: file[name] for name in file.files}
    except (OSError, ValueError, zipfile.BadZipFile) as e:
        raise RunFormatError(f"{path}: not a readable truth file: {e}") from e
    shapes = {"t_ns": 1, "q_wxyz_camera_brick": 4, "t_camera_brick_mm": 3, "omega_brick_radps": 3,
              "v_camera_mmps": 3}  # fmt: skip
    for name, width in shapes.items():
        if name not in data:
            raise RunFormatError(f"{path}: no '{name}'; has {sorted(data)}")
        expected = (len(data["t_ns"]),) if width == 1 else (len(data["t_ns"]), width)
        if data[name].shape != expected:
            raise RunFormatError(f"{path}: {name} has shape {data[name].shape}; expected {expected}")
    t_ns = data["t_ns"]
    _check_times(path, t_ns)
    dropouts = np.asarray(data.get("dropouts_ns", np.empty((0, 2)))).astype(np.int64).reshape(-1, 2)
    return TrueMotion(
        t_ns=t_ns.astype(np.int64),
        R_camera_brick=matrix_from_quaternion(data["q_wxyz_camera_brick"]),
        t_camera_brick_mm=data["t_camera_brick_mm"].astype(np.float64),
        omega_brick_radps=data["omega_brick_radps"].astype(np.float64),
        v_camera_mmps=data["v_camera_mmps"].astype(np.float64),
        dropouts_ns=dropouts,
        is_continuous=True,
    )


def _read_csv(path: Path) -> TrueMotion:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            header, rows = list(reader.fieldnames or ()), list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as e:
        raise RunFormatError(f"{path}: not a readable truth file: {e}") from e
    if not rows:
        raise RunFormatError(f"{path}: no rows")
    refuse_other_separator(path, header)
    refuse_longer_rows(path, rows)
    clock = next((c for c in ("t_cam_ns", "t_mid_ns", "t_us") if c in rows[0]), None)
    if clock == "t_us" and "t_mid_ns" in rows[0]:
        clock = "t_mid_ns"
    missing = {"x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz"} - set(rows[0])
    if clock is None or missing:
        raise RunFormatError(f"{path}: columns {header}; missing {sorted(missing) or 'a time'}")
    try:
        # Whole nanoseconds are read as integers: a float would lose some of them.
        t_ns = np.array([int(r[clock]) * (1000 if clock == "t_us" else 1) for r in rows], dtype=np.int64)
        t_mm = np.array([[float(r[c]) for c in ("x_mm", "y_mm", "z_mm")] for r in rows])
        q = np.array([[float(r[c]) for c in ("qw", "qx", "qy", "qz")] for r in rows])
    except (TypeError, ValueError) as e:
        raise RunFormatError(f"{path}: not a number: {e}") from e
    _check_times(path, t_ns)
    R = matrix_from_quaternion(q)
    is_continuous = clock == "t_cam_ns"
    omega, v = _rates(t_ns, R, t_mm)
    return TrueMotion(
        t_ns=t_ns,
        R_camera_brick=R,
        t_camera_brick_mm=t_mm,
        omega_brick_radps=omega,
        v_camera_mmps=v,
        dropouts_ns=np.empty((0, 2), dtype=np.int64),
        is_continuous=is_continuous,
        is_relative=clock == "t_us",
    )


def _check_times(path: Path, t_ns: IntArray) -> None:
    if not np.issubdtype(t_ns.dtype, np.integer) or t_ns.ndim != 1 or t_ns.size < 2:
        raise RunFormatError(f"{path}: times of type {t_ns.dtype}, shape {t_ns.shape}; expected whole ns")
    if np.diff(t_ns).min() <= 0:
        raise RunFormatError(
            f"{path}: sample {int(np.argmin(np.diff(t_ns))) + 1} is not after the one before"
        )


def _rates(t_ns: IntArray, R: FloatArray, t_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return angular rates and velocities by the parabola through each sample and its neighbours."""
    if len(t_ns) < 3:
        return np.full_like(t_mm, np.nan), np.full_like(t_mm, np.nan)
    h = (np.diff(t_ns) / 1e9)[:, None]
    back, ahead = h[:-1], h[1:]

    def centred(step_back: FloatArray, step_ahead: FloatArray) -> FloatArray:
        inner = (step_ahead * back / ahead + step_back * ahead / back) / (back + ahead)
        return np.concatenate([step_back[:1] / back[:1], inner, step_ahead[-1:] / ahead[-1:]])

    steps = np.diff(t_mm, axis=0)
    turns = rvec_from_matrix(np.swapaxes(R[:-1], -1, -2) @ R[1:])
    # Both turns are about the same axes to first order: seen from the middle sample, Log(R^T R_next) and
    # -Log(R^T R_before) = Log(R_before^T R).
    return centred(turns[:-1], turns[1:]), centred(steps[:-1], steps[1:])
