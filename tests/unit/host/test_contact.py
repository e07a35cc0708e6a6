"""Many units are asked side by side, each by who it is; one that fails is one answer among the others."""

import threading
import time

import pytest
from fake_unit import FakeUnit
from run_folders import make_run

from bricktrack_common.errors import ConfigError, UnitTimeoutError
from bricktrack_host.transfer.contact import Dialer, ask_units
from bricktrack_host.transfer.fleet_config import UnitConfig


@pytest.fixture
def units(tmp_path):
    made = []
    for i in range(3):
        make_run(tmp_path / f"u{i}", f"u{i}_0001", {"video.h264": 10})
        made.append(FakeUnit(tmp_path / f"u{i}", name=f"u{i}"))
    with made[0], made[1], made[2]:
        yield made


def configs(units):
    return [UnitConfig(name=u.name, address=u.address) for u in units]


def test_answers_come_in_the_order_of_the_units_and_are_told_at_once(units):
    told = {}
    asked = [*configs(units), UnitConfig(name="gone", address="tcp://127.0.0.1:9")]
    answers = ask_units(
        asked, lambda c: c.client.status().unit, dialer=Dialer(timeout_s=0.4),
        told=lambda unit, answer: told.update({unit.name: answer}),
    )  # fmt: skip
    assert answers[:3] == ["u0", "u1", "u2"]
    assert isinstance(answers[3], UnitTimeoutError)
    assert [told[u.name] for u in asked] == answers


def test_silent_units_are_waited_for_side_by_side():
    gone = [UnitConfig(name=f"g{i}", address=f"tcp://127.0.0.{i + 2}:9") for i in range(20)]
    began = time.monotonic()
    answers = ask_units(gone, lambda c: None, dialer=Dialer(timeout_s=0.5))
    assert all(isinstance(a, UnitTimeoutError) for a in answers)
    assert time.monotonic() - began < 5  # one after the other, it would be ten


def test_another_unit_at_the_address_is_refused_before_it_is_asked_anything(units):
    [answer] = ask_units(
        [UnitConfig(name="u7", address=units[0].address)], lambda c: c.client.disarm(), dialer=Dialer()
    )
    assert isinstance(answer, ConfigError)
    assert [type(r).__name__ for r in units[0].requests] == ["Hello"]


def test_a_bug_in_a_question_stops_the_others(units):
    stop = threading.Event()

    def ask(contact):
        if contact.unit.name == "u1":
            raise ZeroDivisionError
        return contact.hello.unit

    with pytest.raises(ZeroDivisionError):
        ask_units(configs(units), ask, dialer=Dialer(stop=stop))
    assert stop.is_set()
