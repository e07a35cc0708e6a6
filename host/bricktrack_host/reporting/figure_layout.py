"""Where panels, labels and legends sit in a figure, in inches: not measured, so not drawn twice.

Automatic layouts draw a figure to learn how large its labels came out, and place it anew. The labels of a
report are of one font and a few digits: margins that hold them are known.
"""

from collections.abc import Iterable, Sequence
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

WIDTH_IN = 10.4
_LEFT_IN = 0.74  # "-0.025", a label across it, and a gap between them
_RIGHT_IN = 0.08
_BOTTOM_IN = 0.42
_LEGEND_IN = 0.27
_TITLE_IN = 0.21
_GAP_IN = 0.13
_TICK_LABELS_IN = 0.20
_Y_LABEL_IN = 0.58  # from the axis to the middle of its label
_X_LABEL_IN = 0.24


def panel_grid(
    rows: int,
    columns: int = 1,
    *,
    height_in: float,
    width_in: float = WIDTH_IN,
    legend: bool = False,
    titles: bool = False,
    share_x: Literal["row"] | bool = True,
    labelled_columns: bool = True,
    heights: Sequence[float] | None = None,
) -> tuple[Figure, Any]:
    """Return a figure and its axes, shape (rows, columns), with room for what they will be labelled with.

    Parameters
    ----------
    rows, columns : int
    height_in, width_in : float, inches
        Of the whole figure.
    legend : bool
        A row above for `figure_legend`.
    titles : bool
        Every panel has a title.
    share_x : bool or "row"
        True: time labels below the lowest row alone; "row" and False: below each.
    labelled_columns : bool
        The columns after the first have labels on their axes too.
    heights : sequence of float, optional
        Of the rows, relative.
    """
    title_in = _TITLE_IN if titles else 0.0
    top_in = (_LEGEND_IN if legend else 0.0) + (title_in or 0.06)
    gap_y_in = title_in + (_GAP_IN if share_x is True else _GAP_IN + _TICK_LABELS_IN)
    gap_x_in = _LEFT_IN + 0.06 if labelled_columns else 0.5
    box_width_in = (width_in - _LEFT_IN - _RIGHT_IN - (columns - 1) * gap_x_in) / columns
    box_height_in = (height_in - top_in - _BOTTOM_IN - (rows - 1) * gap_y_in) / rows
    fig = Figure(figsize=(width_in, height_in))
    axes = fig.subplots(
        rows,
        columns,
        squeeze=False,
        sharex=share_x,
        gridspec_kw={
            "left": _LEFT_IN / width_in,
            "right": 1 - _RIGHT_IN / width_in,
            "bottom": _BOTTOM_IN / height_in,
            "top": 1 - top_in / height_in,
            "wspace": gap_x_in / box_width_in,
            "hspace": gap_y_in / box_height_in,
            "height_ratios": heights,
        },
    )
    shares = np.ones(rows) if heights is None else np.asarray(heights) * rows / np.sum(heights)
    for row, share in zip(axes, shares.tolist(), strict=True):
        for ax in row:
            _place_labels(ax, box_width_in, box_height_in * share)
    return fig, axes


def picture_axes(width_px: int, height_px: int, *, below_in: float = 0.0) -> tuple[Figure, Axes]:
    """Return a figure with axes over a picture, in pixels, v downwards, both to one scale.

    ``below_in`` leaves room below the labels, for a legend.
    """
    width_in = 6.6
    box_width_in = width_in - _LEFT_IN - _RIGHT_IN
    box_height_in = box_width_in * height_px / width_px
    bottom_in = _BOTTOM_IN + below_in
    height_in = box_height_in + bottom_in + _TITLE_IN + 0.06
    fig = Figure(figsize=(width_in, height_in))
    ax = fig.add_axes(
        (
            _LEFT_IN / width_in,
            bottom_in / height_in,
            box_width_in / width_in,
            box_height_in / height_in,
        )
    )
    _place_labels(ax, box_width_in, box_height_in)
    ax.set(xlim=(-0.5, width_px - 0.5), ylim=(height_px - 0.5, -0.5), xlabel="u, px", ylabel="v, px")
    ax.spines[:].set_visible(True)
    return fig, ax


def _place_labels(ax: Axes, box_width_in: float, box_height_in: float) -> None:
    # A label with a place of its own does not ask every tick of every panel for its size.
    ax.yaxis.set_label_coords(-_Y_LABEL_IN / box_width_in, 0.5)
    ax.xaxis.set_label_coords(0.5, -_X_LABEL_IN / box_height_in)


def figure_legend(fig: Figure, axes: Iterable[Axes]) -> None:
    """Put one legend of everything that the axes show in the row above them, right."""
    entries: dict[str, Any] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        fig.legend(
            list(entries.values()), list(entries), loc="upper right", ncols=len(entries),
            bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, columnspacing=1.4, handletextpad=0.5, markerscale=2,
        )  # fmt: skip
