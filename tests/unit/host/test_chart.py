"""Charts are to scale, whole and well-formed: read back from the SVG that a reader's browser draws."""

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from bricktrack_host.reporting.chart import panel_grid, picture_chart
from bricktrack_host.reporting.chart_marks import (
    UNITS_PER_PT,
    Area,
    Arrows,
    Instants,
    Line,
    Scatter,
    Signs,
    Spans,
    Words,
    band,
)
from bricktrack_host.reporting.chart_ticks import linear_ticks, log_ticks

SVG = "{http://www.w3.org/2000/svg}"


def drawn(chart):
    """Return the marks' paths by their stroke or fill colour, and the words, of a well-formed chart."""
    root = ET.fromstring(chart.svg())
    paths = {}
    for group in root.iter(f"{SVG}g"):
        for path in group.iter(f"{SVG}path"):
            paths[path.get("stroke") or path.get("fill")] = path.get("d")
    return paths, [t.text for t in root.iter(f"{SVG}text")]


def corners(path):
    """Return the points of a path of absolute M and relative l, or of m and h0, shape (n, 2), in points."""
    out = []
    for command, numbers in re.findall(r"([MmlhHVvz])([^MmlhHVvz]*)", path):
        values = np.array(numbers.split(), dtype=float)
        if command in "Mm":
            out.append(values if command == "M" or not out else out[-1] + values)
        elif command == "l":
            for step in values.reshape(-1, 2):
                out.append(out[-1] + step)
    return np.array(out) / UNITS_PER_PT


def one_panel(*marks, **limits):
    chart = panel_grid(1, height_in=2.0)
    panel = chart.panels[0][0]
    panel.add(*marks)
    for name, value in limits.items():
        setattr(panel, name, value)
    return chart, panel


def test_a_line_is_a_linear_map_of_its_samples_within_the_panel():
    x, y = np.linspace(-3, 5, 50), np.sin(np.arange(50.0))
    chart, panel = one_panel(Line(x, y, "#111111"), x_limits=(-3.0, 5.0), y_limits=(-1.0, 1.0))
    at = corners(drawn(chart)[0]["#111111"])
    # Whole units: a twentieth of a point.
    np.testing.assert_allclose(at[:, 0], panel.left_pt + panel.width_pt * (x + 3) / 8, atol=0.026)
    np.testing.assert_allclose(at[:, 1], panel.top_pt + panel.height_pt * (1 - y) / 2, atol=0.026)


def test_relative_steps_do_not_drift_over_many_samples():
    x, y = np.linspace(0, 1, 20_001), np.random.default_rng(1).normal(size=20_001)
    chart, panel = one_panel(Line(x, y, "#111111"), x_limits=(0.0, 1.0), y_limits=(-5.0, 5.0))
    assert corners(drawn(chart)[0]["#111111"])[-1, 0] == pytest.approx(
        panel.left_pt + panel.width_pt, abs=0.026
    )


def test_steps_across_the_whole_panel_are_as_exact_as_small_ones():
    x, y = np.array([0.0, 1.0, 1.001, 0.0, 0.001]), np.array([1.0, -1.0, -0.999, 1.0, 0.999])
    marks = Line(x, y, "#111111"), Scatter(x, y, "#222222", 1.0, half=np.full(5, 0.5))
    chart, panel = one_panel(*marks, x_limits=(0.0, 1.0), y_limits=(-1.0, 1.0))
    paths, _ = drawn(chart)
    to = np.stack([panel.left_pt + panel.width_pt * x, panel.top_pt + panel.height_pt * (1 - y) / 2], axis=1)
    np.testing.assert_allclose(corners(paths["#111111"]), to, atol=0.026)
    np.testing.assert_allclose(corners(paths["#222222"]), to, atol=0.026)


def test_nan_interrupts_lines_and_bands_and_draws_no_dot():
    x, y = np.arange(10.0), np.arange(10.0)
    y[4:6] = np.nan
    chart, _ = one_panel(
        Line(x, y, "#111111"),
        band(x, y - 1, y + 1, colour="#222222", opacity=0.5),
        Scatter(x, y, "#333333", 1.5),
    )
    paths, _ = drawn(chart)
    assert paths["#111111"].count("M") == 2
    assert paths["#222222"].count("z") == 2
    assert paths["#333333"].count("h0") == 8


def test_dots_are_strokes_of_no_length_at_their_places():
    rng = np.random.default_rng(4)
    x, y = rng.uniform(0, 1, 500), rng.uniform(0, 1, 500)
    chart, panel = one_panel(Scatter(x, y, "#333333", 1.5), x_limits=(0.0, 1.0), y_limits=(0.0, 1.0))
    at = corners(drawn(chart)[0]["#333333"])
    np.testing.assert_allclose(at[:, 0], panel.left_pt + panel.width_pt * x, atol=0.026)
    np.testing.assert_allclose(at[:, 1], panel.top_pt + panel.height_pt * (1 - y), atol=0.026)
    assert 'stroke-linecap="round"' in chart.svg()


def test_bars_reach_from_the_low_end_to_the_high():
    chart, panel = one_panel(
        Scatter(np.array([0.5]), np.array([0.5]), "#333333", 3.0, half=np.array([0.25])),
        x_limits=(0.0, 1.0),
        y_limits=(0.0, 1.0),
    )
    low, high = re.search(r'd="M\d+ (\d+)V(\d+)"', chart.svg()).groups()
    assert (int(low) - int(high)) / UNITS_PER_PT == pytest.approx(panel.height_pt / 2, abs=0.06)


