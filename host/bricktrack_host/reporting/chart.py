"""Charts written as SVG: panels with axes and a legend around the marks of `chart_marks`.

A report holds some thirty panels of many samples. A plotting library builds an object for every tick, label
and line, which took longer than all computing of a run; here a panel is a few strings. Sizes are in inches
and points of a page; labels are of one font and a few digits, so that the margins which hold them are known.
"""

from dataclasses import dataclass, field
from math import log10
from typing import Literal

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.reporting.chart_marks import UNITS_PER_PT, Area, Mark, Spans, text, units
from bricktrack_host.reporting.chart_ticks import Ticks, linear_ticks, log_ticks
from bricktrack_host.reporting.page_measures import (
    BARE_GAP_IN,
    BOTTOM_IN,
    GAP_IN,
    LEFT_IN,
    LEGEND_IN,
    PICTURE_WIDTH_IN,
    RIGHT_IN,
    TICK_LABELS_IN,
    TITLE_IN,
    TOP_IN,
    WIDTH_IN,
    Y_LABEL_IN,
)

INK = "#22272e"
SOFT = "#5b616b"
_GRID = "#e3e5e8"
_EDGE = "#8a8f98"
_FONT = "DejaVu Sans,Verdana,Helvetica,Arial,sans-serif"
_EM_SHARE = 0.56  # mean width of a letter of such fonts

_PT = 72.0  # an inch
_SWATCH_PT = 16.0
_FAR_PT = 1e4
_X_MARGIN, _Y_MARGIN = 0.01, 0.05


@dataclass(slots=True)
class Panel:
    """Axes with what is drawn in them; the box is in points, from the top left.

    Limits that are not given follow from the marks. ``legend`` puts the marks' labels into the upper right.
    """

    left_pt: float
    top_pt: float
    width_pt: float
    height_pt: float
    title: str = ""
    x_label: str = ""
    y_label: str = ""
    x_limits: tuple[float, float] | None = None
    y_limits: tuple[float, float] | None = None
    y_from: float | None = None
    log_y: bool = False
    y_ticks: bool = True
    x_numbers: bool = True
    framed: bool = False
    legend: bool = False
    note: str = ""
    marks: list[Mark] = field(default_factory=list)

    def add(self, *marks: Mark) -> None:
        """Draw marks, the later ones over the earlier."""
        self.marks += marks


@dataclass(slots=True)
class Chart:
    """Panels on one page, with a legend of all their marks above or below them."""

    width_pt: float
    height_pt: float
    panels: list[list[Panel]]
    share_x: Literal["all", "row", "none"] = "none"
    legend: Literal["above", "below", "none"] = "none"

    def svg(self) -> str:
        """Return the chart as one SVG document."""
        size = f'width="{self.width_pt:g}pt" height="{self.height_pt:g}pt"'
        box = f'viewBox="0 0 {units(self.width_pt)} {units(self.height_pt)}"'
        all_panels = [p for row in self.panels for p in row]
        groups = {"all": [all_panels], "row": self.panels}.get(self.share_x, [[p] for p in all_panels])
        parts: list[str] = []
        for group in groups:
            shared = _limits_of(group)
            for panel in group:
                parts.append(_panel_svg(panel, panel.x_limits or shared, len(parts)))
        if self.legend != "none":
            y_pt = 9.5 if self.legend == "above" else self.height_pt - 7.0
            parts.append(_legend_row(all_panels, self.width_pt - 4.0, y_pt))
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" {size} {box} font-family="{_FONT}">'
            f"{''.join(parts)}</svg>"
        )


