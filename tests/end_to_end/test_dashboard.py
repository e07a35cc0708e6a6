"""The control page in a real Chromium, over 400 simulated units and a few that need a hand."""

import contextlib
import os
import re
import subprocess
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_unit import FakeUnit
from headless_chromium import headless_chromium, needs_chromium
from light_fleet import LightFleet, write_fleet_file
from playwright.sync_api import expect
from run_folders import make_run
from small_lab import BRICK, UNITS, invented_run

from bricktrack_common.wire_messages import HealthItem, Read
from bricktrack_host.assemblies.combined_test import combine_test
from bricktrack_host.reporting.combined_report import write_combined_report
from bricktrack_host.transfer.unit_client import UnitClient

pytest.importorskip("nicegui", reason="the control page's libraries are not installed")

SIZES = {"desktop": (1440, 900), "tablet": (1024, 768), "tablet-upright": (800, 1280)}
FINGER_PX = 44  # WCAG 2.1, target size
N_LIGHT = 400
# Four hundred units, the server and the browser share the machine with other tests.
expect.set_options(timeout=30_000)

pytestmark = [pytest.mark.slow, needs_chromium]


def screenshot(page, name):
    """Keep a picture for people, where BRICKTRACK_PICTURES names a folder."""
    if folder := os.environ.get("BRICKTRACK_PICTURES"):
        page.wait_for_timeout(500)
        page.screenshot(path=Path(folder) / f"{name}.png")


def write_test(lab):
    """Write a combined test of two invented runs, one of which has a report."""
    results = {}
    for unit in UNITS:
        invented_run(lab / "runs" / f"{unit}_0001_shake", unit)
        results[unit] = lab / "runs" / f"{unit}_0001_shake" / "results"
    (results["b7-2"] / "report.html").write_text("<p>the run's own report")
    combine_test("shake-12", results, [BRICK], lab / "tests/shake-12/combined", also=write_combined_report)


def picture_of_leds():
    luma = np.full((540, 960), 30, np.uint8)
    for u in (200, 400, 940):
        cv2.circle(luma, (u, 250), 15, 200, -1)
    return cv2.imencode(".png", luma)[1].tobytes()


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """The page's address, the light units' ports, and the two units that misbehave."""
    folder = tmp_path_factory.mktemp("lab")
    names = [f"u-{i:04d}" for i in range(N_LIGHT)]
    with contextlib.ExitStack() as opened:
        light = opened.enter_context(LightFleet(folder / "cards", names))
        fakes = {}
        for name in ("aimed", "broken"):
            make_run(folder / name, f"{name}_0001", {"video.h264": 600_000}, unit=name)
            fakes[name] = opened.enter_context(FakeUnit(folder / name, name=name))
        fakes["aimed"].picture = picture_of_leds()
        fakes["broken"].health = [
            HealthItem(name="camera", level="fail", words="no <b>camera</b>", remedy="Check the ribbon cable")
        ]
        file = write_fleet_file(folder / "fleet.toml", {n: light.ports[n] for n in names})
        with file.open("a") as text:
            for name, unit in fakes.items():
                text.write(f'[[unit]]\nname = "{name}"\naddress = "{unit.address}"\n')
            text.write('[[unit]]\nname = "gone"\naddress = "tcp://127.0.0.1:9"\n')  # nobody listens there
        write_test(folder)
        command = [sys.executable, "-m", "bricktrack_host.cli", "dashboard", "--fleet", str(file)]
        served = subprocess.Popen([*command, "--port", "0"], stdout=subprocess.PIPE, text=True)
        try:
            url = served.stdout.readline().split()[-1]
            yield url, light, fakes, folder
        finally:
            served.terminate()
            served.communicate(timeout=30)


@pytest.fixture(scope="module")
def page(lab):
    with headless_chromium() as chromium:
        context = chromium.new_context(viewport={"width": 1440, "height": 900}, has_touch=True)
        asked = []
        context.on("request", lambda request: asked.append(request.url))
        page = context.new_page()
        problems = []
        page.on("pageerror", lambda e: problems.append(str(e)))
        page.goto(lab[0], wait_until="commit")
        page.locator(".ag-row").first.wait_for(timeout=60_000)
        yield page
        assert not problems
        # No site but this machine's is asked for anything: the page works offline.
        assert {url.split("/")[2] for url in asked if not url.startswith("data:")} == {lab[0].split("/")[2]}


@pytest.fixture(autouse=True)
def _choose_none(page):
    yield
    page.keyboard.press("Escape")  # a dialog that a failed test left
    page.get_by_role("tab", name="Units").click()
    page.get_by_role("button", name="None").click()
    expect(page.get_by_text("Orders go to all")).to_be_visible()


def states(page, state):
    return page.locator(f'.unit[data-state="{state}"]')


def test_every_unit_has_its_state_on_the_plan_and_in_words(page):
    expect(states(page, "idle")).to_have_count(N_LIGHT + 1, timeout=60_000)
    expect(page.locator('.unit[data-unit="broken"]')).to_have_attribute("data-state", "not ready")
    expect(page.locator('.unit[data-unit="gone"]')).to_have_attribute("aria-label", "gone: no answer")
    expect(page.locator('.chip[data-state="idle"]')).to_contain_text(f"{N_LIGHT + 1} idle")
    expect(page.get_by_text("simulated units")).to_be_visible()