def test_the_axes_show_all_samples_and_spans_widen_the_time_axis_alone():
    line = Line(np.array([1.0, 2.0]), np.array([3.0, 4.0]), "#111111")
    spans = Spans(np.array([[-5.0, 0.0], [1.0, 1.5]]), "#222222")
    chart, panel = one_panel(line, spans, Instants(np.array([9.0]), "#333333"))
    paths, _ = drawn(chart)
    x = [float(v) / UNITS_PER_PT for v in re.findall(r"[MH](\d+)", paths["#222222"] + paths["#333333"])]
    assert panel.left_pt < min(x) < max(x) < panel.left_pt + panel.width_pt
    at = corners(paths["#111111"])
    assert at[0, 1] - at[1, 1] == pytest.approx(panel.height_pt / 1.1, abs=0.1)  # a twentieth on either side


def test_shared_time_axes_are_one_and_numbered_below_the_lowest_panel():
    chart = panel_grid(2, height_in=3.0)
    chart.panels[0][0].add(Line(np.array([0.0, 1.0]), np.array([0.0, 1.0]), "#111111"))
    chart.panels[1][0].add(Line(np.array([0.0, 4.0]), np.array([0.0, 1.0]), "#222222"))
    paths, words = drawn(chart)
    assert corners(paths["#111111"])[0, 0] == corners(paths["#222222"])[0, 0]
    assert np.ptp(corners(paths["#222222"])[:, 0]) == pytest.approx(
        4 * np.ptp(corners(paths["#111111"])[:, 0]), abs=0.2
    )
    assert words.count("4.0") + words.count("4") == 1


def test_a_logarithmic_axis_puts_decades_at_equal_steps():
    x, y = np.arange(4.0), 10.0 ** np.arange(-2.0, 2.0)
    chart, _ = one_panel(Line(x, y, "#111111"), log_y=True)
    paths, words = drawn(chart)
    steps = np.diff(corners(paths["#111111"])[:, 1])
    assert np.ptp(steps) < 0.11
    assert steps.max() < 0
    assert {"10⁻²", "10⁻¹", "10⁰", "10¹"} <= set(words)


def test_pictures_run_downwards_at_one_scale():
    chart, panel = picture_chart(1920, 1080, legend=True)
    panel.add(Scatter(np.array([0.0, 1919.0]), np.array([0.0, 1079.0]), "#333333", 1.0, label="LEDs"))
    panel.add(Area([(np.array([0.0, 9.0, 9.0]), np.array([0.0, 0.0, 9.0]))], "#222222", 0.5, "#444444"))
    paths, words = drawn(chart)
    (u0, v0), (u1, v1) = corners(paths["#333333"])
    assert (u1 - u0) / (v1 - v0) == pytest.approx(1919 / 1079, rel=1e-3)
    assert v1 > v0
    assert "LEDs" in words


def test_an_arrow_ends_where_it_points_to():
    chart, panel = one_panel(
        Arrows(*np.array([[0.2], [0.5], [0.6], [0.0]]), "#555555"), x_limits=(0.0, 1.0), y_limits=(0.0, 1.0)
    )
    start, tip = re.match(r"M(\d+) \d+L(\d+)", drawn(chart)[0]["#555555"]).groups()
    assert int(start) / UNITS_PER_PT == pytest.approx(panel.left_pt + 0.2 * panel.width_pt, abs=0.06)
    assert int(tip) / UNITS_PER_PT == pytest.approx(panel.left_pt + 0.8 * panel.width_pt, abs=0.06)


def test_words_cannot_break_the_page():
    chart, _ = one_panel(
        Words(0.5, 0.5, "m0 <&>", "#111111"),
        Signs(np.array([0.5]), np.array([0.5]), "#222222", "|", label='"a" <b>'),
        title="a & b",
    )
    chart.legend = "above"
    _, words = drawn(chart)
    assert {"m0 <&>", '"a" <b>', "a & b"} <= set(words)


def test_an_empty_panel_is_drawn():
    chart, _ = one_panel(note="no inertial samples", y_ticks=False)
    assert "no inertial samples" in drawn(chart)[1]


@pytest.mark.parametrize(
    ("low", "high"), [(0.0, 15.3), (-0.31, 0.31), (1e5, 1.00003e5), (-2e-4, 7e-4), (0, 2400)]
)
def test_ticks_are_round_few_inside_and_told_apart(low, high):
    ticks = linear_ticks(low, high, at_most=7)
    assert 3 <= len(ticks.values) <= 7
    assert ((ticks.values >= low - 1e-9 * (high - low)) & (ticks.values <= high + 1e-9 * (high - low))).all()
    assert len(set(ticks.words)) == len(ticks.words)
    written = [float(w.replace("−", "-")) for w in ticks.words]
    np.testing.assert_allclose(written, ticks.values, atol=1e-6 * (high - low))


def test_few_decades_have_ticks_between_them():
    assert log_ticks(0.3, 4.0, at_most=5).words == ["0.5", "1", "2"]
    assert len(log_ticks(1e-9, 1e3, at_most=5).values) <= 5


def test_words_at_the_upper_border_stand_below_their_place():
    def to_page(x, y):
        return np.stack([x, y], axis=1).round().astype(int)

    def line_of(y):
        return int(re.search(r' y="(-?\d+)"', Words(500, y, "m0", "#111111").svg(to_page, 1000, 9000))[1])

    assert line_of(1050) > 1050 + 100  # its letters begin below the place
    assert line_of(5000) < 5000
