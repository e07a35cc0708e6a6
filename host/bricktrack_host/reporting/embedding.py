"""Figures and pictures as data URIs of SVG, which stays sharp on any screen and on paper."""

import base64
import io
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.reporting.chart import Chart
from bricktrack_host.reporting.plots import FrameOverlay

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class EmbeddedFigure:
    """A figure as a data URI with its caption."""

    uri: str
    alt: str
    caption: str = ""
    half: bool = False


def embed_chart(chart: Chart, alt: str, caption: str = "", *, half: bool = False) -> EmbeddedFigure:
    """Return a chart as SVG."""
    return EmbeddedFigure(_uri(chart.svg()), alt, caption, half)


def embed_figure(figure: "Figure", alt: str, caption: str = "", *, half: bool = False) -> EmbeddedFigure:
    """Return a figure of matplotlib as SVG; make and save it inside `plots.style`."""
    svg = io.StringIO()
    figure.savefig(svg, format="svg", metadata={"Date": None, "Creator": None})
    return EmbeddedFigure(_uri(_shortened(svg.getvalue())), alt, caption, half)


def embed_overlay(overlay: FrameOverlay) -> EmbeddedFigure:
    """Return a decoded frame with rings where LEDs were seen and crosses where the pose puts them."""
    rows, columns = overlay.picture.height_px, overlay.picture.width_px
    photo = base64.b64encode(overlay.picture.jpeg).decode()
    unit = columns / 400  # marks are of a size on the page, whatever the picture's
    rings = "".join(f'<circle cx="{u:.1f}" cy="{v:.1f}" r="{7 * unit:.1f}"/>'
                    for u, v in _known(overlay.detected_uv_px))  # fmt: skip
    arm = 5.5 * unit
    crosses = "".join(f"M{u - arm:.1f} {v:.1f}h{2 * arm:.1f}M{u:.1f} {v - arm:.1f}v{2 * arm:.1f}"
                      for u, v in _known(overlay.predicted_uv_px))  # fmt: skip
    svg = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{columns}" height="{rows}" '
        # The centre of the first pixel is (0, 0).
        f'viewBox="-0.5 -0.5 {columns} {rows}">'
        f'<image x="-0.5" y="-0.5" width="{columns}" height="{rows}" href="data:image/jpeg;base64,{photo}"/>'
        f'<g fill="none" stroke-width="{1.1 * unit:.2f}"><g stroke="#ffb000">{rings}</g>'
        f'<path stroke="#00c2ff" d="{crosses}"/></g></svg>'
    )
    return EmbeddedFigure(_uri(svg), f"LEDs laid over {overlay.title}", overlay.title)


def _known(uv_px: FloatArray) -> list[list[float]]:
    known: list[list[float]] = uv_px[np.isfinite(uv_px).all(axis=1)].tolist()
    return known


def _shortened(svg: str) -> str:
    """Return an SVG whose paths are in hundredths of a point, in place of millionths."""

    def cut(match: "re.Match[str]") -> str:
        return re.sub(r"(?<=\.\d\d)\d+", "", match[0]).replace("\n", "")

    return re.sub(r'(?<= d=")[^"]{200,}', cut, svg)


def _uri(svg: str) -> str:
    return f"data:image/svg+xml;base64,{base64.b64encode(svg.encode()).decode()}"
