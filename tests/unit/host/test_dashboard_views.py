"""What the page makes of units, of their places and of their pictures."""

import math

import cv2
import numpy as np
import pytest

from bricktrack_common.clocks import read_clock_triplet
from bricktrack_common.errors import UnitTimeoutError
from bricktrack_common.wire_messages import HealthItem, StatusReply, StillImage
from bricktrack_host.dashboard.aim_view import aim_view
from bricktrack_host.dashboard.plan import places, plan_svg
from bricktrack_host.dashboard.unit_view import STATES, UnitView, view_of
from bricktrack_host.transfer.fleet_config import UnitConfig


def answer(**changes):
    values = {
        "unit": "b1", "state": "idle", "runs": 2, "disk_free_bytes": 10**10, "disk_needed_bytes": 10**9,
        "frames": 0, "imus": [], "edges": 0, "clocks": read_clock_triplet(),
    }  # fmt: skip
    return StatusReply(**{**values, **changes})


FAILING = HealthItem(name="camera", level="fail", words="no camera", remedy="Check the ribbon cable")
WARNING = HealthItem(name="power", level="warn", words="under-voltage", remedy="Use a stronger supply")


@pytest.mark.parametrize(
    ("said", "state", "problems"),
    [
        (answer(), "idle", ()),
        (answer(health=[WARNING]), "idle", ()),
        (answer(health=[FAILING]), "not ready", (("camera: no camera", "Check the ribbon cable"),)),
        (answer(state="armed", run_id="b1_9f31c2_0007_a"), "armed", ()),
        (answer(state="recording", run_id="b1_9f31c2_0007"), "recording", ()),
        (
            answer(state="fault", reason="card full"),
            "fault",
            (("card full", "'bricktrack disarm' clears it"),),
        ),
        (
            answer(disk_free_bytes=5 * 10**8),
            "not ready",
            (("0.5 GB free; a run needs 1.0 GB", "Pull its runs, then delete them"),),
        ),
        (UnitTimeoutError("b1: silent. Is it on?"), "no answer", (("b1: silent", "Is it on?"),)),
    ],
)
def test_a_unit_has_one_state_and_a_remedy_for_each_problem(said, state, problems):
    view = view_of("b1", said)
    assert view.state == state
    assert view.problems == problems


def test_a_warning_is_told_but_keeps_no_unit_from_recording():
    view = view_of("b1", answer(health=[WARNING]))
    assert view.warnings == (("power: under-voltage", "Use a stronger supply"),)
    assert view.note == "power: under-voltage"


def test_states_are_told_apart_without_colours_and_their_words_can_be_read():
    letters = [look.letter for look in STATES.values()]
    assert len(set(letters)) == len(letters)
    for look in STATES.values():
        # WCAG 2.1, relative luminance; 3 : 1 is asked of large letters.
        bright, dark = sorted((luminance(look.fill), luminance(look.ink)), reverse=True)
        assert (bright + 0.05) / (dark + 0.05) > 3.0


def luminance(colour):
    shares = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4 for s in shares]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_the_plan_is_to_scale_with_y_up():
    units = [
        UnitConfig(name="a", position_mm=(0.0, 0.0)),
        UnitConfig(name="b", position_mm=(300.0, 0.0)),
        UnitConfig(name="c", position_mm=(0.0, 150.0)),
    ]
    (a, b, c), width, height = places(units)
    assert b[1] == a[1] and c[0] == a[0]
    assert c[1] < a[1] < height and b[0] < width
    assert (b[0] - a[0]) / (a[1] - c[1]) == pytest.approx(2.0)


@pytest.mark.parametrize("n", [1, 2, 7, 400])
def test_without_all_positions_it_is_a_grid_where_no_tiles_meet(n):
    units = [UnitConfig(name=f"u{i}", position_mm=(0.0, 0.0) if i else None) for i in range(n)]
    at, width, height = places(units)
    assert len(set(at)) == n
    assert all(0 < x < width and 0 < y < height for x, y in at)


@pytest.mark.parametrize("seed", range(5))
def test_tiles_at_any_positions_do_not_overlap(seed):
    draw = np.random.default_rng(seed)
    units = [
        UnitConfig(name=f"u{i}", position_mm=(float(x), float(y)))
        for i, (x, y) in enumerate(draw.uniform(0, 5000, (40, 2)))
    ]
    at, _, _ = places(units)
    for i, (x, y) in enumerate(at):
        for other_x, other_y in at[i + 1 :]:
            assert max(abs(x - other_x), abs(y - other_y)) > 40.0


def test_the_plan_says_each_state_in_words():
    svg = plan_svg([UnitConfig(name="b1")], {"b1": UnitView("b1", "not ready")})
    assert 'data-state="not ready"' in svg and 'aria-label="b1: not ready"' in svg and ">!<" in svg


def still(luma):
    data = cv2.imencode(".png", luma)[1].tobytes()
    image = StillImage(
        encoding="png", width_px=luma.shape[1], height_px=luma.shape[0], n_bytes=len(data), crc32=0,
        model="fake", mode="full", exposure_us=2000, analogue_gain=1.5, colour_gains=(1.0, 1.0), lit=True,
        taken_ns=1, simulated=True,
    )  # fmt: skip
    return aim_view(image, data, source="b1")


def test_each_led_has_its_room_to_each_border():
    luma = np.full((540, 960), 30, np.uint8)
    cv2.circle(luma, (200, 250), 25, 200, -1)
    cv2.circle(luma, (900, 300), 25, 200, -1)
    left, right = still(luma).leds
    # From rim to border by construction; the rim is blurred over about a pixel.
    for led, (u, v) in ((left, (200, 250)), (right, (900, 300))):
        room = (u - 25, v - 25, 959 - u - 25, 539 - v - 25)
        assert (led.left_px, led.top_px, led.right_px, led.bottom_px) == pytest.approx(room, abs=1.5)
    assert still(luma).advice == ["LED 2: less than 40 px from the border. Turn the camera"]


def test_exposure_and_darkness_are_told():
    luma = np.full((540, 960), 30, np.uint8)
    dark = still(luma)
    assert not dark.leds and math.isnan(dark.focus_px) and dark.full_share == 0.0
    assert "No LED is seen" in dark.advice[0]
    cv2.circle(luma, (400, 250), 25, 235, -1)
    bright = still(luma)
    assert bright.n_bright == 1 and "full level" in bright.advice[0]
    assert bright.full_share == pytest.approx(math.pi * 25**2 / (540 * 960), rel=0.05)
    assert bright.histogram_svg.count("<rect") == 2  # the two levels that there are
