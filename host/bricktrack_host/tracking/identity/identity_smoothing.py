"""A run's poses made steady: each frame where its lights and the frames about it show it.

With two LEDs hidden, read out row by row, a frame leaves its attitude to some tenths of a radian: what motion
within a frame does to the picture, a turn does as well. The run as a whole knows better. Steady poses are
the least squares of all lights, each twist left to them as far as it is in doubt, and of fourth differences
from frame to frame, as large as most of the run's are.
"""

import numpy as np
from scipy.linalg import solveh_banded

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix
from bricktrack_host.tracking.identity.identity_motion import run_motion, unknown_motion
from bricktrack_host.tracking.identity.run_identities import RunIdentities
from bricktrack_host.tracking.identity.smoothing_kernel import N_BANDS, banded_equations
from bricktrack_host.tracking.identity.verification import motion_of
from bricktrack_host.tracking.pose.refine import LedMotion, pose_equations

_MAX_LOST = 3  # frames in a row that are bridged
_LEAST_FRAMES = 9
_LEAST, _MOST = (
    np.array([0.002, 0.05]),
    np.array([0.03, 5.0]),
)  # rad, mm: of frames to their neighbours' cubic
_STEPS = 3


def steady_poses(run: RunIdentities, usual_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the poses of a run's known frames, and of those lost between them, NaN elsewhere.

    Parameters
    ----------
    usual_px : ndarray, shape (n,)
        What residuals usually scatter by about each frame.
    """
    R, t_mm = (
        np.full_like(run.found.R_camera_brick, np.nan),
        np.full_like(run.found.t_camera_brick_mm, np.nan),
    )
    parts = []
    for known in _parts(run):
        frames = np.arange(known[0], known[-1] + 1) if known.size >= _LEAST_FRAMES else known
        R[frames], t_mm[frames] = _bridged(run, known, frames)
        parts += [frames] if known.size >= _LEAST_FRAMES else []
    if not parts:
        return R, t_mm
    lights, frames = run.lights_of(np.arange(len(R))), np.concatenate(parts)
    for motion_is_known in (False, True):
        if motion_is_known:
            within = run_motion(
                run.stamps_ns, lights.uv_px, R, t_mm, run.ray_model, run.brick_model, collar_mm=run.collar_mm
            ).within
        else:
            within = unknown_motion(lights.uv_px, run.ray_model)
        R[frames], t_mm[frames] = _smoothed(
            run, parts, R[frames], t_mm[frames], motion_of(within, frames), usual_px
        )
    return R, t_mm


def _parts(run: RunIdentities) -> list[IntArray]:
    """Return the known frames, parted where too many are lost, or time has passed that no frame tells of."""
    known = run.known_frames()
    if known.size < 2:
        return [known] if known.size else []
    steps = np.diff(known)
    periods = np.rint(np.diff(run.stamps_ns[known]) / np.median(np.diff(run.stamps_ns)))
    return np.split(known, np.flatnonzero((steps > _MAX_LOST + 1) | (periods != steps)) + 1)


def _bridged(run: RunIdentities, known: IntArray, frames: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the poses of frames, those between known ones on the straight way from one to the next."""
    R, t_mm = run.found.R_camera_brick[known], run.found.t_camera_brick_mm[known]
    turns = rvec_from_matrix(R[0].T @ R)
    x = np.stack([np.interp(frames, known, y) for y in np.concatenate([turns, t_mm], axis=1).T], axis=1)
    return R[0] @ matrix_from_rvec(x[:, :3]), x[:, 3:]


def _smoothed(
    run: RunIdentities,
    parts: list[IntArray],
    R: FloatArray,
    t_mm: FloatArray,
    within: LedMotion,
    usual_px: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return better poses of the frames of all parts; those of a part follow each other."""
    frames, ends = np.concatenate(parts), np.cumsum([len(part) for part in parts])
    lights = run.lights_of(frames)
    uv = np.where(lights.is_whole[..., None], lights.uv_px, np.nan)
    noise = lights.cov_px2 + usual_px[frames, None, None, None] ** 2 * np.eye(2)
    for _ in range(_STEPS):
        A, g = pose_equations(
            uv, noise, R, t_mm, run.ray_model, run.brick_model, collar_mm=run.collar_mm, motion=within
        )
        banded, right = np.zeros((N_BANDS, *g.shape)), np.empty_like(g)
        banded_equations(A, g, R, t_mm, ends, _LEAST, _MOST, banded, right)
        equations = banded.reshape(N_BANDS, -1), right.ravel()
        step = np.asarray(solveh_banded(*equations, lower=True, overwrite_ab=True)).reshape(-1, 6)
        R, t_mm = R @ matrix_from_rvec(step[:, :3]), t_mm + step[:, 3:]
        if (np.abs(step).max(axis=0) < np.repeat(_LEAST, 3)).all():
            break
    return R, t_mm
