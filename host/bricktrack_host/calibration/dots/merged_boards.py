"""One plane from several pictures of a board that was shifted or turned in it: more of the picture covered.

Pictures that overlap tell by how much the board was moved: there, the same pixels see the plane through
either board. A smooth map from pixels to the plane and the boards' motions are fitted together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dots.dot_observations import DotObservations
from bricktrack_host.calibration.dots.picture_region import ConvexRegion

MIN_OVERLAP = 20
"""So many dots of a board must lie among those of the others."""
MAX_MISFIT_STEPS = 0.02
"""Root mean square by which boards may disagree where they overlap, in dot spacings: 80 um of 4 mm."""
_N_ROUNDS = 4


@dataclass(frozen=True, slots=True, eq=False)
class MergedBoards:
    """Several boards as one.

    Attributes
    ----------
    dots : DotObservations
        All dots, in the millimetres of the first board.
    shifts_mm : ndarray, shape (boards, 2), mm
        Where each board's x = y = 0 lay; zero for the first.
    turns_deg : ndarray, shape (boards,)
    rms_mm : float, mm
        Distance of all dots to the smooth map, root mean square.
    """

    dots: DotObservations
    shifts_mm: FloatArray
    turns_deg: FloatArray
    rms_mm: float


def merge_boards(boards: Sequence[DotObservations]) -> MergedBoards:
    """Bring pictures of one plane, with the board moved in it, to the first one's millimetres.

    Parameters
    ----------
    boards : sequence of DotObservations
        Each in its own board's millimetres; the order matters only in that the first defines the origin.

    Raises
    ------
    CalibrationError
        If a board overlaps too little with the others, or disagrees with them.

    Notes
    -----
    The motions found err together for all dots of a board, by about the dots' own error over the root of
    their number; the dots' covariances do not hold that.
    """
    first = boards[0]
    step = _spacing_mm(first)
    motion: dict[int, tuple[FloatArray, FloatArray]] = {0: (np.eye(2), np.zeros(2))}
    while len(motion) < len(boards):
        uv = np.concatenate([boards[k].uv_px for k in motion])
        xy = np.concatenate([_moved(boards[k], motion[k]) for k in motion])
        # Hulls one by one: the hull of all would span what none has seen.
        hulls = [ConvexRegion.around(boards[k].uv_px) for k in motion]
        inside = {
            k: np.any([hull.contains(b.uv_px) for hull in hulls], axis=0)
            for k, b in enumerate(boards)
            if k not in motion
        }
        best = max(inside, key=lambda k: int(np.count_nonzero(inside[k])))
        n = int(np.count_nonzero(inside[best]))
        if n < MIN_OVERLAP:
            raise CalibrationError(
                f"board {best + 1} of {len(boards)}: {n} of its dots lie among those of the others, expected "
                f"at least {MIN_OVERLAP}; let the boards' places overlap more"
            )
        chosen = boards[best].select(inside[best])
        seen = _design(chosen.uv_px, uv) @ np.linalg.lstsq(_design(uv, uv), xy, rcond=None)[0]
        motion[best] = _rigid(chosen.xy_mm, seen)
    moves = [motion[k] for k in range(len(boards))]
    uv = np.concatenate([b.uv_px for b in boards])
    design = _design(uv, uv)
    ends = np.cumsum([0, *(len(b) for b in boards)])
    for _ in range(_N_ROUNDS if len(boards) > 1 else 0):
        xy = np.concatenate([_moved(b, m) for b, m in zip(boards, moves, strict=True)])
        moves = _refined(boards, moves, design, xy, ends)
    xy = np.concatenate([_moved(b, m) for b, m in zip(boards, moves, strict=True)])
    left = xy - design @ np.linalg.lstsq(design, xy, rcond=None)[0]
    rms = float(np.sqrt(np.mean(np.sum(left**2, axis=1))))
    if rms > MAX_MISFIT_STEPS * step:
        raise CalibrationError(
            f"{len(boards)} boards disagree by {1e3 * rms:.0f} µm where they overlap; expected less than "
            f"{1e3 * MAX_MISFIT_STEPS * step:.0f} µm: was a board moved out of the plane, or bent?"
        )
    sizes = [np.broadcast_to(np.asarray(b.size, dtype=np.float64), len(b)) for b in boards]
    merged = replace(
        first,
        uv_px=uv,
        xy_mm=xy,
        cov_px2=np.concatenate([b.cov_px2 for b in boards]),
        area_px2=np.concatenate([b.area_px2 for b in boards]),
        column_row=np.concatenate([b.column_row for b in boards]),
        size=np.concatenate(sizes),
    )
    turns = np.rad2deg([np.arctan2(R[1, 0], R[0, 0]) for R, _ in moves])
    return MergedBoards(merged, np.array([t for _, t in moves]), turns, rms)


def _spacing_mm(board: DotObservations) -> float:
    """Return the distance of neighbouring dots, from the area that one column and row take."""
    d_mm, d_steps = np.ptp(board.xy_mm, axis=0), np.ptp(board.column_row, axis=0)
    return float(np.hypot(*d_mm) / max(float(np.hypot(*d_steps)), 1.0))


def _moved(board: DotObservations, move: tuple[FloatArray, FloatArray]) -> FloatArray:
    R, t = move
    return np.asarray(board.xy_mm @ R.T + t)


def _design(at_px: FloatArray, of_px: FloatArray) -> FloatArray:
    """Return polynomial terms of the pixels ``at_px``, as many as the pixels ``of_px`` support."""
    order = max(q for q in (2, 3, 5, 7) if q == 2 or 2 * (q + 1) * (q + 2) <= len(of_px))
    middle, reach = of_px.mean(axis=0), np.abs(of_px - of_px.mean(axis=0)).max(axis=0)
    s, t = ((at_px - middle) / reach).T
    return np.stack([s**i * t**j for i in range(order + 1) for j in range(order + 1 - i)], axis=1)


def _rigid(from_mm: FloatArray, to_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the turn and the shift that bring points to others best."""
    a, b = from_mm - from_mm.mean(axis=0), to_mm - to_mm.mean(axis=0)
    angle = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return R, np.asarray(to_mm.mean(axis=0) - R @ from_mm.mean(axis=0))


def _refined(
    boards: Sequence[DotObservations],
    moves: list[tuple[FloatArray, FloatArray]],
    design: FloatArray,
    xy: FloatArray,
    ends: FloatArray,
) -> list[tuple[FloatArray, FloatArray]]:
    """Return the motions after one joint step: ``map(uv) = xy + shift + angle * (-y, x)`` for each board."""
    n, m = design.shape
    A = np.zeros((2 * n, 2 * m + 3 * (len(boards) - 1)))
    A[:n, :m] = design
    A[n:, m : 2 * m] = design
    for k in range(1, len(boards)):
        rows, column = slice(int(ends[k]), int(ends[k + 1])), 2 * m + 3 * (k - 1)
        A[:n][rows, column], A[n:][rows, column + 1] = -1.0, -1.0
        relative = xy[rows] - moves[k][1]
        A[:n][rows, column + 2], A[n:][rows, column + 2] = relative[:, 1], -relative[:, 0]
    solved = np.linalg.lstsq(A, xy.T.ravel(), rcond=None)[0][2 * m :]
    refined = [moves[0]]
    for (R, t), (dx, dy, angle) in zip(moves[1:], solved.reshape(-1, 3), strict=True):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        refined.append((turn @ R, t + np.array([dx, dy])))
    return refined