def panel_grid(
    rows: int,
    columns: int = 1,
    *,
    height_in: float,
    legend: bool = False,
    titles: bool = False,
    share_x: Literal["all", "row", "none"] = "all",
    labelled_columns: bool = True,
    heights: tuple[float, ...] | None = None,
) -> Chart:
    """Return a chart of panels in rows and columns, with room for what they will be labelled with.

    Parameters
    ----------
    rows, columns : int
    height_in : float, inches
        Of the whole chart.
    legend : bool
        A row above.
    titles : bool
        Every panel has a title.
    share_x : "all", "row" or "none"
        "all": numbers below the lowest row alone; otherwise below each.
    labelled_columns : bool
        The columns after the first have labels on their axes too.
    heights : tuple of float, optional
        Of the rows, relative.
    """
    title_in = TITLE_IN if titles else 0.0
    top_in = (LEGEND_IN if legend else 0.0) + (title_in or TOP_IN)
    gap_y_in = title_in + (GAP_IN if share_x == "all" else GAP_IN + TICK_LABELS_IN)
    gap_x_in = LEFT_IN + TOP_IN if labelled_columns else BARE_GAP_IN
    box_width_in = (WIDTH_IN - LEFT_IN - RIGHT_IN - (columns - 1) * gap_x_in) / columns
    shares = np.ones(rows) if heights is None else np.asarray(heights)
    box_heights_in = (height_in - top_in - BOTTOM_IN - (rows - 1) * gap_y_in) * shares / shares.sum()
    panels, at_in = [], top_in
    for i, box_height_in in enumerate(box_heights_in.tolist()):
        panels.append(
            [
                Panel(
                    _PT * (LEFT_IN + k * (box_width_in + gap_x_in)),
                    _PT * at_in,
                    _PT * box_width_in,
                    _PT * box_height_in,
                    x_numbers=share_x != "all" or i == rows - 1,
                )
                for k in range(columns)
            ]
        )
        at_in += box_height_in + gap_y_in
    return Chart(_PT * WIDTH_IN, _PT * height_in, panels, share_x, "above" if legend else "none")


def picture_chart(width_px: int, height_px: int, *, legend: bool = False) -> tuple[Chart, Panel]:
    """Return a chart over a picture, in pixels, v downwards, both to one scale."""
    box_width_in = PICTURE_WIDTH_IN - LEFT_IN - RIGHT_IN
    box_height_in = box_width_in * height_px / width_px
    top_in = TITLE_IN + TOP_IN
    panel = Panel(
        _PT * LEFT_IN, _PT * top_in, _PT * box_width_in, _PT * box_height_in,
        x_label="u, px", y_label="v, px", x_limits=(-0.5, width_px - 0.5), y_limits=(height_px - 0.5, -0.5),
        framed=True,
    )  # fmt: skip
    height_in = top_in + box_height_in + BOTTOM_IN + (LEGEND_IN if legend else 0.0)
    return Chart(
        _PT * PICTURE_WIDTH_IN, _PT * height_in, [[panel]], legend="below" if legend else "none"
    ), panel


def _limits_of(group: list[Panel]) -> tuple[float, float]:
    values = np.concatenate([np.empty(0), *(m.extent()[0] for p in group for m in p.marks)])
    return _with_margin(values, _X_MARGIN)


def _with_margin(values: FloatArray, share: float) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0, 1.0
    low, high = float(known.min()), float(known.max())
    if high - low <= 1e-12 * max(abs(low), abs(high), 1e-290):
        half = 0.05 * abs(low) or 0.05
        return low - half, high + half
    return low - share * (high - low), high + share * (high - low)


def _y_limits(panel: Panel) -> tuple[float, float]:
    if panel.y_limits is not None:
        return panel.y_limits
    values = np.concatenate([np.empty(0), *(m.extent()[1] for m in panel.marks)])
    if panel.log_y:
        low, high = _with_margin(np.log10(values[values > 0]), _Y_MARGIN)
        return 10.0**low, 10.0**high
    low, high = _with_margin(values, _Y_MARGIN)
    return (low if panel.y_from is None else panel.y_from), high


@dataclass(frozen=True, slots=True)
class _Scales:
    """From values of a panel's axes to units of the page."""

    panel: Panel
    x_limits: tuple[float, float]
    y_limits: tuple[float, float]

    def __call__(self, x: FloatArray, y: FloatArray) -> IntArray:
        return np.stack([self.along_x(x), self.along_y(y)], axis=-1)

    def along_x(self, x: FloatArray) -> IntArray:
        low, high = self.x_limits
        return _whole(self.panel.left_pt + self.panel.width_pt * (x - low) / (high - low))

    def along_y(self, y: FloatArray) -> IntArray:
        low, high = self.y_limits
        if self.panel.log_y:
            y, low, high = np.log10(np.maximum(y, 1e-300)), log10(low), log10(high)
        return _whole(self.panel.top_pt + self.panel.height_pt * (high - y) / (high - low))


def _whole(position_pt: FloatArray) -> IntArray:
    # Far outside the panel is as good as a little outside, and for NaN, which nobody looks at.
    near_pt: FloatArray = np.fmin(np.fmax(position_pt, -_FAR_PT), _FAR_PT)
    return np.rint(near_pt * UNITS_PER_PT).astype(np.int64)


