"""Attitudes and positions of a body from a CSV file: a motion that bricktrack did not track itself."""

from pathlib import Path

import numpy as np

from bricktrack_common.errors import RunFormatError
from bricktrack_common.rotations import matrix_from_quaternion
from bricktrack_host.quality import PoseFlag
from bricktrack_host.recordings.timed_csv import TimedCsv
from bricktrack_host.tracks import OpticalTrack

_ATTITUDE = ("q_w", "q_x", "q_y", "q_z")
_POSITION = ("x_mm", "y_mm", "z_mm")
_UNIT_WITHIN = 0.01


def read_poses_csv(path: Path, *, sd_deg: float, sd_mm: float) -> OpticalTrack:
    """Return the poses of a CSV file with the columns ``t_ns, q_w, q_x, q_y, q_z`` and ``x_mm, y_mm, z_mm``.

    Unit quaternions and positions take brick axes to camera axes, as in bricktrack's own ``optical.csv``.
    Other columns are ignored; a row with an empty value is a frame without pose.

    Parameters
    ----------
    sd_deg, sd_mm : float
        How well the poses are known, each axis.

    Raises
    ------
    RunFormatError
        If a column is missing, a field is no number, a quaternion is not of unit length, or times do not
        increase.
    """
    table = TimedCsv.read(path)
    names = (*_ATTITUDE, *_POSITION)
    t_ns, values = table.columns(names, expected=", ".join(("t_ns", *names)))
    seen = np.isfinite(values).all(axis=1)
    length = np.linalg.norm(values[:, :4], axis=1)
    bad = seen & (np.abs(length - 1) > _UNIT_WITHIN)
    if bad.any():
        i = int(np.argmax(bad))
        line = table.rows[i][0]
        raise RunFormatError(
            f"{path}: line {line}: the quaternion has length {length[i]:.4f}; expected 1 (w, x, y, z)"
        )
    n = len(t_ns)
    R, t_mm = np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan)
    R[seen] = matrix_from_quaternion(values[seen, :4] / length[seen, None])
    t_mm[seen] = values[seen, 4:]
    sd = np.repeat([np.radians(sd_deg), sd_mm], 3)
    return OpticalTrack(
        t_ns=t_ns,
        R_camera_brick=R,
        t_camera_brick_mm=t_mm,
        covariance=np.broadcast_to(np.diag(sd**2), (n, 6, 6)).copy(),
        flags=np.where(seen, 0, int(PoseFlag.NO_POSE)).astype(np.int64),
        residual_px=np.full((n, 0, 2), np.nan),
        led_t_ns=np.zeros((n, 0), dtype=np.int64),
    )
