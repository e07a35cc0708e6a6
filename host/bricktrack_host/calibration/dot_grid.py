"""Give each dot of a target picture its column and row, and from an origin its place in millimetres.

The grid is grown from a seed, dot by dot, each prediction made from the neighbours already placed: lens
distortion, a tilted board and one cut by the picture's border change the step only slowly. The result is
then checked as a whole, and whatever leaves a doubt is refused: a grid off by one column fits as well.
"""

from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dot_detection import Dots
from bricktrack_host.calibration.dot_observations import DotObservations
from bricktrack_host.calibration.neighbours import Neighbours

MIN_DOTS = 16
CATCH_STEPS = 0.3
"""A dot is taken within this share of a grid step from where its neighbours predict it."""
MAX_BEND_STEPS = 0.15
"""Largest second difference along a row or column; dots that bend more are not of the grid."""
MAX_TURN_DEG = 44.5
"""Beyond this turn of the board, rows and columns cannot be told apart."""
MAX_OFF_LATTICE_STEPS = 0.4
"""A given origin farther than this from the nearest candidate is as good as at the next one."""
MIN_SHARE_PLACED = 0.6


@dataclass(frozen=True, slots=True)
class GridOrigin:
    """Where x = y = 0 lies on the target.

    Attributes
    ----------
    near_px : (float, float), px
        A pixel close to it.
    at : "centre" or "dot"
        "centre": the target's centre: a dot where the count is odd, midway between two where it is even, on
        either axis. "dot": the dot nearest to the pixel, whatever its place on the target.
    """

    near_px: tuple[float, float]
    at: Literal["centre", "dot"] = "centre"


def assign_grid(
    dots: Dots, *, pitch_mm: float, columns: int, rows: int, origin: GridOrigin
) -> DotObservations:
    """Place the dots on the target.

    Parameters
    ----------
    dots : Dots
        Cut ones are left out unless their centre was completed.
    pitch_mm : float, mm
        Distance of neighbouring dots.
    columns, rows : int
        Size of the whole target, of which the picture may show a part.
    origin : GridOrigin

    Returns
    -------
    DotObservations
        x along the columns (that direction of the grid within 45 degrees of +u), y along the rows (+v).

    Raises
    ------
    CalibrationError
        If the dots are too few, form no grid, or the grid or its origin is ambiguous.
    """
    if not (pitch_mm > 0 and columns >= 2 and rows >= 2):
        raise CalibrationError(
            f"target of {columns} x {rows} dots at {pitch_mm:g} mm: expected two or more columns and rows "
            "and a positive pitch"
        )
    dots = dots.select(~dots.touches_border | dots.is_completed)
    if len(dots) < MIN_DOTS:
        raise CalibrationError(
            f"{len(dots)} whole dots found, expected at least {MIN_DOTS} of the {columns} x {rows}; "
            "check that the target fills the picture, is in focus and evenly lit"
        )
    near = np.asarray(origin.near_px, dtype=np.float64)
    place, placed = _grow(dots.uv_px, near)
    _take_in_islands(dots.uv_px, place, placed)
    _drop_bent(dots.uv_px, place, placed)
    n_placed = int(np.count_nonzero(placed))
    if n_placed < max(MIN_DOTS, MIN_SHARE_PLACED * len(dots)):
        raise CalibrationError(
            f"only {n_placed} of {len(dots)} dots form one grid; is there more than one target, or a pattern "
            "other than a square grid?"
        )
    ij = place[placed]
    seen = ij.max(axis=0) - ij.min(axis=0) + 1
    if seen[0] > columns or seen[1] > rows:
        raise CalibrationError(
            f"the grid found has {seen[0]} columns and {seen[1]} rows, the target only {columns} x {rows}; "
            "check the target's numbers and that no other dots are in view"
        )
    zero = _origin_steps(dots.uv_px[placed], ij, near, columns=columns, rows=rows, at=origin.at)
    chosen = dots.select(placed)
    return DotObservations(
        uv_px=chosen.uv_px,
        xy_mm=(ij - zero) * pitch_mm,
        cov_px2=chosen.cov_px2,
        area_px2=chosen.area_px2,
        column_row=ij - ij.min(axis=0),
    )