def test_the_document_itself_holds_the_plan(page, lab):
    """What is painted first needs no script: the plan comes with the document."""
    text = page.request.get(lab[0]).text()
    assert text.count('class="unit"') == N_LIGHT + 3


def test_a_change_is_seen(page, lab):
    with UnitClient(f"tcp://127.0.0.1:{lab[1].ports['u-0123']}") as client:
        client.arm("elsewhere")
        # How soon is measured by scripts/bench_dashboard.py: here the machine may be busy.
        page.locator('.unit[data-unit="u-0123"][data-state="armed"]').wait_for()
        client.disarm()
    expect(page.locator('.unit[data-unit="u-0123"]')).to_have_attribute("data-state", "idle")


def test_the_checks_name_the_remedy(page):
    page.get_by_role("tab", name="Checks").click()
    row = page.locator(".lines tr", has_text="broken")
    expect(row).to_contain_text("camera: no <b>camera</b>")  # a unit's words are words, not markup
    expect(row).to_contain_text("Check the ribbon cable")
    expect(page.locator(".lines tr", has_text="gone")).to_contain_text("fails")


def test_the_table_filters_and_its_choice_is_marked_on_the_plan(page):
    page.get_by_placeholder("Filter").fill("u-001")
    expect(page.locator(".ag-center-cols-container .ag-row")).to_have_count(10)
    page.get_by_role("button", name="All shown").click()
    expect(page.locator(".unit.chosen")).to_have_count(10)
    expect(page.get_by_text("Orders go to the 10 units chosen")).to_be_visible()
    page.get_by_placeholder("Filter").fill("")


def test_units_touched_are_armed_and_disarmed_and_say_so(page, lab):
    for name in ("u-0007", "u-0042"):
        page.locator(f'.unit[data-unit="{name}"]').tap()
    expect(page.get_by_text("Orders go to the 2 units chosen")).to_be_visible()
    page.get_by_role("button", name="Arm", exact=True).click()
    page.get_by_label("Label of the runs").fill("shake-0.3g")
    page.get_by_role("dialog").get_by_role("button", name="Arm").click()
    expect(page.get_by_text("letters, digits and hyphens")).to_be_visible()
    page.get_by_label("Label of the runs").fill("shake-07")
    page.get_by_role("dialog").get_by_role("button", name="Arm").click()
    expect(page.locator(".order-words")).to_contain_text("arm shake-07: 2 of 2 units acknowledged")
    expect(states(page, "armed")).to_have_count(2)
    with UnitClient(f"tcp://127.0.0.1:{lab[1].ports['u-0042']}") as client:
        assert client.status().run_id.endswith("_shake-07")
    page.get_by_role("tab", name="Orders").click()
    expect(page.locator(".lines tr", has_text="u-0042")).to_contain_text(re.compile("armed, run u-0042_"))
    page.get_by_role("button", name="Disarm", exact=True).click()
    expect(page.locator(".order-words")).to_contain_text("disarm: 2 of 2 units acknowledged")
    expect(states(page, "armed")).to_have_count(0)


def test_all_units_are_armed_or_disarmed_only_after_asking(page):
    expect(states(page, "idle")).to_have_count(N_LIGHT + 1, timeout=60_000)
    before = page.locator(".order-words").all_text_contents()
    page.get_by_role("button", name="Disarm", exact=True).click()
    expect(page.get_by_text(f"Disarm all {N_LIGHT + 3} units?")).to_be_visible()
    page.get_by_role("button", name="Keep them").click()
    expect(page.get_by_text(f"Disarm all {N_LIGHT + 3} units?")).to_be_hidden()
    page.get_by_role("button", name="Arm", exact=True).click()
    expect(page.get_by_text(f"Arm all {N_LIGHT + 3} units for the next first edge?")).to_be_visible()
    expect(page.get_by_text("Not idle, so not to be armed: broken, gone")).to_be_visible()
    screenshot(page, "arm-all")
    page.get_by_role("button", name="Cancel").click()
    assert page.locator(".order-words").all_text_contents() == before


def test_a_unit_that_does_not_do_as_told_is_named(page):
    page.locator('.unit[data-unit="gone"]').tap()
    expect(page.get_by_text("Orders go to gone alone")).to_be_visible()
    page.get_by_role("button", name="Disarm", exact=True).click()
    expect(page.locator(".order-words")).to_contain_text(
        "disarm: 0 of 1 units acknowledged, 1 failed", timeout=20_000
    )
    page.get_by_role("tab", name="Orders").click()
    expect(page.locator(".lines tr", has_text="gone")).to_contain_text("FAILED")


