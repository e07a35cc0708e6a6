"""The lower edge and the look that pictures of a motion above its error share."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure


def save(figure: Figure, motion: Axes, error: Axes, output: Path) -> None:
    """Label the error and its time, take the frames off, and write the picture."""
    error.set_ylabel("error, µm")
    error.set_xlabel("s after the first edge")
    for axes in (motion, error):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color="0.92", lw=0.6)
    figure.savefig(output, dpi=110)
