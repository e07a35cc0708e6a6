"""Orders from the page: each unit's acknowledgement is kept, a pull shows how far it is, and one goes at a time."""

import threading

import pytest
from fake_unit import FakeUnit
from run_folders import contents, make_run

from bricktrack_common.errors import UnitError
from bricktrack_common.wire_codec import decode_reply, encode_message
from bricktrack_common.wire_messages import Arm, Read, Refusal
from bricktrack_host.dashboard.html_table import MOST_LISTED, Bar, html_table
from bricktrack_host.dashboard.orders import Order, OrderBusyError, OrderDesk, OrderLine, Pulled
from bricktrack_host.transfer.contact import Dialer
from bricktrack_host.transfer.fleet_config import UnitConfig


class Lab:
    """Two units, each with a run of 600 kB, and the desk that commands them."""

    def __init__(self, folder, fakes, runs):
        self.fakes, self.runs, self.folder = fakes, runs, folder
        units = [UnitConfig(name=f.name, address=f.address) for f in fakes.values()]
        self.desk = OrderDesk(units, Dialer(timeout_s=5.0), runs)


@pytest.fixture
def lab(tmp_path):
    fakes = {}
    for name in ("a", "b"):
        make_run(tmp_path / name, f"{name}_0001_x", {"video.h264": 600_000}, unit=name)
        fakes[name] = FakeUnit(tmp_path / name, name=name)
    with fakes["a"], fakes["b"]:
        yield Lab(tmp_path, fakes, tmp_path / "pulled")


def refuse(kind, words):
    """Misbehave: answer requests of this kind with a refusal of these words."""

    def misbehave(request, messages):
        if not isinstance(request, kind):
            return messages
        number, _ = decode_reply(messages[0][0])
        return [[encode_message(number, Refusal(code="wrong-state", message=words))]]

    return misbehave


def test_each_acknowledgement_and_each_refusal_is_kept(lab):
    lab.fakes["b"].misbehave = refuse(Arm, "the card is full")
    order = lab.desk.arm(["a", "b"], "shake-07", None)
    assert order.words == "arm shake-07: 1 of 2 units acknowledged, 1 failed"
    assert order.share == 1.0
    refused, done = order.lines()
    assert (refused.unit, refused.level) == ("b", "FAILED") and "the card is full" in refused.words
    assert done == OrderLine("a", "done", "armed, run a_0001_shake-07, without imu base: no answer")
    assert lab.desk.current is order
    assert lab.desk.disarm(["a"]).lines() == [OrderLine("a", "done", "idle")]


def test_a_pull_tells_how_far_each_unit_is(lab):
    reached, go_on = threading.Event(), threading.Event()

    def hold(request, messages):
        if isinstance(request, Read) and request.offset >= 262_144:  # the second chunk of the video
            reached.set()
            assert go_on.wait(20.0)
        return messages

    lab.fakes["b"].misbehave = hold
    pulling = threading.Thread(target=lab.desk.pull, args=(["a", "b"],))
    pulling.start()
    assert reached.wait(20.0)
    order = lab.desk.current
    lines = {line.unit: line for line in order.lines()}
    assert lines["b"].level == "under way"
    assert 0.0 <= lines["b"].share < 1.0 and lines["b"].words.endswith("of 0.6 MB")
    assert "under way" in order.words and order.share < 1.0
    with pytest.raises(OrderBusyError, match="'pull' is under way"):
        lab.desk.disarm(["a"])
    go_on.set()
    pulling.join(20.0)
    assert {line.level for line in order.lines()} == {"done"}
    # Its manifest is not counted among what is to come, the video is.
    assert [p.n_bytes for p in order.pulled.values()] == [p.n_bytes_total for p in order.pulled.values()]
    assert order.n_bytes[1] >= 1_200_000
    for name, fake in lab.fakes.items():
        assert contents(lab.runs / f"{name}_0001_x") == contents(fake.runs / f"{name}_0001_x")


def test_a_unit_that_cannot_be_pulled_from_is_named_and_the_others_come(lab):
    lab.fakes["a"].misbehave = refuse(Read, "the card cannot be read")
    order = lab.desk.pull(["a", "b"])
    assert [line.level for line in order.lines() if line.unit == "b"] == ["done"]
    [failed] = [line for line in order.lines() if line.level == "FAILED"]
    assert failed.unit == "a" and "the card cannot be read" in failed.words


def test_pulling_without_a_fleet_file_says_what_is_needed():
    with pytest.raises(UnitError, match="Start the page with --fleet"):
        OrderDesk([], Dialer(), None).pull([])


def test_what_goes_wrong_stands_first_and_what_waits_before_what_is_done():
    order = Order("pull", ("a", "b", "c", "d"))
    order.acknowledged["a"] = "1 run here, verified"
    order.pulled["b"] = Pulled(1_000_000, 4_000_000, has_its_turn=True)
    order.pulled["c"] = Pulled(0, 2_000_000)
    assert order.lines() == [
        OrderLine("b", "under way", "1.0 of 4.0 MB", 0.25),
        OrderLine("c", "waits", "2.0 MB to come"),
        OrderLine("d", "waits", ""),
        OrderLine("a", "done", "1 run here, verified"),
    ]
    assert order.share == pytest.approx(1 / 6)
    order.refused["d"] = "silent"
    assert order.lines()[0] == OrderLine("d", "FAILED", "silent")


def test_tables_hold_words_and_no_markup_of_units():
    text = html_table(("unit", "says"), [("<b>", Bar(0.25, 'pulled from "x"', "1 of 4 MB"))])
    assert "<td>&lt;b&gt;</td>" in text
    assert 'value="0.250"' in text and "pulled from &quot;x&quot;" in text
    long = html_table(("unit",), [(str(i),) for i in range(MOST_LISTED + 7)])
    assert long.count("<td>") == MOST_LISTED and "and 7 more" in long
    assert html_table(("unit",), []) == ""
