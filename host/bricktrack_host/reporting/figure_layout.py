"""Where panels and labels sit in a figure of matplotlib: not measured, so not drawn twice.

Automatic layouts draw a figure to learn how large its labels came out, and place it anew.
"""

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bricktrack_host.reporting.page_measures import (
    BARE_GAP_IN,
    BOTTOM_IN,
    LEFT_IN,
    PICTURE_WIDTH_IN,
    RIGHT_IN,
    TITLE_IN,
    TOP_IN,
    WIDTH_IN,
    X_LABEL_IN,
    Y_LABEL_IN,
)


def panel_row(
    columns: int, *, height_in: float, width_in: float = WIDTH_IN, labelled_columns: bool = True
) -> tuple[Figure, list[Axes]]:
    """Return a figure and its axes side by side, with room for titles, numbers and labels.

    Parameters
    ----------
    columns : int
    height_in, width_in : float, inches
        Of the whole figure.
    labelled_columns : bool
        The columns after the first have labels on their axes too.
    """
    gap_in = LEFT_IN + TOP_IN if labelled_columns else BARE_GAP_IN
    box_width_in = (width_in - LEFT_IN - RIGHT_IN - (columns - 1) * gap_in) / columns
    box_height_in = height_in - TITLE_IN - BOTTOM_IN
    fig = Figure(figsize=(width_in, height_in))
    axes: Any = fig.subplots(
        1,
        columns,
        squeeze=False,
        sharex=True,
        gridspec_kw={
            "left": LEFT_IN / width_in,
            "right": 1 - RIGHT_IN / width_in,
            "bottom": BOTTOM_IN / height_in,
            "top": 1 - TITLE_IN / height_in,
            "wspace": gap_in / box_width_in,
        },
    )
    row = list(axes[0])
    for ax in row:
        _place_labels(ax, box_width_in, box_height_in)
    return fig, row


def picture_axes(width_px: int, height_px: int, *, below_in: float = 0.0) -> tuple[Figure, Axes]:
    """Return a figure with axes over a picture, in pixels, v downwards, both to one scale.

    ``below_in`` leaves room below the labels, for a legend.
    """
    box_width_in = PICTURE_WIDTH_IN - LEFT_IN - RIGHT_IN
    box_height_in = box_width_in * height_px / width_px
    bottom_in = BOTTOM_IN + below_in
    height_in = box_height_in + bottom_in + TITLE_IN + TOP_IN
    fig = Figure(figsize=(PICTURE_WIDTH_IN, height_in))
    ax = fig.add_axes(
        (
            LEFT_IN / PICTURE_WIDTH_IN,
            bottom_in / height_in,
            box_width_in / PICTURE_WIDTH_IN,
            box_height_in / height_in,
        )
    )
    _place_labels(ax, box_width_in, box_height_in)
    ax.set(xlim=(-0.5, width_px - 0.5), ylim=(height_px - 0.5, -0.5), xlabel="u, px", ylabel="v, px")
    ax.spines[:].set_visible(True)
    return fig, ax


def _place_labels(ax: Axes, box_width_in: float, box_height_in: float) -> None:
    # A label with a place of its own does not ask every tick of every panel for its size.
    ax.yaxis.set_label_coords(-Y_LABEL_IN / box_width_in, 0.5)
    ax.xaxis.set_label_coords(0.5, -X_LABEL_IN / box_height_in)
