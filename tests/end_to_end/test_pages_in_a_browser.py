"""The pages as people open them: in a real Chromium, with the network cut."""

import re
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from headless_chromium import headless_chromium, needs_chromium
from small_lab import BRICK, UNITS, example, invented_run

from bricktrack_host.assemblies.combined_test import combine_test
from bricktrack_host.datasets.comparison_pairs import compare
from bricktrack_host.reporting.combined_interactive import write_interactive_test
from bricktrack_host.reporting.combined_report import write_combined_report
from bricktrack_host.reporting.comparison_report import write_comparison_page
from bricktrack_host.reporting.interactive_report import write_interactive_report
from bricktrack_host.reporting.report import write_report
from bricktrack_host.results.result_store import write_results

WIDTH = 1300
pytestmark = [pytest.mark.slow, needs_chromium]


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """The kinds of pages of two invented runs and their test."""
    lab = tmp_path_factory.mktemp("lab")
    results = {}
    for unit in UNITS:
        result = invented_run(lab / f"{unit}_0001_shake", unit)
        results[unit] = lab / f"{unit}_0001_shake" / "results"
        write_report(result, results[unit] / "report.html", example.example_extras(result))
    write_interactive_report(result, results["b7-2"] / "interactive.html")
    test = lab / "shake-12"
    combine_test("shake-12", results, [BRICK], test, also=write_combined_report)
    write_interactive_test(test)
    write_results(example.example_result(seed=2), lab / "other")
    write_comparison_page(compare(lab / "other", results["b7-2"]), lab / "comparison.html")
    return {
        "comparison": lab / "comparison.html",
        "run": results["b7-2"] / "report.html",
        "run, interactive": results["b7-2"] / "interactive.html",
        "test": test / "report.html",
        "test, interactive": test / "interactive.html",
    }


@pytest.fixture(scope="module")
def browser():
    with headless_chromium() as chromium:
        yield chromium


class Window:
    """A page in a window without a network, and what it complained of or asked for."""

    def __init__(self, browser, path: Path):
        self.context = browser.new_context(viewport={"width": WIDTH, "height": 900}, offline=True)
        self.page = self.context.new_page()
        self.complaints, self.asked = [], []
        self.page.on("pageerror", lambda e: self.complaints.append(str(e)))
        self.page.on(
            "console", lambda m: self.complaints.append(m.text) if m.type in ("error", "warning") else None
        )
        self.page.on("request", lambda r: self.asked.append(r.url))
        self.page.goto(path.as_uri())
        if path.name == "interactive.html":
            self.page.wait_for_function(
                "window.Bokeh && Bokeh.documents.length && Bokeh.documents[0].is_idle"
            )
        self.asked = [u for u in self.asked if u != path.as_uri() and not u.startswith(("data:", "blob:"))]

    def panels(self):
        """Return the box of every panel on the page, in order."""
        return [one.bounding_box() for one in self.page.locator(".bk-Figure").all()]

    def time_range(self):
        """Return where the common axis of time begins and ends."""
        return self.page.evaluate(
            """() => { const ranges = Bokeh.documents[0].roots().flatMap(r => r.children.map(c => c[0]))
              .filter(panel => panel.name === 'over time').map(panel => panel.x_range);
            return [[...new Set(ranges.map(r => r.start))], [...new Set(ranges.map(r => r.end))]] }"""
        )


@pytest.fixture(scope="module")
def window(browser, pages):
    """Opens each kind of page once: to draw one takes seconds. A test leaves it as it was."""
    opened = {}

    def open_page(kind):
        if kind not in opened:
            opened[kind] = Window(browser, pages[kind])
        return opened[kind]

    yield open_page
    for one in opened.values():
        one.context.close()


@pytest.mark.parametrize("kind", ["run", "run, interactive", "test", "test, interactive", "comparison"])
def test_every_page_is_whole_without_a_network(window, kind):
    shown = window(kind)
    assert shown.asked == []
    assert shown.complaints == []
    assert "SIMULATED" in shown.page.inner_text("h1")
    broken = "() => [...document.images].filter(i => !i.complete || i.naturalWidth === 0).length"
    assert shown.page.evaluate(broken) == 0
    for width in (420, WIDTH):  # of a telephone, and of a laptop
        shown.page.set_viewport_size({"width": width, "height": 900})
        shown.page.wait_for_timeout(200)
        size = "() => [document.documentElement.scrollWidth, document.documentElement.scrollHeight]"
        wide, high = shown.page.evaluate(size)
        assert wide <= width
        assert high > 1000


