"""Panels of an interactive page: one axis of time for all of them, zoomed and pointed at together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from bokeh.document import Document
from bokeh.embed import components
from bokeh.events import DoubleTap
from bokeh.layouts import gridplot
from bokeh.models import (
    BoxZoomTool,
    ColumnDataSource,
    CrosshairTool,
    CustomJS,
    GlyphRenderer,
    GridPlot,
    HoverTool,
    Legend,
    LegendItem,
    PanTool,
    Range1d,
    ResetTool,
    SaveTool,
    Span,
    WheelZoomTool,
)
from bokeh.plotting import figure
from bokeh.resources import Resources
from markupsafe import Markup

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.quality import describe
from bricktrack_host.reporting.chart import INK, SOFT
from bricktrack_host.reporting.plots import IMPACT, SHADE
from bricktrack_host.reporting.thinning import thinned

MAX_SAMPLES = 100_000
"""More are thinned: what a page of a few megabytes holds, and a browser draws while it is dragged."""

_THINNED_COLUMNS = 4000
_FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif"
_EDGE = "#8a8f98"
_GRID = "#e3e5e8"
_HEIGHT_PX = 170


@dataclass(frozen=True, slots=True, eq=False)
class Events:
    """What is marked in every panel over time, in seconds of the page.

    Attributes
    ----------
    dropouts_s : ndarray, shape (k, 2)
    impacts_s : ndarray, shape (m,)
    trigger_s : float or None
    """

    dropouts_s: FloatArray
    impacts_s: FloatArray
    trigger_s: float | None = None


class TimePanels:
    """Makes panels that share one time axis and one crosshair, with the events marked."""

    def __init__(self, label: str, span: tuple[float, float], events: Events) -> None:
        margin = 0.01 * (span[1] - span[0]) or 0.5
        self._label = label
        self._range = Range1d(span[0] - margin, span[1] + margin)
        self._pointer = Span(dimension="height", line_color=SOFT, line_width=0.7, line_dash="dotted")
        self._events = events
        self._made: list[figure] = []

    def panel(self, y_label: str, *, title: str = "", height_px: int = _HEIGHT_PX) -> figure:
        """Return an empty panel."""
        new = styled_panel(y_label, title=title, height_px=height_px, x_range=self._range)
        new.name = "over time"
        new.window_axis = "x"  # what is beside the time shown does not flatten the curves
        new.add_tools(CrosshairTool(overlay=self._pointer))
        if len(self._events.dropouts_s):
            first, last = self._events.dropouts_s.T
            shaded = new.vstrip(x0=first, x1=last, fill_color=SHADE, line_color=None, level="underlay")
            shaded.name = "dropouts"
        if len(self._events.impacts_s):
            struck = new.vspan(x=self._events.impacts_s, line_color=IMPACT, line_width=1.0, line_alpha=0.75)
            struck.name = "impacts"
        if self._events.trigger_s is not None:
            new.vspan(x=[self._events.trigger_s], line_color=INK, line_width=0.8, line_dash="dashed")
        self._made.append(new)
        return new

    def grid(self, panels: Sequence[figure], *, columns: int = 1) -> GridPlot:
        """Return panels in columns, filled row by row, the time below the lowest of each."""
        for one in panels[-columns:]:
            one.xaxis.axis_label = self._label
            one.height += 26
        return grid(panels, columns=columns)

    def reset_together(self) -> None:
        """Let a double click on any panel show everything again, in all of them."""
        again = CustomJS(args={"panels": self._made}, code="for (const panel of panels) panel.reset.emit()")
        for one in self._made:
            one.js_on_event(DoubleTap, again)


def styled_panel(
    y_label: str,
    *,
    title: str = "",
    height_px: int = _HEIGHT_PX,
    x_range: Range1d | None = None,
    log_y: bool = False,
) -> figure:
    """Return an empty panel with its tools: a drag zooms in; the wheel does with the control key held."""
    given = {} if x_range is None else {"x_range": x_range}
    new = figure(
        height=height_px,
        sizing_mode="stretch_width",
        tools=[],
        title=title or None,
        y_axis_label=y_label,
        y_axis_type="log" if log_y else "linear",
        min_border_left=64,
        lod_threshold=None,
        **given,
    )
    drag = BoxZoomTool()
    wheel = WheelZoomTool(dimensions="width", modifiers={"ctrl": True})
    new.add_tools(drag, PanTool(), wheel, ResetTool(), SaveTool())
    new.toolbar.active_drag, new.toolbar.active_scroll = drag, wheel
    new.toolbar.logo = None
    new.outline_line_color = None
    for axis in (new.xaxis, new.yaxis):
        axis.axis_label_text_font = axis.major_label_text_font = _FONT
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_font_size, axis.major_label_text_font_size = "12px", "11px"
        axis.axis_label_text_color, axis.major_label_text_color = INK, SOFT
        axis.axis_line_color = axis.major_tick_line_color = _EDGE
        axis.minor_tick_line_color = None
    new.grid.grid_line_color = _GRID
    if title:
        new.title.text_font, new.title.text_font_size, new.title.text_color = _FONT, "13px", INK
    return new


def grid(panels: Sequence[figure], *, columns: int) -> GridPlot:
    """Return panels in columns, filled row by row, with one toolbar for all."""
    rows = [list(panels[i : i + columns]) for i in range(0, len(panels), columns)]
    return gridplot(
        rows, sizing_mode="stretch_width", toolbar_location="right", toolbar_options={"logo": None}
    )


def samples(
    t: FloatArray, columns: Mapping[str, FloatArray], *, flags: IntArray | None = None
) -> ColumnDataSource:
    """Return samples for panels in single precision, thinned where there are more than `MAX_SAMPLES`.

    Parameters
    ----------
    t : ndarray, shape (n,), rising
    columns : mapping of str to ndarray, shape (n,)
    flags : ndarray of int64, shape (n,), `PoseFlag`, optional
        Given, the column ``said`` holds their names.
    """
    rows = np.arange(len(t))
    if len(t) > MAX_SAMPLES:
        kept = [
            thinned(t, column, n_columns=_THINNED_COLUMNS // len(columns) or 1) for column in columns.values()
        ]
        rows = np.unique(np.concatenate(kept))
    data: dict[str, object] = {"t": t[rows]}
    data |= {name: np.asarray(column[rows], dtype=np.float32) for name, column in columns.items()}
    if flags is not None:
        names = {value: describe(value) or "none" for value in np.unique(flags[rows]).tolist()}
        data["said"] = [names[value] for value in flags[rows].tolist()]
    return ColumnDataSource(data)


def tell(panel: figure, renderer: GlyphRenderer, lines: list[tuple[str, str]], *, along_time: bool) -> None:
    """Show values where the pointer is: of the nearest instant, or of the dot under it."""
    panel.add_tools(
        HoverTool(
            renderers=[renderer],
            tooltips=lines,
            mode="vline" if along_time else "mouse",
            line_policy="nearest",
            attachment="horizontal" if along_time else "above",
            description="values",
        )
    )


def legend_that_hides(panel: figure, entries: Mapping[str, Sequence[GlyphRenderer]]) -> None:
    """Put a legend above a panel; a click on an entry hides or shows all its marks, in every panel.

    The first mark of each entry must be of this panel.
    """
    items = []
    for label, marks in entries.items():
        items.append(LegendItem(label=label, renderers=[marks[0]]))
        for other in marks[1:]:
            marks[0].js_link("visible", other, "visible")
    legend = Legend(
        items=items, orientation="horizontal", click_policy="hide", border_line_color=None, padding=2,
        label_text_font=_FONT, label_text_font_size="12px", label_text_color=INK, spacing=12,
    )  # fmt: skip
    panel.add_layout(legend, "above")
    panel.height += 30


def scripts() -> Markup:
    """Return the library that draws the panels, as it stands in its Python package: nothing is fetched."""
    return Markup(Resources(mode="inline", components=["bokeh"]).render_js())


def embedded(plots: Mapping[str, GridPlot]) -> tuple[Markup, dict[str, Markup]]:
    """Return the script that draws plots, and the places that they are drawn into, by name."""
    document = Document()
    with document.models.freeze():  # every plot leads to all others by their common axis: walk them once
        for one in plots.values():
            document.add_root(one)
    script, places = components(dict(plots))
    return Markup(script), {name: Markup(place) for name, place in places.items()}
