"""Other people's calibrations, fitted to the same dots as ours: OpenCV's and, where it is installed, mrcal's."""

import json
import os
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares

MRCAL_SCRIPT = Path(__file__).resolve().parent / "mrcal_splined.py"
FLAGS = cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL | cv2.CALIB_TILTED_MODEL
UNDISTORT = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 500, 1e-12)


@dataclass
class OpenCvRays:
    """OpenCV's camera in the rig's frame: ``p_camera = R p_rig + t``."""

    K: np.ndarray
    distortion: np.ndarray
    R: np.ndarray
    t_mm: np.ndarray

    def points_on_plane(self, uv_px, z_mm):
        """Return the points (x, y), shape (n, 2), mm, that pixels see on the plane z of the rig."""
        ideal = cv2.undistortPoints(
            np.ascontiguousarray(uv_px, dtype=np.float64)[:, None],
            self.K,
            self.distortion,
            criteria=UNDISTORT,
        )[:, 0]
        direction = np.column_stack([ideal, np.ones(len(ideal))]) @ self.R
        centre = -self.R.T @ self.t_mm
        reach = (np.broadcast_to(z_mm, len(ideal)) - centre[2]) / direction[:, 2]
        return centre[:2] + reach[:, None] * direction[:, :2]


def opencv_fits() -> dict[str, Callable]:
    """Return OpenCV's 14 coefficients with the planes' poses found by it, and given to it."""
    return {"OpenCV, 14 coefficients, free poses": _free, "OpenCV, 14 coefficients, given poses": _given}


def _free(planes, size):
    boards = [np.column_stack([d.xy_mm, np.zeros(len(d))]).astype(np.float32)[:, None] for _, d in planes]
    seen = [d.uv_px.astype(np.float32)[:, None] for _, d in planes]
    K = np.array([[1600.0, 0, (size[0] - 1) / 2], [0, 1600.0, (size[1] - 1) / 2], [0, 0, 1]])
    _, K, distortion, turns, shifts = cv2.calibrateCamera(
        boards, seen, size, K, None, flags=FLAGS | cv2.CALIB_USE_INTRINSIC_GUESS
    )
    # The rig's frame is the near board's, whose plane is z = a.
    R = cv2.Rodrigues(turns[0])[0]
    t = shifts[0][:, 0] - R @ [0, 0, planes[0][0]]
    return OpenCvRays(K, distortion, R, t)


def _given(planes, size):
    """Fit its projection by least squares: `calibrateCamera` takes no poses."""
    boards = [np.column_stack([d.xy_mm, np.full(len(d), z)]) for z, d in planes]

    def projected(p):
        K = np.array([[p[0], 0, p[2]], [0, p[1], p[3]], [0, 0, 1]])
        return np.concatenate(
            [cv2.projectPoints(b, np.zeros(3), p[4:7], K, p[7:21])[0][:, 0] for b in boards]
        )

    seen = np.concatenate([d.uv_px for _, d in planes])
    start = np.array([1600.0, 1600, (size[0] - 1) / 2, (size[1] - 1) / 2, *np.zeros(17)])
    scale = np.array([1e3, 1e3, 1e2, 1e2, 1, 1, 1, *np.full(14, 0.1)])
    p = least_squares(lambda p: (projected(p) - seen).ravel(), start, x_scale=scale, method="lm").x
    K = np.array([[p[0], 0, p[2]], [0, p[1], p[3]], [0, 0, 1]])
    return OpenCvRays(K, p[7:21], np.eye(3), p[4:7])


@dataclass
class MrcalRays:
    """Central rays from mrcal: unit slopes looked up by asking it again."""

    command: list[str]
    model: str

    def points_on_plane(self, uv_px, z_mm):
        """Return the points (x, y), shape (n, 2), mm, that pixels see on the plane z of the rig."""
        answer = _ask(self.command, {"do": "unproject", "model": self.model, "uv_px": uv_px.tolist()})
        direction, centre = np.array(answer["direction"]), np.array(answer["centre_mm"])
        reach = (np.broadcast_to(z_mm, len(direction)) - centre[2]) / direction[:, 2]
        return centre[:2] + reach[:, None] * direction[:, :2]


def mrcal_fit() -> Callable | None:
    """Return mrcal's splined model's fit with poses given, or None where no Python with mrcal is found."""
    command = os.environ.get("BRICKTRACK_MRCAL_PYTHON", "/usr/bin/python3").split()
    try:
        if subprocess.run([*command, "-c", "import mrcal"], capture_output=True, check=False).returncode:
            return None
    except OSError:
        return None

    def fit(planes, size):
        question = {
            "do": "fit",
            "size": list(size),
            "planes": [{"z_mm": z, "xy_mm": d.xy_mm.tolist(), "uv_px": d.uv_px.tolist()} for z, d in planes],
        }
        return MrcalRays(command, _ask(command, question)["model"])

    return fit


def _ask(command, question):
    done = subprocess.run(
        [*command, str(MRCAL_SCRIPT)], input=json.dumps(question), capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"mrcal failed: {done.stderr[-800:]}")
    return json.loads(done.stdout)
