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
from bricktrack_host.tracking.identity.verification import motion_of
from bricktrack_host.tracking.led_model.led_profile import predict_brick
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.refine import LedMotion

_MAX_LOST = 3  # frames in a row that are bridged
_LEAST_FRAMES = 9
_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 6  # of a frame to the cubic through its four neighbours
_LEAST, _MOST = np.array([0.002, 0.05]), np.array([0.03, 5.0])  # rad, mm: of such differences
_LIGHT_SIGMAS, _DIFFERENCE_SIGMAS = 3.0, 2.5  # beyond which pulls grow no more
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
    frames = np.concatenate(parts)
    ends = np.cumsum([len(part) for part in parts]).tolist()
    rows = [slice(end - len(part), end) for part, end in zip(parts, ends, strict=True)]
    lights = run.lights_of(frames)
    seen = all_finite(lights.uv_px) & lights.is_whole
    noise = np.where(seen[..., None, None], lights.cov_px2, 0.0) + usual_px[
        frames, None, None, None
    ] ** 2 * np.eye(2)
    weight = np.where(seen[..., None, None], np.linalg.inv(noise), 0.0)
    for _ in range(_STEPS):
        A, g = _by_lights(run, R, t_mm, lights.uv_px, weight, within)
        step = np.concatenate([_step(A[i], g[i], _differences(R[i], t_mm[i])) for i in rows])
        R, t_mm = R @ matrix_from_rvec(step[:, :3]), t_mm + step[:, 3:]
    return R, t_mm


def _by_lights(
    run: RunIdentities,
    R: FloatArray,
    t_mm: FloatArray,
    uv_px: FloatArray,
    weight: FloatArray,
    within: LedMotion,
) -> tuple[FloatArray, FloatArray]:
    """Return normal matrices (n, 6, 6) and right sides (n, 6) of poses, the twists taken out of them."""
    prediction, J = predict_brick(
        R[:, None] @ matrix_from_rvec(within.rvec_brick_rad),
        t_mm[:, None] + within.shift_camera_mm,
        run.ray_model,
        run.brick_model,
        collar_mm=run.collar_mm,
    )
    r = uv_px - prediction.uv_px
    shown = all_finite(r) & all_finite(J, 2) & (prediction.facing > 0)
    r, J = np.where(shown[..., None], r, 0.0), np.where(shown[..., None, None], J, 0.0)
    sigmas = np.sqrt(np.sum(r * (weight @ r[..., None])[..., 0], axis=-1))
    W = weight * np.minimum(1.0, _LIGHT_SIGMAS / np.maximum(sigmas, 1e-9))[..., None, None]
    J = np.concatenate([J, J * within.dt_s[..., None, None]], axis=-1)
    n = len(J)
    J, WJ, r = J.reshape(n, -1, 12), (W @ J).reshape(n, -1, 12), r.reshape(n, -1, 1)
    A = J.swapaxes(1, 2) @ WJ
    g = (WJ.swapaxes(1, 2) @ r)[..., 0]
    assert within.twist_sd is not None  # noqa: S101 - of a run
    A[:, range(6, 12), range(6, 12)] += 1 / within.twist_sd**2
    share = np.linalg.solve(A[:, 6:, 6:], A[:, 6:, :6])  # of the twist in what looks like a pose
    shared = np.swapaxes(share, 1, 2)
    return A[:, :6, :6] - A[:, :6, 6:] @ share, g[:, :6] - (shared @ g[:, 6:, None])[..., 0]


def _differences(R: FloatArray, t_mm: FloatArray) -> FloatArray:
    """Return how far frames are from the cubic through their four neighbours, (n - 4, 6), rad and mm."""
    x = np.concatenate([rvec_from_matrix(R[len(R) // 2].T @ R), t_mm], axis=1)
    n = len(x) - 4
    return np.asarray(sum(c * x[k : k + n] for k, c in enumerate(_DIFFERENCE)))


def _step(A: FloatArray, g: FloatArray, differences: FloatArray) -> FloatArray:
    """Return the steps of all poses, (n, 6), by their lights and the differences between them."""
    n, m = len(A), len(differences)
    size = np.stack(
        [np.linalg.norm(differences[:, :3], axis=1), np.linalg.norm(differences[:, 3:], axis=1)], axis=1
    )
    usual = np.clip(np.median(size, axis=0), _LEAST, _MOST)
    per = np.minimum(1.0, _DIFFERENCE_SIGMAS * usual / np.maximum(size, 1e-12)) / usual**2
    per = np.repeat(per, 3, axis=1)
    g = g.copy()
    banded = np.zeros((30, n, 6))  # the lower part: each row's distance below the diagonal
    for row in range(6):
        for column in range(row + 1):
            banded[row - column, :, column] += A[:, row, column]
    for a, ca in enumerate(_DIFFERENCE):
        g[a : a + m] -= ca * per * differences
        for b, cb in enumerate(_DIFFERENCE[: a + 1]):
            banded[6 * (a - b), b : b + m] += ca * cb * per
    banded[0] += 1e-9
    return np.asarray(solveh_banded(banded.reshape(30, -1), g.ravel(), lower=True).reshape(n, 6))
