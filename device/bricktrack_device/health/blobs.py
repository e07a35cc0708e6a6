"""Round bright spots in a picture, counted with numpy alone: enough to tell whether the LEDs are seen.

Tracking does this far better on the host; here one glance at one still must do.
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_device.interfaces import Still

FULL_LEVEL = 255.0
_WHITE_LUMA, _BLACK_LUMA = 235.0, 16.0
_MIN_ABOVE_BACKGROUND = 40.0
_MIN_DIAMETER_PX = 8.0
_ROUNDNESS = (0.75, 1.2)
_MIN_SHARE_OF_TYPICAL = 0.4


@dataclass(frozen=True, slots=True)
class Blob:
    """One bright spot, in pixels of the full picture.

    Attributes
    ----------
    u_px, v_px : float, px
        Middle of its pixels.
    width_px, height_px : float, px
    diameter_px : float, px
        Of the disc of the same area.
    peak : float
        The level that a tenth of its pixels reach, 0 to 255.
    saturated : float
        Share of its pixels at full level.
    """

    u_px: float
    v_px: float
    width_px: float
    height_px: float
    diameter_px: float
    peak: float
    saturated: float


def channel_levels(still: Still) -> FloatArray:
    """Return the level of the brightest of red, green and blue, shape (height/2, width/2), 0 to 255.

    Luma alone would call a red LED dark that saturates its channel. Limited range, BT.709.
    """
    h, w = (n // 2 for n in still.luma.shape)
    luma = still.luma[: 2 * h, : 2 * w].reshape(h, 2, w, 2).max(axis=(1, 3)).astype(np.float32)
    grey = (luma - _BLACK_LUMA) * (FULL_LEVEL / (_WHITE_LUMA - _BLACK_LUMA))
    cb = still.chroma_u[:h, :w].astype(np.float32) - 128
    cr = still.chroma_v[:h, :w].astype(np.float32) - 128
    red, green, blue = grey + 1.793 * cr, grey - 0.213 * cb - 0.533 * cr, grey + 2.112 * cb
    brightest = np.maximum(np.maximum(red, green), blue)
    return np.asarray(np.clip(brightest, 0, FULL_LEVEL), dtype=np.float64)


def find_blobs(levels: FloatArray) -> list[Blob]:
    """Return the round bright spots of a picture, from left to right.

    Parameters
    ----------
    levels : ndarray, shape (height/2, width/2), 0 to 255
        As from `channel_levels`.
    """
    background = float(np.median(levels))
    # The top thousandth: seven LEDs of 70 px take 1.3 % of a 1080p picture, one of 20 px a tenth of that.
    top = float(np.quantile(levels, 0.9999))
    if top - background < _MIN_ABOVE_BACKGROUND:
        return []
    threshold = background + 0.5 * (top - background)
    found = []
    for rows, columns in _components(levels > threshold):
        blob = _round_blob(levels, rows, columns)
        if blob is not None:
            found.append(blob)
    typical = float(np.median([b.diameter_px for b in found])) if found else 0.0
    alike = [b for b in found if b.diameter_px >= _MIN_SHARE_OF_TYPICAL * typical]
    return sorted(alike, key=lambda b: b.u_px)


def _round_blob(levels: FloatArray, rows: np.ndarray, columns: np.ndarray) -> Blob | None:
    height, width = int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1
    diameter = 2 * float(np.sqrt(rows.size / np.pi))
    fill = rows.size / (0.25 * np.pi * height * width)
    if 2 * diameter < _MIN_DIAMETER_PX or not 0.5 < height / width < 2:
        return None
    if not _ROUNDNESS[0] < fill < _ROUNDNESS[1]:
        return None
    values = levels[rows, columns]
    return Blob(
        u_px=2 * float(columns.mean()) + 0.5,
        v_px=2 * float(rows.mean()) + 0.5,
        width_px=2.0 * width,
        height_px=2.0 * height,
        diameter_px=2 * diameter,
        peak=float(np.quantile(values, 0.9)),
        saturated=float(np.mean(values >= FULL_LEVEL - 3)),
    )


def _components(mask: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return rows and columns of each connected part of a mask, 4-neighbourhood, by runs along rows."""
    edges = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row_of, start = np.nonzero(edges == 1)
    stop = np.nonzero(edges == -1)[1]
    parent = list(range(len(row_of)))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    above = 0
    for i, (row, a, b) in enumerate(zip(row_of.tolist(), start.tolist(), stop.tolist(), strict=True)):
        while row_of[above] < row - 1 or (row_of[above] == row - 1 and stop[above] <= a):
            above += 1
        j = above
        while j < i and row_of[j] == row - 1 and start[j] < b:
            parent[root(j)] = root(i)
            j += 1
    groups: dict[int, list[int]] = {}
    for i in range(len(parent)):
        groups.setdefault(root(i), []).append(i)
    parts = []
    for runs in groups.values():
        lengths = stop[runs] - start[runs]
        rows = np.repeat(row_of[runs], lengths)
        columns = np.concatenate([np.arange(start[i], stop[i]) for i in runs])
        parts.append((rows, columns))
    return parts
