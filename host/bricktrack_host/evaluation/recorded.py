"""A recorded sweep: a processed run, and a table of where the brick stood when."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.errors import ConfigError
from bricktrack_common.rotations import matrix_from_rvec, nearest_rotation, rvec_from_matrix
from bricktrack_host.evaluation.scores import SweepScore, score_sweep
from bricktrack_host.evaluation.sweeps import Sweep
from bricktrack_host.recordings.timed_csv import refuse_longer_rows, refuse_other_separator
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracks import OpticalTrack

_POSITION, _ROTATION = ("x_mm", "y_mm", "z_mm"), ("rx_deg", "ry_deg", "rz_deg")

_MIN_FRAMES_TO_TELL = 4
_REST_MM, _REST_SIGMAS = 0.1, 6.0  # what a stage may settle; and what frames' noise makes of two halves


@dataclass(frozen=True, slots=True, eq=False)
class ReferencePositions:
    """Where the brick stood, and when.

    Attributes
    ----------
    start_s, end_s : ndarray, shape (n,), s
        Of each rest, after the first frame.
    position_mm : ndarray, shape (n, 3), mm, in the stage's axes
    rvec_rad : ndarray, shape (n, 3), rad, brick axes
        Since the first rest; zero where the table has no rotations.
    """

    start_s: FloatArray
    end_s: FloatArray
    position_mm: FloatArray
    rvec_rad: FloatArray


def read_positions(path: Path) -> ReferencePositions:
    """Return the reference positions of a CSV file.

    Columns ``start_s, end_s, x_mm, y_mm, z_mm`` and, if wanted, a rotation vector ``rx_deg, ry_deg, rz_deg``.

    Raises
    ------
    ConfigError
        If the file cannot be read, a column is missing, a value is no number, or a rest ends too early.
    RunFormatError
        If its fields are parted by anything but commas, or a row has more of them than the first line.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            header, rows = list(reader.fieldnames or ()), list(reader)
    except (OSError, UnicodeDecodeError) as e:
        raise ConfigError(f"{path}: cannot be read as CSV: {getattr(e, 'strerror', e)}") from e
    refuse_other_separator(path, header)
    refuse_longer_rows(path, rows)
    wanted = ("start_s", "end_s", *_POSITION)
    missing = [c for c in wanted if not rows or c not in rows[0]]
    if missing or len(rows) < 2:
        raise ConfigError(
            f"{path}: {len(rows)} rows, columns missing: {', '.join(missing) or 'none'}; expected two "
            f"rows or more with {', '.join(wanted)}"
        )

    def column(name: str, line: int, row: dict[str, str]) -> float:
        try:
            value = float(row[name])
        except (TypeError, ValueError):
            value = np.nan
        if not np.isfinite(value):
            raise ConfigError(f"{path}: line {line}: {name} is {row[name]!r}; expected a number")
        return value

    def table(names: tuple[str, ...]) -> FloatArray:
        return np.array([[column(c, k, row) for c in names] for k, row in enumerate(rows, start=2)])

    times = table(("start_s", "end_s"))
    backwards = np.flatnonzero(times[:, 1] <= times[:, 0])
    if backwards.size:
        k = int(backwards[0])
        raise ConfigError(f"{path}: line {k + 2}: the rest ends at {times[k, 1]:g} s, before its start")
    rotation = table(_ROTATION) if all(c in rows[0] for c in _ROTATION) else np.zeros((len(rows), 3))
    return ReferencePositions(times[:, 0], times[:, 1], table(_POSITION), np.radians(rotation))


def score_recording(
    track: OpticalTrack, reference: ReferencePositions, *, name: str, align: bool = True
) -> SweepScore:
    """Return the errors of a recorded sweep.

    Parameters
    ----------
    track : OpticalTrack
    reference : ReferencePositions
    name : str
    align : bool
        Turn the stage's axes onto the camera's as the displacements say best: nobody knows that turn to the
        tenth of a degree that a tenth of a millimetre in 60 asks for. Lengths are never scaled.

    Raises
    ------
    ConfigError
        If fewer than two rests have a pose, or the brick moves in one.
    """
    since_s = (track.t_ns - track.t_ns[0]) * 1e-9
    n = len(reference.start_s)
    R, t = np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan)
    posed = all_finite(track.R_camera_brick, 2) & all_finite(track.t_camera_brick_mm)
    for k in range(n):
        rest = posed & (since_s >= reference.start_s[k]) & (since_s <= reference.end_s[k])
        if rest.any():
            _require_rest(track.t_camera_brick_mm[rest], reference, k)
            t[k] = track.t_camera_brick_mm[rest].mean(axis=0)
            R[k] = nearest_rotation(track.R_camera_brick[rest].mean(axis=0)[None])[0]
    good = np.flatnonzero(all_finite(t))
    if good.size < 2:
        raise ConfigError(
            f"{good.size} of {n} rests have a pose; expected two or more. The recording spans "
            f"{since_s[-1]:.1f} s from its first frame: do the table's times count from there?"
        )
    zero = good[0]
    true_mm = reference.position_mm - reference.position_mm[zero]
    if align:
        U, _, Vt = np.linalg.svd((t[good] - t[zero]).T @ true_mm[good])
        handed = np.diag([1.0, 1.0, np.linalg.det(U @ Vt)])
        true_mm = true_mm @ (U @ handed @ Vt).T
    turned = matrix_from_rvec(reference.rvec_rad)
    true_R = R[zero] @ turned[zero].T @ turned
    along = np.linalg.norm(true_mm, axis=1)
    angle = np.degrees(np.linalg.norm(rvec_from_matrix(turned[zero].T @ turned), axis=1))
    is_turned = float(angle.max()) > 0 and float(along.max()) == 0
    sweep = Sweep(
        name, angle if is_turned else along, "deg" if is_turned else "mm", true_R, t[zero] + true_mm
    )
    return score_sweep(sweep, R, t)


def _require_rest(t_mm: FloatArray, reference: ReferencePositions, k: int) -> None:
    """Refuse the ``k``-th rest if the brick's places in it, shape (n, 3), mm, move on from half to half."""
    if len(t_mm) < _MIN_FRAMES_TO_TELL:
        return
    half = len(t_mm) // 2
    moved_mm = float(np.linalg.norm(t_mm[-half:].mean(axis=0) - t_mm[:half].mean(axis=0)))
    scatter_mm = float(np.linalg.norm(np.diff(t_mm, axis=0).std(axis=0))) / np.sqrt(2)
    if moved_mm > max(_REST_MM, _REST_SIGMAS * scatter_mm * np.sqrt(2 / half)):
        raise ConfigError(
            f"rest {k + 1}, from {reference.start_s[k]:g} to {reference.end_s[k]:g} s: the brick moves on by "
            f"{moved_mm:.2f} mm between its halves; expected one place. Take start_s and end_s from within "
            "the rest, in seconds after the first frame"
        )