def _grow(uv: FloatArray, near: FloatArray) -> tuple[IntArray, BoolArray]:
    """Return column and row, shape (n, 2), of the dots reached from a seed, and which were reached."""
    tree = Neighbours(uv)
    seed, steps = _seed(uv, tree, near)
    place = np.zeros((len(uv), 2), dtype=np.int64)
    placed = np.zeros(len(uv), dtype=np.bool_)
    placed[seed] = True
    at: dict[tuple[int, int], int] = {(0, 0): seed}
    step_of: dict[int, FloatArray] = {seed: steps}
    queue = deque([seed])
    while queue:
        k = queue.popleft()
        i, j = int(place[k, 0]), int(place[k, 1])
        steps = _local_steps(uv, at, (i, j), step_of[k])
        for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            target = (i + di, j + dj)
            if target in at:
                continue
            axis = 0 if di else 1
            step = steps[axis] * (di + dj)
            distances, indices = tree.nearest((uv[k] + step)[None], 1)
            found = int(indices[0, 0])
            if distances[0, 0] > CATCH_STEPS * float(np.hypot(*step)) or placed[found]:
                continue
            place[found], placed[found] = target, True
            at[target] = found
            step_of[found] = steps
            queue.append(found)
    return place, placed


def _seed(uv: FloatArray, tree: Neighbours, near: FloatArray) -> tuple[int, FloatArray]:
    """Return a dot with four regular neighbours, and its steps along columns and rows, shape (2, 2)."""
    order = np.argsort(np.hypot(*(uv - near).T))
    _, neighbours = tree.nearest(uv, 9)
    turned: float | None = None
    for k in order:
        d = uv[neighbours[k, 1:]] - uv[k]
        length = np.hypot(d[:, 0], d[:, 1])
        shortest = float(length[0])
        if shortest == 0:
            continue
        cosine = (d @ d[0]) / (length * shortest)
        square = np.flatnonzero((np.abs(cosine) < 0.35) & (length < 1.6 * shortest))
        if not len(square):
            continue
        first, second = d[0], d[square[0]]
        opposite = [
            float(np.hypot(*(d + e).T).min()) < CATCH_STEPS * float(np.hypot(*e)) for e in (first, second)
        ]
        if not all(opposite):
            continue
        along_u = max((first, second, -first, -second), key=lambda e: float(e[0] / np.hypot(*e)))
        other = second if abs(float(np.dot(along_u, first))) > abs(float(np.dot(along_u, second))) else first
        if along_u[0] * other[1] - along_u[1] * other[0] < 0:
            other = -other
        steps = np.stack([along_u, other])
        # The grid's turn is the mean of both axes': a tilted board shears them apart.
        turn = float(np.rad2deg((np.arctan2(along_u[1], along_u[0]) + np.arctan2(-other[0], other[1])) / 2))
        if abs(turn) > MAX_TURN_DEG:
            turned = turn
            continue
        return int(k), steps
    if turned is not None:
        raise CalibrationError(
            f"the grid is turned by {abs(turned):.0f} degrees: rows and columns cannot be told apart; turn "
            "the board or the picture so that the rows run within 44 degrees of the picture's"
        )
    raise CalibrationError(
        f"no grid found: none of {len(uv)} dots has four neighbours at a square's distances; expected a "
        "square grid of equal dots"
    )


def _local_steps(
    uv: FloatArray, at: dict[tuple[int, int], int], ij: tuple[int, int], inherited: FloatArray
) -> FloatArray:
    """Return the steps along columns and rows at a placed dot, from its placed neighbours."""
    steps = inherited.copy()
    here = uv[at[ij]]
    for axis, (di, dj) in enumerate(((1, 0), (0, 1))):
        ahead, behind = at.get((ij[0] + di, ij[1] + dj)), at.get((ij[0] - di, ij[1] - dj))
        if ahead is not None and behind is not None:
            steps[axis] = (uv[ahead] - uv[behind]) / 2
        elif ahead is not None:
            steps[axis] = uv[ahead] - here
        elif behind is not None:
            steps[axis] = here - uv[behind]
    return steps


def _grid_coordinates(
    uv: FloatArray, ij: IntArray, at_px: FloatArray, *, k: int = 12
) -> tuple[FloatArray, FloatArray]:
    """Return the grid coordinates of pixels, shape (n, 2), and the nearest dot's distance in steps.

    An affine map fitted to the nearest placed dots, weighted towards the nearest.
    """
    k = min(k, len(uv))
    distance, near = Neighbours(uv).nearest(at_px, k)
    width = distance[:, -1:] + 1e-9
    w = np.sqrt(1 / (0.05 + (distance / width) ** 2))[..., None]
    d_uv = uv[near] - at_px[:, None]
    design = w * np.concatenate([np.ones((*distance.shape, 1)), d_uv / width[..., None]], axis=2)
    wanted = w * ij[near].astype(np.float64)
    fit = np.linalg.pinv(design) @ wanted
    step_px = width[:, 0] / np.maximum(np.abs(np.linalg.det(fit[:, 1:])) ** 0.5, 1e-9)
    return fit[:, 0], distance[:, 0] / step_px


