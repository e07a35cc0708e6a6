"""Marks of the report's figures: thinned lines keep their picture, dots are all there, overlays are to scale."""

import base64
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bricktrack_host.reporting.embedding import embed_figure, embed_overlay
from bricktrack_host.reporting.figure_layout import panel_grid
from bricktrack_host.reporting.figure_marks import band, dots, instants, spans, thinned
from bricktrack_host.reporting.plots import FrameOverlay, style


def svg_of(embedded):
    head, data = embedded.uri.split(",", 1)
    assert head == "data:image/svg+xml;base64"
    return base64.b64decode(data).decode()


def drawn(t_s, y):
    """Return the pixels of a thin line, one pixel column for each of 300 columns of time."""
    fig = Figure(figsize=(3, 2), dpi=100)
    ax = fig.add_axes((0, 0, 1, 1))
    ax.plot(t_s, y, lw=0.6, color="k", snap=False)
    ax.set(xlim=(0, 10), ylim=(-4, 4))
    ax.set_axis_off()
    canvas = FigureCanvasAgg(fig)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., 0].astype(float)


def test_a_thinned_line_draws_the_picture_of_the_whole():
    rng = np.random.default_rng(3)
    t_s = np.linspace(0, 10, 40_000)
    y = np.sin(40 * t_s) + 0.3 * rng.standard_normal(len(t_s))
    y[12_345] = 3.7  # one sample alone must not go
    index = thinned(t_s, y, n_columns=300)
    assert len(index) <= 1200
    assert 12_345 in index
    whole = drawn(t_s, y)

    def lost(chosen):
        """Return the share of inked pixels of the whole line without ink beside them, and the other way."""
        ours = drawn(t_s[chosen], y[chosen])
        return missing(whole, ours), missing(ours, whole)

    # A stroke is about a pixel wide and bleeds into the column beside its own: compared to one pixel.
    assert lost(index)[0] < 0.002
    assert lost(index)[1] == 0
    every = np.arange(0, len(t_s), len(t_s) // 1200)
    assert lost(every)[0] > 0.1


def missing(ink, elsewhere):
    dark, there = ink < 100, elsewhere < 240
    near = there.copy()
    near[:, 1:] |= there[:, :-1]
    near[:, :-1] |= there[:, 1:]
    return (dark & ~near).sum() / dark.sum()


def test_gaps_stay_gaps_and_short_lines_stay_whole():
    t_s = np.linspace(0, 10, 5000)
    y = np.sin(t_s)
    y[1000:1010] = np.nan
    index = thinned(t_s, y, n_columns=100)
    assert set(range(1000, 1010)) <= set(index.tolist())
    assert np.array_equal(thinned(t_s[:300], y[:300], n_columns=100), np.arange(300))
    assert np.array_equal(thinned(np.zeros(900), np.arange(900.0), n_columns=100), np.arange(900))


def test_a_thinned_band_covers_all_of_it():
    t_s = np.linspace(0, 10, 20_000)
    half = 1 + 0.5 * np.sin(300 * t_s)
    half[7777] = 9.0
    fig = Figure()
    ax = fig.subplots()
    band(ax, t_s, -half, half)
    corners = ax.collections[0].get_paths()[0].vertices
    assert len(corners) < 6000
    assert corners[:, 1].max() == 9.0
    assert corners[:, 1].min() == -9.0
    upper = corners[corners[:, 1] > 0]
    order = np.argsort(upper[:, 0], kind="stable")
    assert (np.interp(t_s, upper[order, 0], upper[order, 1]) >= half - 0.25).all()  # slopes between columns


def test_every_known_dot_is_a_stroke_of_the_svg_and_unknown_ones_are_none():
    rng = np.random.default_rng(4)
    x, y = rng.uniform(0, 1, 500), rng.uniform(0, 1, 500)
    y[:7] = np.nan
    with style():
        fig, axes = panel_grid(1, height_in=2.0)
        dots(axes[0, 0], x, y, size_pt=1.5, color="#c8651b", label="optical")
        svg = svg_of(embed_figure(fig, "dots"))
    longest = max(re.findall(r' d="([^"]*)"', svg), key=len)
    strokes = re.findall(r"M ([\d.]+) ([\d.]+) ?L ([\d.]+) ([\d.]+)", longest)
    assert len(strokes) == 493
    assert all(s[:2] == s[2:] for s in strokes)
    assert "stroke-linecap: round" in svg
    # To scale: the dots of the SVG are a linear map of the data.
    at = np.array([[float(s[0]), float(s[1])] for s in strokes])
    assert abs(np.corrcoef(at[:, 0], x[7:])[0, 1]) == pytest.approx(1, abs=1e-6)
    assert np.corrcoef(at[:, 1], y[7:])[0, 1] == pytest.approx(-1, abs=1e-6)


def test_spans_and_instants_widen_the_time_axis_and_leave_the_other_alone():
    fig = Figure()
    ax = fig.subplots()
    ax.plot([1.0, 2.0], [3.0, 4.0])
    spans(ax, np.array([[-5.0, 0.0], [1.0, 1.5]]), color="k", label="span")
    instants(ax, np.array([9.0]), color="k", lw=1, label="instant")
    ax.autoscale_view()
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    assert x0 < -5 < 9 < x1
    assert 2.9 < y0 < 3 < 4 < y1 < 4.1
    before = len(ax.collections)
    spans(ax, np.empty((0, 2)), color="k", label="none")
    assert len(ax.collections) == before


@pytest.mark.parametrize("shape", [(1080, 1920), (120, 160, 3)])
def test_overlay_marks_are_at_their_pixels_over_the_whole_picture(shape):
    image = np.zeros(shape, np.uint8)
    image[10:20, 30:40] = 250
    overlay = FrameOverlay(
        "frame 3, 0.1 s & more", image,
        np.array([[34.5, 14.5], [np.nan, np.nan]]), np.array([[35.0, 15.0], [100.0, 60.0]]),
    )  # fmt: skip
    embedded = embed_overlay(overlay)
    assert embedded.caption == overlay.title
    root = ET.fromstring(svg_of(embedded))
    space = {"s": "http://www.w3.org/2000/svg"}
    assert root.get("viewBox") == f"-0.5 -0.5 {shape[1]} {shape[0]}"
    circles = root.findall(".//s:circle", space)
    assert [(c.get("cx"), c.get("cy")) for c in circles] == [("34.5", "14.5")]
    assert root.find(".//s:path", space).get("d").count("M") == 4  # two crosses
    picture = root.find("s:image", space)
    assert [picture.get(k) for k in ("x", "y", "width", "height")] == [
        "-0.5",
        "-0.5",
        str(shape[1]),
        str(shape[0]),
    ]
