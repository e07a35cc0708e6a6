"""Solvers of others for `bench_pose.py`, which take one frame at a time and are given the true lens."""

import sys
from collections.abc import Callable

import cv2
import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.evaluation.true_camera import TrueCamera

Solver = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray] | None]
"""LEDs (n, 3), mm, and their true slopes x/z, y/z (n, 2) -> R and t, or None."""


def other_solvers() -> dict[str, Solver]:
    """Return OpenCV's solvers and, where installed, PoseLib's."""
    unit = np.eye(3)

    def refined(p: FloatArray, s: FloatArray, ok: bool, r: FloatArray, t: FloatArray) -> bool:
        if ok:
            cv2.solvePnPRefineLM(p, s, unit, None, r, t)
        return ok

    def opencv(flag: int, *, then_lm: bool) -> Solver:
        def solve(p: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray] | None:
            use = slice(None)
            if flag == cv2.SOLVEPNP_IPPE:  # planar points only: the six that are, then all by LM
                use = np.flatnonzero(np.abs(p[:, 2]) < 1e-6)
            try:
                ok, r, t = cv2.solvePnP(p[use], s[use], unit, None, flags=flag)
            except cv2.error:
                return None
            if then_lm:
                refined(p, s, ok, r, t)
            return (cv2.Rodrigues(r)[0], t.ravel()) if ok else None

        return solve

    solvers = {
        "OpenCV SQPNP": opencv(cv2.SOLVEPNP_SQPNP, then_lm=False),
        "OpenCV EPNP": opencv(cv2.SOLVEPNP_EPNP, then_lm=False),
        "OpenCV IPPE, LM": opencv(cv2.SOLVEPNP_IPPE, then_lm=True),
    }
    try:
        import poselib
    except ImportError:
        print("PoseLib is not installed (pip install poselib): left out", file=sys.stderr)
        return solvers
    focal = 1600.0  # its thresholds are in pixels
    model = {"model": "SIMPLE_PINHOLE", "width": 1920, "height": 1080, "params": [focal, 0.0, 0.0]}

    def by_poselib(p: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        options = {"max_reproj_error": 5.0, "max_error": 5.0}
        pose, _ = poselib.estimate_absolute_pose(list(s * focal), list(p), model, options, {})
        return np.asarray(pose.R), np.asarray(pose.t)

    solvers["PoseLib"] = by_poselib
    return solvers


def each(
    uv: FloatArray, places_mm: FloatArray, camera: TrueCamera, solve: Solver
) -> tuple[FloatArray, FloatArray]:
    """Solve frame by frame with the true lens taken off; NaN where a solver has no pose.

    Parameters
    ----------
    uv : ndarray, shape (n, n_leds, 2), px
    places_mm : ndarray, shape (n_leds, 3)
        Of the LEDs, in brick coordinates.

    Returns
    -------
    R_camera_brick : ndarray, shape (n, 3, 3)
    t_camera_brick_mm : ndarray, shape (n, 3)
    """
    n = len(uv)
    R, t = np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan)
    slopes = true_slopes(camera, uv)
    for i in range(n):
        found = solve(places_mm, slopes[i])
        if found is not None:
            R[i], t[i] = found
    return R, t


def true_slopes(camera: TrueCamera, uv: FloatArray) -> FloatArray:
    """Return x/z and y/z of pixels, (..., 2): the true lens inverted by Newton's method, to 1e-12."""
    s = (uv - [camera.cx_px, camera.cy_px]) / camera.focal_px

    def at(slopes: FloatArray) -> FloatArray:
        return camera.project(np.concatenate([slopes, np.ones((*slopes.shape[:-1], 1))], axis=-1))

    for _ in range(6):
        h = 1e-5
        J = np.stack([(at(s + h * e) - at(s - h * e)) / (2 * h) for e in np.eye(2)], axis=-1)
        s = s + np.linalg.solve(J, (uv - at(s))[..., None])[..., 0]
    return s