def test_a_camera_is_aimed(page):
    page.locator('.unit[data-unit="aimed"]').tap()
    page.get_by_role("tab", name="Aim").click()
    page.get_by_role("button", name="Take a picture").click()
    # On a new machine the loops that find LEDs are compiled first.
    expect(page.get_by_text("aimed (simulated): 3 LEDs")).to_be_visible(timeout=120_000)
    expect(page.get_by_text("LED 3: less than 40 px from the border")).to_be_visible()
    expect(page.locator(".q-table tbody tr")).to_have_count(3)
    screenshot(page, "aim")


def test_runs_are_pulled_and_each_unit_shows_how_far_it_is(page, lab):
    go_on = threading.Event()

    def hold(request, messages):
        if isinstance(request, Read) and request.offset > 0:
            assert go_on.wait(30.0)
        return messages

    lab[2]["aimed"].misbehave = hold
    page.locator('.unit[data-unit="aimed"]').tap()
    page.get_by_role("button", name="Pull runs").click()
    page.get_by_role("tab", name="Orders").click()
    bar = page.get_by_role("progressbar", name="pulled from aimed")
    expect(bar).to_be_visible(timeout=30_000)
    screenshot(page, "orders")
    assert float(bar.get_attribute("value")) < 1.0
    go_on.set()
    expect(page.locator(".order-words")).to_contain_text("pull: 1 of 1 units done", timeout=30_000)
    expect(page.locator(".lines tr", has_text="aimed")).to_contain_text("1 run here, verified")
    assert (lab[3] / "runs" / "aimed_0001" / "video.h264").stat().st_size == 600_000


def test_the_last_test_is_told_and_its_reports_open(page, lab):
    page.get_by_role("tab", name="Last test").click()
    expect(page.get_by_text("shake-12 (simulated)")).to_be_visible()
    expect(page.get_by_text("Usable with care: 2 of 2 units on the same samples")).to_be_visible()
    expect(page.locator(".q-table tr", has_text="brick-7").first).to_contain_text("good")
    expect(page.locator(".q-table tr", has_text="b7-2_0001_shake")).to_contain_text("452 of 462")
    screenshot(page, "last-test")
    with page.context.expect_page() as opened:
        page.get_by_role("link", name="Report", exact=True).click()
    report = opened.value
    expect(report.locator("h1")).to_contain_text("shake-12")
    report.get_by_role("link", name="b7-2_0001_shake").first.click()  # from there to a run's own
    expect(report.get_by_text("the run's own report")).to_be_visible()
    report.close()
    assert page.request.get(f"{lab[0]}/lab/fleet.toml").status == 404


def test_it_can_be_used_by_keys_alone(page):
    """Tab goes to the plan once, arrows from unit to unit, space chooses; everything touchable has a name."""
    first = page.locator(".unit").first
    assert page.locator('.unit[tabindex="0"]').count() == 1
    first.focus()
    n_columns = page.evaluate(
        "() => new Set([...document.querySelectorAll('.unit')].map(t => t.getBoundingClientRect().x)).size"
    )
    names = page.evaluate("() => [...document.querySelectorAll('.unit')].map(t => t.dataset.unit)")
    for key in ("ArrowRight", "ArrowRight", "ArrowDown", "ArrowLeft"):
        page.keyboard.press(key)
    reached = page.evaluate("() => document.activeElement.dataset.unit")
    assert reached == names[n_columns + 1]  # second row, second column
    assert page.locator('.unit[tabindex="0"]').get_attribute("data-unit") == reached
    page.keyboard.press("Space")
    expect(page.get_by_text(f"Orders go to {reached} alone")).to_be_visible()
    expect(page.locator(f'.unit[data-unit="{reached}"]')).to_have_attribute("aria-pressed", "true")
    page.keyboard.press("Enter")
    expect(page.get_by_text("Orders go to all")).to_be_visible()
    nameless = """() => [...document.querySelectorAll('button, input, a, [role=button], [role=tab]')]
        .filter(e => e.getClientRects().length && !(e.ariaLabel || e.textContent.trim() || e.title ||
                     e.placeholder || e.labels?.length)).map(e => e.outerHTML.slice(0, 200))"""
    for tab in ("Units", "Checks", "Aim", "Orders", "Last test"):
        page.get_by_role("tab", name=tab).click()
        assert page.evaluate(nameless) == [], tab


def test_it_is_usable_at_every_size(page):
    """Nothing hangs over the side, and what is touched is large enough to be hit."""
    small = f"""() => [...document.querySelectorAll('button, [role=tab], a, .ag-row')]
        .filter(e => e.getClientRects().length && e.getBoundingClientRect().height < {FINGER_PX})
        .map(e => e.outerHTML.slice(0, 200))"""
    for name, (width, height) in SIZES.items():
        page.set_viewport_size({"width": width, "height": height})
        for tab in ("Units", "Checks", "Aim", "Orders", "Last test"):
            page.get_by_role("tab", name=tab).click()
            page.wait_for_timeout(300)
            assert page.evaluate("document.documentElement.scrollWidth") <= width, (name, tab)
            assert page.evaluate(small) == [], (name, tab)
            screenshot(page, f"{name}-{tab.split()[0]}")
    page.set_viewport_size({"width": 1440, "height": 900})
