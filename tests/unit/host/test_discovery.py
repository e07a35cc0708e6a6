"""Units are found by what they announce, over real mDNS on the loopback interface where that is possible."""

import socket

import pytest
from fake_unit import FakeUnit
from run_folders import contents, make_run

from bricktrack_common.discovery import SERVICE_TYPE, Announcement
from bricktrack_common.errors import ConfigError
from bricktrack_common.key_files import fingerprint, make_key_pair
from bricktrack_host.transfer.contact import Dialer, ask_units
from bricktrack_host.transfer.discovery import NetworkFinder
from bricktrack_host.transfer.fleet_config import UnitConfig
from bricktrack_host.transfer.pull import pull_unit

zeroconf = pytest.importorskip("zeroconf")


def open_network():
    return zeroconf.Zeroconf(interfaces=["127.0.0.1"])


@pytest.fixture
def network():
    try:
        opened = open_network()
    except OSError as e:
        pytest.skip(f"no multicast on this machine's loopback interface: {e}")
    yield opened
    opened.unregister_all_services()
    opened.close()


@pytest.fixture
def finder():
    made = NetworkFinder(open_network, search_s=10.0)  # ends as soon as the unit is found
    yield made
    made.close()


def announce(network, unit, *, port, key="", addresses=("127.0.0.1",), txt=None):
    announcement = Announcement(unit, key_fingerprint=key)
    info = zeroconf.ServiceInfo(
        SERVICE_TYPE, announcement.service_name, port=port, server=f"{unit}.local.",
        properties=announcement.as_txt() if txt is None else txt, parsed_addresses=list(addresses),
    )  # fmt: skip
    network.register_service(info, cooperating_responders=True)  # nobody else claims the name: no waiting


def test_units_are_found_by_name_and_strangers_are_passed_over(network, finder):
    announce(network, "b2", port=41002)
    announce(network, "b1", port=41001)
    announce(network, "printer", port=631, txt={"unit": "../etc"})
    assert finder.find(UnitConfig(name="b2")) == "tcp://127.0.0.1:41002"
    assert finder.find(UnitConfig(name="b1")) == "tcp://127.0.0.1:41001"
    finder._search_s = 0.0  # whoever is there has answered
    found = finder.find_all()
    assert [f.announcement.unit for f in found] == ["b1", "b2"]
    assert found[0].addresses == ("tcp://127.0.0.1:41001",)
    assert finder.find(UnitConfig(name="b3")) is None


def test_who_announces_another_key_is_not_the_unit(network, finder):
    right, wrong = make_key_pair().public, make_key_pair().public
    announce(network, "b1", port=41001, key=fingerprint(wrong))
    assert finder.find(UnitConfig(name="b1", server_key=wrong)) == "tcp://127.0.0.1:41001"
    finder._search_s = 0.0
    assert finder.find(UnitConfig(name="b1", server_key=right)) is None


def test_of_several_addresses_the_one_that_answers_is_taken(network, finder):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        # 127.0.0.2 is this machine too, and nobody listens there.
        announce(network, "b1", port=port, addresses=("127.0.0.2", "127.0.0.1"))
        assert finder.find(UnitConfig(name="b1")) == f"tcp://127.0.0.1:{port}"


class Everywhere:
    """A finder that says the same of every unit."""

    def __init__(self, address):
        self.address = address

    def find(self, unit):
        return self.address


def test_a_unit_without_a_key_is_followed_on_this_machine_only(caplog):
    dialer = Dialer(finder=Everywhere("tcp://10.0.0.9:41733"))
    assert dialer._find(UnitConfig(name="b1")) is None
    assert "without server_key" in caplog.text
    key = make_key_pair().public
    assert dialer._find(UnitConfig(name="b1", server_key=key)) == "tcp://10.0.0.9:41733"
    assert Dialer(finder=Everywhere("tcp://127.0.0.1:1"))._find(UnitConfig(name="b1")) == "tcp://127.0.0.1:1"


def test_a_unit_that_moved_is_found_and_its_run_comes(tmp_path):
    """The address in the fleet file is the one that it had yesterday; its name is what counts."""
    source = make_run(tmp_path / "card", "fake_0001", {"video.h264": 1000})
    with FakeUnit(tmp_path / "card") as unit, socket.create_server(("127.0.0.1", 0)) as silent:
        yesterday = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        config = UnitConfig(name="fake", address=yesterday)
        dialer = Dialer(timeout_s=0.3, finder=Everywhere(unit.address))
        result = pull_unit(config, tmp_path / "runs", dialer=dialer)
        nameless = pull_unit(UnitConfig(name="fake"), tmp_path / "more", dialer=dialer)
        other = pull_unit(UnitConfig(name="b7", address=yesterday), tmp_path / "runs", dialer=dialer)
    assert contents(tmp_path / "runs" / "fake_0001") == contents(source)
    assert contents(tmp_path / "more" / "fake_0001") == contents(source)
    assert (result.errors, nameless.errors) == ([], [])
    assert "calls itself 'fake'; the fleet file calls it 'b7'" in str(other.errors[0])


class Register:
    """A finder that knows where each unit is."""

    def __init__(self, units):
        self.addresses = {unit.name: unit.address for unit in units}

    def find(self, unit):
        return self.addresses.get(unit.name)


def test_units_that_changed_places_are_told_apart(tmp_path):
    """Addresses that are handed out go round: each unit is where the other was."""
    for name in ("b1", "b2"):
        make_run(tmp_path / name, f"{name}_0001", {"video.h264": 1000}, unit=name)
    with FakeUnit(tmp_path / "b1", name="b1") as b1, FakeUnit(tmp_path / "b2", name="b2") as b2:
        swapped = [UnitConfig(name="b1", address=b2.address), UnitConfig(name="b2", address=b1.address)]
        dialer = Dialer(timeout_s=1.0, finder=Register([b1, b2]))
        names = ask_units(swapped, lambda c: c.client.status().unit, dialer=dialer)
        assert [type(r).__name__ for r in b1.requests].count("GetStatus") == 1
    assert names == ["b1", "b2"]


def test_a_unit_without_an_address_that_nobody_finds_is_said(tmp_path):
    with (
        pytest.raises(ConfigError, match="has no address in the fleet file and was not found by its name"),
        Dialer().client(UnitConfig(name="b1")),
    ):
        pass
