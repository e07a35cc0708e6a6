"""What is drawn in a panel: dots, lines and bands of many samples, spans and instants; each one object.

A matplotlib artist for every dot or shaded interval takes a hundred times as long as one for all of them, and
a line with more samples than a page has pixels is thinned so that its picture stays the same.
"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.path import Path

from bricktrack_common.arrays import FloatArray
from bricktrack_host.reporting.thinning import thinned, thinned_band


def line(ax: Axes, t_s: FloatArray, y: FloatArray, **style: Any) -> None:
    """Draw a line through samples."""
    index = thinned(t_s, y)
    ax.plot(t_s[index], y[index], **style)


def band(ax: Axes, t_s: FloatArray, low: FloatArray, high: FloatArray, **style: Any) -> None:
    """Shade between two lines; thinned, the band keeps what it covers in every column of pixels."""
    t_s, low, high = thinned_band(t_s, low, high)
    ax.fill_between(t_s, low, high, lw=0, **style)


def dots(
    ax: Axes,
    x: FloatArray,
    y: FloatArray,
    *,
    size_pt: float,
    color: str,
    label: str | None = None,
    alpha: float | None = None,
) -> None:
    """Draw round dots; NaN draws none."""
    points = np.stack([x, y], axis=-1)
    points = points[np.isfinite(points).all(axis=1)]
    if label is not None:  # for the legend alone
        ax.plot([], [], ".", ms=size_pt * 2, mew=0, color=color, label=label)
    if len(points) == 0:
        return
    # A stroke of no length with round ends is a dot; all of them are one path.
    codes = np.tile(np.array([Path.MOVETO, Path.LINETO], dtype=np.uint8), len(points))
    path = Path(np.repeat(points, 2, axis=0), codes)
    path.should_simplify = False  # which would leave out strokes of no length
    collection = PathCollection(
        [path], facecolors="none", edgecolors=color, linewidths=size_pt, capstyle="round", alpha=alpha,
        zorder=2,
    )  # fmt: skip
    ax.add_collection(collection, autolim=False)
    ax.update_datalim(points)
    ax.autoscale_view()


def spans(ax: Axes, intervals: FloatArray, *, color: str, label: str) -> None:
    """Shade intervals of time, shape (n, 2), over the panel's whole height."""
    if len(intervals) == 0:
        return
    first, last = intervals.T
    corners = np.stack([first, np.zeros(len(first)), first, np.ones(len(first)),
                        last, np.ones(len(first)), last, np.zeros(len(first))], axis=1)  # fmt: skip
    shade = PolyCollection(
        list(corners.reshape(-1, 4, 2)), facecolors=color, linewidths=0, label=label,
        transform=ax.get_xaxis_transform(),
    )  # fmt: skip
    ax.add_collection(shade, autolim=False)
    ax.update_datalim(np.stack([intervals.ravel(), np.zeros(intervals.size)], axis=1), updatey=False)


def instants(ax: Axes, t_s: FloatArray, *, color: str, lw: float, label: str, **style: Any) -> None:
    """Mark instants by lines over the panel's whole height."""
    if len(t_s) == 0:
        return
    ends = np.stack([np.stack([t_s, np.zeros(len(t_s))], axis=1), np.stack([t_s, np.ones(len(t_s))], axis=1)])
    marks = LineCollection(
        list(np.swapaxes(ends, 0, 1)), colors=color, linewidths=lw, label=label,
        transform=ax.get_xaxis_transform(), **style,
    )  # fmt: skip
    ax.add_collection(marks, autolim=False)
    ax.update_datalim(ends[0], updatey=False)
