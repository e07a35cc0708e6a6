"""Grow a square grid over dots: each one's column and row, counted from wherever growth began.

From a seed, dot by dot, each prediction is made from the neighbours already placed: lens distortion, a tilted
board and one cut by the picture's border change the step only slowly. The result is then checked as a whole:
a grid that slipped by a step across a gap is torn, and refused.
"""

from collections import deque
from collections.abc import Iterator

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dots.neighbours import Neighbours

MIN_DOTS = 16
CATCH_STEPS = 0.3
"""A dot is taken within this share of a grid step from where its neighbours predict it."""
MAX_BEND_STEPS = 0.15
"""Largest second difference along a row or column; dots that bend more are not of the grid."""
MAX_OFF_SMOOTH_STEPS = 0.25
"""Farthest from a smooth map of the whole picture; a grid that slipped is half a step off somewhere."""
MAX_SHARE_OFF_SMOOTH = 0.03
MIN_STRAY_STEPS = 0.04
STRAY_SIGMAS = 8.0
"""A dot farther than this from the smooth map is a reflection in a dot's stead."""
MAX_SEEDS = 12
ENOUGH_PLACED = 0.8


def grow_grid(uv: FloatArray, near: FloatArray, *, max_turn_deg: float | None) -> tuple[IntArray, BoolArray]:
    """Give dots their places in one grid.

    Parameters
    ----------
    uv : ndarray, shape (n, 2), px
    near : ndarray, shape (2,), px
        Where to begin.
    max_turn_deg : float or None
        Refuse a grid whose rows run farther than this from the picture's.

    Returns
    -------
    place : ndarray of int64, shape (n, 2)
        Column and row, counted from the seed; columns run within 45 degrees of +u, rows of +v.
    placed : ndarray of bool, shape (n,)
        Which dots have a place; ``place`` of the others means nothing.

    Raises
    ------
    CalibrationError
        If no dot has the neighbours of a square grid, the grid is turned too far, or not smooth.
    """
    tree = Neighbours(uv)
    best: tuple[IntArray, BoolArray] | None = None
    for _, (seed, steps) in zip(range(MAX_SEEDS), _seeds(uv, tree, near, max_turn_deg), strict=False):
        place, placed = _grow(uv, tree, seed, steps)
        take_in_islands(uv, place, placed)
        if best is None or np.count_nonzero(placed) > np.count_nonzero(best[1]):
            best = place, placed
        if np.count_nonzero(placed) >= ENOUGH_PLACED * len(uv):
            break
    if best is None:
        raise CalibrationError(
            f"no grid found: none of {len(uv)} dots has four neighbours at a square's distances; expected a "
            "square grid of equal dots"
        )
    place, placed = best
    _drop_bent(uv, place, placed)
    _require_smooth(uv, place, placed)
    return place, placed


def _grow(uv: FloatArray, tree: Neighbours, seed: int, steps: FloatArray) -> tuple[IntArray, BoolArray]:
    """Return column and row, shape (n, 2), of the dots reached from a seed, and which were reached."""
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


def _seeds(
    uv: FloatArray, tree: Neighbours, near: FloatArray, max_turn_deg: float | None
) -> Iterator[tuple[int, FloatArray]]:
    """Yield dots with four regular neighbours, and their steps along columns and rows, shape (2, 2)."""
    order = np.argsort(np.hypot(*(uv - near).T))
    _, neighbours = tree.nearest(uv, min(9, len(uv)))
    turned: float | None = None
    n_found = 0
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
        # The grid's turn is the mean of both axes': a tilted board shears them apart.
        turn = float(np.rad2deg((np.arctan2(along_u[1], along_u[0]) + np.arctan2(-other[0], other[1])) / 2))
        if max_turn_deg is not None and abs(turn) > max_turn_deg:
            turned = turn
            continue
        n_found += 1
        yield int(k), np.stack([along_u, other])
    if not n_found and turned is not None:
        raise CalibrationError(
            f"the grid is turned by {abs(turned):.0f} degrees: rows and columns cannot be told apart; turn "
            "the board or the picture so that the rows run within 44 degrees of the picture's, or print a "
            "coded target"
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


def grid_coordinates(
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


def take_in_islands(uv: FloatArray, place: IntArray, placed: BoolArray) -> None:
    """Place dots that growth did not reach, across gaps of up to three steps (glare, a hidden dot)."""
    for _ in range(20):
        rest = np.flatnonzero(~placed)
        if len(rest) == 0 or np.count_nonzero(placed) < MIN_DOTS:
            return
        coordinates, steps_away = grid_coordinates(uv[placed], place[placed], uv[rest])
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


def _require_smooth(uv: FloatArray, place: IntArray, placed: BoolArray) -> None:
    """Take out single dots off a smooth map from pixels to the grid; refuse a grid that is torn."""
    n = int(np.count_nonzero(placed))
    if n < MIN_DOTS:
        return
    order = max(q for q in (2, 3, 5) if q == 2 or 2 * (q + 1) * (q + 2) <= n)
    middle, reach = uv[placed].mean(axis=0), np.ptp(uv[placed], axis=0).max() / 2
    s, t = ((uv - middle) / reach).T
    design = np.stack([s**i * t**j for i in range(order + 1) for j in range(order + 1 - i)], axis=1)
    limit = max(2.0, MAX_SHARE_OFF_SMOOTH * n)
    kept = placed.copy()
    while True:
        c = np.linalg.lstsq(design[kept], place[kept].astype(np.float64), rcond=None)[0]
        off = np.where(kept, np.hypot(*(design @ c - place).T), 0.0)
        if off.max() <= MAX_OFF_SMOOTH_STEPS:
            break
        kept &= off < max(MAX_OFF_SMOOTH_STEPS, 0.5 * off.max())
        if n - np.count_nonzero(kept) > limit:
            u, v = uv[int(np.argmax(off))]
            raise CalibrationError(
                f"the grid is torn near pixel ({u:.0f}, {v:.0f}): its columns or rows were miscounted across "
                "a gap, or there is more than one target; uncover the dots there, or take out reflections"
            )
    sigma = float(np.median(off[kept])) / 1.1774  # of the distance of two equal normal errors
    placed &= kept & (off <= max(MIN_STRAY_STEPS, STRAY_SIGMAS * sigma))