def test_links_of_a_test_open_the_runs_reports(window):
    shown = window("test")
    shown.page.get_by_role("link", name="b7-2_0001_shake").click()
    assert shown.page.inner_text("h1").startswith("b7-2_0001_shake")
    shown.page.go_back()


def test_motion_band_and_dropout_are_really_drawn(window):
    shown = window("run, interactive")
    panel = shown.page.locator(".bk-Figure").first
    picture = cv2.imdecode(np.frombuffer(panel.screenshot(), np.uint8), cv2.IMREAD_COLOR_RGB).astype(int)
    for colour, least in (((0x1F, 0x5F, 0x8B), 500), ((0xC8, 0x65, 0x1B), 300), ((0xE6, 0xE2, 0xDA), 300)):
        near = np.abs(picture - np.array(colour)).max(axis=2) < 12
        assert near.sum() > least, f"hardly anything of colour {colour}"
    # The shade of the invented dropout lies where its times are: the axis runs over the panel's inner width.
    shade = np.flatnonzero((np.abs(picture - np.array((0xE6, 0xE2, 0xDA))).max(axis=2) < 3).sum(axis=0) > 30)
    starts, ends = shown.time_range()
    inner = picture.shape[1] - 64  # px, less the border at the left
    expected = 64 + inner * (np.array(example.DROPOUT_S) - starts[0]) / (ends[0] - starts[0])
    assert abs(shade[-1] - expected[1]) < 12
    assert np.isclose(shade, expected[0], atol=12).any()


def test_a_drag_zooms_all_panels_and_a_double_click_shows_all_again(window):
    shown = window("run, interactive")
    (start,), (end,) = shown.time_range()
    box = shown.panels()[0]
    x0, x1, y = box["x"] + 200, box["x"] + 300, box["y"] + 30
    shown.page.mouse.move(x0, y)
    shown.page.mouse.down()
    shown.page.mouse.move(x1, y + 20, steps=4)
    shown.page.mouse.move(x1, y + 80, steps=4)
    shown.page.mouse.up()
    shown.page.wait_for_timeout(300)
    (zoomed_start,), (zoomed_end,) = shown.time_range()
    share = (zoomed_end - zoomed_start) / (end - start)
    assert share == pytest.approx(100 / (box["width"] - 64), rel=0.08)
    shown.page.mouse.dblclick(x0, y + 20)
    shown.page.wait_for_timeout(300)
    assert shown.time_range() == [[start], [end]]


def test_pointing_tells_the_value_that_stands_in_the_table(window, pages):
    shown = window("run, interactive")
    box = shown.panels()[0]
    shown.page.mouse.move(box["x"] + 350, box["y"] + 60)
    shown.page.mouse.move(box["x"] + 351, box["y"] + 61)
    tip = shown.page.locator(".bk-Tooltip", has_text="fused").first.locator(".bk-tooltip-row-value")
    tip.first.wait_for(timeout=5000)
    words = " ".join(tip.all_inner_texts())
    found = re.search(r"(\S+) ± (\S+) mm (\S+) s", words.replace("−", "-"))
    assert found is not None, words
    value, half, t_s = (float(x) for x in found.groups())
    table = pq.read_table(pages["run"].parent / "fused.parquet", filters=[("kind", "=", "imu")]).to_pydict()
    row = int(np.argmin(np.abs(np.array(table["t_s"]) - t_s)))
    # Four decimals are shown, of single-precision numbers.
    assert value == pytest.approx(table["dx_mm"][row], abs=6e-5)
    assert half == pytest.approx(1.96 * table["sd_dx_mm"][row], abs=6e-5)


def test_a_component_that_is_hidden_is_hidden_in_every_panel(window):
    shown = window("test, interactive")
    visible = """() => Bokeh.documents[0].roots().map(r => r.children.flatMap(
    c => c[0].renderers.filter(m => ['Line', 'VArea'].includes(m.glyph.type)).map(m => m.visible)))"""
    motion, spectra = shown.page.evaluate(visible)
    assert motion == [True] * 24  # two components in six panels, a line and a band each
    assert spectra == [True] * 12
    shown.page.locator(".bk-Figure").first.get_by_text("C", exact=True).click()
    motion, _ = shown.page.evaluate(visible)
    assert motion == [True, True, False, False] * 6
    shown.page.locator(".bk-Figure").first.get_by_text("C", exact=True).click()
    assert shown.page.evaluate(visible)[0] == [True] * 24
