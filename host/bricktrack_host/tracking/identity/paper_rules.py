"""The source paper's rules for its layout: which blob is which LED, by lines and distances alone."""

from itertools import combinations

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray, as_float_array
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_host.tracking.identity.assigned_lights import RunLights
from bricktrack_host.tracking.identity.verification import (
    Correspondence,
    no_correspondence,
    verified_correspondence,
    verify,
)
from bricktrack_host.tracking.pictures.segment import Blobs


def identify_by_paper(
    blobs: Blobs, ray_model: RayModel, brick_model: BrickModel, *, collar_mm: float | None, gate_px: float
) -> Correspondence:
    """Identify seven LEDs by the paper's rules and verify by reprojection."""
    if not is_paper_layout(brick_model):
        return no_correspondence(brick_model.n_leds, "not the paper's layout")
    hypotheses = paper_hypotheses(blobs, ray_model)
    if len(hypotheses) == 0:
        return no_correspondence(brick_model.n_leds, "no seven blobs obey the paper's rules")
    verified = verify(
        RunLights.of([blobs]).of_leds(np.zeros(len(hypotheses), dtype=np.int64), hypotheses),
        None,
        ray_model,
        brick_model,
        collar_mm=collar_mm,
        gate_px=gate_px,
    )
    whole = np.flatnonzero(verified.kept.all(axis=1))
    if len(whole) == 0:
        return no_correspondence(brick_model.n_leds, "reprojection refutes the paper's rules")
    best = int(whole[np.argmax(verified.log_evidence[whole])])
    return verified_correspondence(hypotheses[best], verified.poses, best)


def is_paper_layout(brick_model: BrickModel) -> bool:
    """Tell whether the paper's rules apply: seven LEDs, of which 0, 3, 4, 5 stand in one line."""
    if brick_model.n_leds != 7:
        return False
    column = brick_model.led_positions_mm[[0, 3, 4, 5]]
    return bool(np.linalg.svd(column - column.mean(axis=0), compute_uv=False)[1] < 0.5)


def paper_correspondence(points_mm: FloatArray, *, angle_limit_deg: float = 1.0) -> IntArray | None:
    """Identify seven LEDs by the paper's rules.

    Parameters
    ----------
    points_mm : array_like, shape (7, 2), mm
        Hits of the blobs' rays on a calibrated plane: in raw pixels distortion bends the column.
    angle_limit_deg : float
        Largest deviation from 0 or 180 degrees between directions inside the column.

    Returns
    -------
    blob_of_led : ndarray of int64, shape (7,), or None
        `None` where not exactly one set of four blobs is in line. The rules can answer wrongly (4 % of
        orientations with three simultaneous angles up to 45 degrees): verify the answer.
    """
    points = as_float_array("points_mm", points_mm, (7, 2))
    columns = [c for c in combinations(range(7), 4) if _bend_deg(points[list(c)]) <= angle_limit_deg]
    if len(columns) != 1:
        return None
    column = list(columns[0])
    others = [i for i in range(7) if i not in column]
    chebyshev = np.abs(points[:, None] - points[None]).max(axis=-1)
    m6 = max(others, key=lambda i: float(chebyshev[i, others].sum()))
    pair = [i for i in others if i != m6]
    m1, m2 = sorted(pair, key=lambda i: float(chebyshev[i, column].min()))
    m5 = max(column, key=lambda i: float(chebyshev[i, [m1, m2]].sum()))
    m4, m3, m0 = sorted((i for i in column if i != m5), key=lambda i: float(chebyshev[i, m5]))
    return np.array([m0, m1, m2, m3, m4, m5, m6], dtype=np.int64)


def paper_hypotheses(blobs: Blobs, ray_model: RayModel) -> IntArray:
    """Return what the paper's rules make of every choice of seven blobs, shape (n, 7); see `verify`.

    The paper's filter lets a few reflections pass; its rules want seven points. More than ten blobs: none.
    """
    if not 7 <= len(blobs) <= 10:
        return np.empty((0, 7), dtype=np.int64)
    middle_mm = 0.5 * (ray_model.plane_a_mm + ray_model.plane_b_mm)
    points = ray_model.points_on_plane(blobs.uv_px, middle_mm)
    found = []
    for chosen in combinations(range(len(blobs)), 7):
        index = np.array(chosen, dtype=np.int64)
        answer = paper_correspondence(points[index])
        if answer is not None:
            found.append(index[answer])
    return np.array(found, dtype=np.int64).reshape(-1, 7)


def _bend_deg(points: FloatArray) -> float:
    """Return the largest angle, modulo 180 degrees, between the directions from the first point by u."""
    ordered = points[np.lexsort((points[:, 1], points[:, 0]))]
    d = ordered[1:] - ordered[0]
    angles = np.degrees(np.arctan2(d[:, 1], d[:, 0]))
    apart = np.abs(angles[:, None] - angles[None]) % 180.0
    return float(np.minimum(apart, 180.0 - apart).max())
