"""Histograms as text, because a unit has a terminal and no plotting library."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

_EIGHTHS = " ▏▎▍▌▋▊▉█"
_WIDTH = 40


def text_histogram(
    values: ArrayLike, *, unit: str, n_bins: int = 16, limits: tuple[float, float] | None = None
) -> list[str]:
    """Return the lines of a histogram, one a bin: its middle, a bar, its count.

    Parameters
    ----------
    values : array_like, shape (n,)
        What is not finite is left out.
    unit : str
        Stands behind each middle.
    n_bins : int
    limits : (float, float) or None
        `None` takes the values' own; what lies outside is counted in two lines of their own.

    Examples
    --------
    >>> for line in text_histogram([1, 1, 1, 2, 2, 3.9], unit="ms", n_bins=3, limits=(0.5, 3.5)):
    ...     print(line)
          1 ms ████████████████████████████████████████ 3
          2 ms ██████████████████████████▋ 2
          3 ms  0
    above 3.5 ms: 1
    """
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    if not finite.size:
        return ["no values"]
    low, high = limits or (float(finite.min()), float(finite.max()))
    if low == high:
        low, high = low - 0.5, high + 0.5
    counts, edges = np.histogram(finite, bins=n_bins, range=(low, high))
    lines = _bars(0.5 * (edges[:-1] + edges[1:]), counts.tolist(), unit)
    below, above = int(np.sum(finite < low)), int(np.sum(finite > high))
    if below:
        lines.insert(0, f"below {low:.4g} {unit}: {below}")
    if above:
        lines.append(f"above {high:.4g} {unit}: {above}")
    return lines


def _bars(middles: ArrayLike, counts: Sequence[int], unit: str) -> list[str]:
    most = max(counts) or 1
    lines = []
    for middle, count in zip(np.asarray(middles).tolist(), counts, strict=True):
        eighths = round(8 * _WIDTH * count / most)
        bar = "█" * (eighths // 8) + (_EIGHTHS[eighths % 8] if eighths % 8 else "")
        lines.append(f"{middle:7.4g} {unit} {bar} {count}")
    return lines
