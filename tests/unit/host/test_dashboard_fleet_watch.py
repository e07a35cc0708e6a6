"""The watch over units: what they answer is known, what changed is told once, and one that is gone says so."""

import time

import pytest
from fake_unit import FakeUnit

from bricktrack_host.dashboard.fleet_watch import FleetWatch
from bricktrack_host.transfer.contact import Dialer
from bricktrack_host.transfer.fleet_config import UnitConfig


def wait_for(condition):
    deadline_s = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < deadline_s, "it did not come about"
        time.sleep(0.01)


def unit_of(fake):
    return UnitConfig(name=fake.name, address=fake.address)


@pytest.fixture
def fakes(tmp_path):
    with FakeUnit(tmp_path, name="a") as a, FakeUnit(tmp_path, name="b") as b:
        yield a, b


def test_a_change_is_told_once_and_for_the_unit_that_changed(fakes):
    a, b = fakes
    units = [unit_of(b), unit_of(a)]
    with FleetWatch(units, Dialer(timeout_s=5.0), every_s=0.01) as watch:
        version, changed = watch.changes_since(-1)
        assert [view.name for view in changed] == ["b", "a"]
        wait_for(lambda: {v.state for v in watch.views().values()} == {"idle"})
        version, _ = watch.changes_since(version)
        assert watch.changes_since(version) == (version, [])
        b.state = "armed"
        wait_for(lambda: watch.changes_since(version)[1])
        version, changed = watch.changes_since(version)
        assert [(view.name, view.state) for view in changed] == [("b", "armed")]
        assert watch.changes_since(version) == (version, [])


def test_a_unit_that_falls_silent_is_said_so_and_seen_again_when_it_is_back(tmp_path):
    with FakeUnit(tmp_path, name="a") as fake:
        port = fake.port
        with FleetWatch([unit_of(fake)], Dialer(timeout_s=0.3), every_s=0.01) as watch:
            wait_for(lambda: watch.views()["a"].state == "idle")
            fake.stop()
            wait_for(lambda: watch.views()["a"].state == "no answer")
            assert " in time" in watch.views()["a"].note
            again = FakeUnit(tmp_path, name="a", port=port)
            with again:
                wait_for(lambda: watch.views()["a"].state == "idle")


def test_one_silent_unit_does_not_delay_what_is_known_of_others(fakes):
    a, _ = fakes
    nobody = UnitConfig(name="gone", address="tcp://127.0.0.1:9")
    with FleetWatch([nobody, unit_of(a)], Dialer(timeout_s=60.0), every_s=0.01) as watch:
        wait_for(lambda: watch.views()["a"].state == "idle")
        assert watch.views()["gone"].state == "asking"
        start_s = time.monotonic()
    assert time.monotonic() - start_s < 10.0, "it ends without waiting for the silent one's 60 s"


def test_another_unit_at_the_address_is_not_taken_for_the_one_meant(fakes):
    other = UnitConfig(name="c", address=fakes[0].address)
    with FleetWatch([other], Dialer(timeout_s=5.0), every_s=0.01) as watch:
        wait_for(lambda: watch.views()["c"].state == "no answer")
        assert "'a'" in watch.views()["c"].note