def _panel_svg(panel: Panel, x_limits: tuple[float, float], number: int) -> str:
    scales = _Scales(panel, x_limits, _y_limits(panel))
    left, top = units(panel.left_pt), units(panel.top_pt)
    width, height = units(panel.width_pt), units(panel.height_pt)
    right, bottom = left + width, top + height
    x_ticks = linear_ticks(*x_limits, at_most=max(round(panel.width_pt / 55), 3))
    at_most = max(round(panel.height_pt / 22), 3)
    if not panel.y_ticks:
        y_ticks = Ticks(np.empty(0), [])
    elif panel.log_y:
        y_ticks = log_ticks(*scales.y_limits, at_most=at_most)
    else:
        y_ticks = linear_ticks(min(scales.y_limits), max(scales.y_limits), at_most=at_most)
    at_x, at_y = scales.along_x(x_ticks.values).tolist(), scales.along_y(y_ticks.values).tolist()
    grid = "".join(f"M{x} {top}v{height}" for x in at_x) + "".join(f"M{left} {y}h{width}" for y in at_y)
    tick = units(3.0)
    edges = f"M{left} {top}V{bottom}H{right}" + (f"V{top}H{left}" if panel.framed else "")
    edges += "".join(f"M{x} {bottom}v{tick}" for x in at_x) + "".join(f"M{left} {y}h{-tick}" for y in at_y)
    below = [m.svg(scales, top, bottom) for m in panel.marks if isinstance(m, Area | Spans)]
    above = [m.svg(scales, top, bottom) for m in panel.marks if not isinstance(m, Area | Spans)]
    parts = [
        f'<clipPath id="c{number}"><path d="M{left} {top}h{width}v{height}h{-width}z"/></clipPath>',
        f'<g clip-path="url(#c{number})">{"".join(below)}',
        f'<path stroke="{_GRID}" stroke-opacity=".8" stroke-width="{units(0.6)}" d="{grid}"/>',
        f"{''.join(above)}</g>",
        f'<path fill="none" stroke="{_EDGE}" stroke-width="{units(0.6)}" d="{edges}"/>',
    ]
    for y, words in zip(at_y, y_ticks.words, strict=True):
        parts.append(text(left - units(5), y + units(2.9), words, colour=SOFT, size_pt=8, anchor="end"))
    if panel.x_numbers:
        for x, words in zip(at_x, x_ticks.words, strict=True):
            parts.append(text(x, bottom + units(11.5), words, colour=SOFT, size_pt=8, anchor="middle"))
    middle_x, middle_y = left + width // 2, top + height // 2
    if panel.x_label:
        parts.append(text(middle_x, bottom + units(25.5), panel.x_label, colour=INK, anchor="middle"))
    if panel.y_label:
        at = left - units(Y_LABEL_IN * _PT - 3)
        parts.append(text(at, middle_y, panel.y_label, colour=INK, anchor="middle", upwards=True))
    if panel.title:
        parts.append(text(left, top - units(5), panel.title, colour=INK, size_pt=9, bold=True))
    if panel.note:
        parts.append(text(middle_x, middle_y, panel.note, colour=SOFT, anchor="middle"))
    if panel.legend:
        parts.append(_legend_column(panel))
    return "".join(parts)


def _labelled(panels: list[Panel]) -> list[Mark]:
    first: dict[str, Mark] = {}
    for panel in panels:
        for mark in panel.marks:
            if mark.label:
                first.setdefault(mark.label, mark)
    return list(first.values())


def _legend_row(panels: list[Panel], right_pt: float, y_pt: float) -> str:
    """Return the labels of all marks in one row that ends at the right."""
    marks = _labelled(panels)
    widths_pt = [_SWATCH_PT + 4 + 8 * _EM_SHARE * len(m.label) + 12 for m in marks]
    x_pt, parts = right_pt + 12 - sum(widths_pt), []
    for mark, width_pt in zip(marks, widths_pt, strict=True):
        parts.append(_legend_entry(mark, x_pt, y_pt))
        x_pt += width_pt
    return "".join(parts)


def _legend_column(panel: Panel) -> str:
    marks = _labelled([panel])
    longest = max((len(m.label) for m in marks), default=0)
    x_pt = panel.left_pt + panel.width_pt - _SWATCH_PT - 8 - 8 * _EM_SHARE * longest
    return "".join(_legend_entry(m, x_pt, panel.top_pt + 8 + 11 * i) for i, m in enumerate(marks))


def _legend_entry(mark: Mark, x_pt: float, y_pt: float) -> str:
    words = text(units(x_pt + _SWATCH_PT + 4), units(y_pt + 2.9), mark.label, colour=INK, size_pt=8)
    return mark.swatch(units(x_pt), units(y_pt), units(_SWATCH_PT)) + words