def _take_in_islands(uv: FloatArray, place: IntArray, placed: BoolArray) -> None:
    """Place dots that growth did not reach, across gaps of up to three steps (glare, a hidden dot)."""
    for _ in range(20):
        rest = np.flatnonzero(~placed)
        if len(rest) == 0 or np.count_nonzero(placed) < MIN_DOTS:
            return
        coordinates, steps_away = _grid_coordinates(uv[placed], place[placed], uv[rest])
        nearest = np.rint(coordinates).astype(np.int64)
        off = np.abs(coordinates - nearest).max(axis=1)
        taken = {(int(a), int(b)) for a, b in place[placed]}
        changed = False
        for k in np.argsort(off):
            key = (int(nearest[k, 0]), int(nearest[k, 1]))
            if off[k] > 0.2 or steps_away[k] > 3.5 or key in taken:
                continue
            taken.add(key)
            place[rest[k]], placed[rest[k]] = key, True
            changed = True
        if not changed:
            return


def _drop_bent(uv: FloatArray, place: IntArray, placed: BoolArray) -> None:
    """Take out dots that break the smooth course of their row or column: specks taken for dots.

    In a broken triple the culprit is the dot with most broken triples around it.
    """
    while True:
        at = {(int(i), int(j)): k for k, (i, j) in enumerate(place) if placed[k]}
        broken = np.zeros(len(uv), dtype=np.int64)
        for (i, j), k in at.items():
            for di, dj in ((1, 0), (0, 1)):
                ahead, behind = at.get((i + di, j + dj)), at.get((i - di, j - dj))
                if ahead is None or behind is None:
                    continue
                bend = np.hypot(*(uv[ahead] - 2 * uv[k] + uv[behind]))
                if bend > MAX_BEND_STEPS * np.hypot(*(uv[ahead] - uv[behind])) / 2:
                    broken[k] += 2
                    broken[ahead] += 1
                    broken[behind] += 1
        if not broken.any():
            return
        placed[int(np.argmax(broken))] = False


def _origin_steps(
    uv: FloatArray,
    ij: IntArray,
    near: FloatArray,
    *,
    columns: int,
    rows: int,
    at: Literal["centre", "dot"],
) -> FloatArray:
    """Return the grid coordinates, shape (2,), of the origin."""
    coordinates, _ = _grid_coordinates(uv, ij, near[None])
    asked = coordinates[0]
    where = f"origin near pixel ({near[0]:g}, {near[1]:g})"
    low, high = ij.min(axis=0), ij.max(axis=0)
    if np.any(asked < low - 0.5) or np.any(asked > high + 0.5):
        raise CalibrationError(f"{where} lies outside the dots found; give a pixel among them")
    count = np.array([columns, rows])
    offset = np.where(count % 2 == 0, 0.5, 0.0) if at == "centre" else np.zeros(2)
    zero = np.rint(asked - offset) + offset
    if np.any(np.abs(asked - zero) > MAX_OFF_LATTICE_STEPS):
        raise CalibrationError(
            f"{where} is ambiguous: it lies midway between two candidates; give a pixel nearer to the "
            + ("target's centre" if at == "centre" else "dot that is meant")
        )
    if at == "dot":
        if not np.any(np.all(ij == zero, axis=1)):
            raise CalibrationError(f"{where}: no whole dot was found there")
        return np.asarray(zero, dtype=np.float64)
    half = (count - 1) / 2
    if np.any(low < zero - half) or np.any(high > zero + half):
        seen = high - low + 1
        fits = np.clip(zero, high - half, low + half)
        k = np.argsort(np.abs(ij - fits).max(axis=1))[:4]
        u, v = uv[k].mean(axis=0)
        raise CalibrationError(
            f"{where} cannot be the centre of a target of {columns} x {rows}: the {seen[0]} x {seen[1]} dots "
            f"found would reach past its rim. The nearest centre that fits is near pixel ({u:.0f}, {v:.0f}); "
            "check the target's numbers, or nominate a dot as the origin"
        )
    return np.asarray(zero, dtype=np.float64)
