"""The fleet file: paths relative to it, and every mistake named with file and key."""

import pytest

from bricktrack_common.errors import ConfigError
from bricktrack_common.wire_messages import HelloReply
from bricktrack_host.transfer.fleet_config import check_name, load_fleet, unit_at

GOOD = """
runs_folder = "data/runs"

[[unit]]
name = "b1"
address = "tcp://10.0.0.21:41733"
calibration = "b1.json"
layout = "/etc/layout.toml"

[[unit]]
name = "b2"
address = "tcp://pi-b2.local:41733"
camera = "imu"
"""


def load(tmp_path, text):
    path = tmp_path / "fleet.toml"
    path.write_text(text)
    return load_fleet(path)


def test_paths_are_relative_to_the_file(tmp_path):
    fleet = load(tmp_path, GOOD)
    assert fleet.runs_path == tmp_path / "data/runs"
    assert fleet.unit[0].calibration_path == tmp_path / "b1.json"
    assert str(fleet.unit[0].layout_path) == "/etc/layout.toml"
    assert fleet.unit[1].calibration_path is None
    assert [u.camera for u in fleet.unit] == ["static", "imu"]


def test_a_place_in_the_plan_is_two_finite_numbers(tmp_path):
    placed = GOOD.replace('camera = "imu"', "position_mm = [1200.0, 400.0]")
    assert [u.position_mm for u in load(tmp_path, placed).unit] == [None, (1200.0, 400.0)]
    with pytest.raises(ConfigError, match=r"unit\[1\].position_mm: expected two finite"):
        load(tmp_path, placed.replace("400.0", "nan"))


def test_units_are_chosen_by_name(tmp_path):
    fleet = load(tmp_path, GOOD)
    assert [u.name for u in fleet.select(["b2"])] == ["b2"]
    assert [u.name for u in fleet.select(None)] == ["b1", "b2"]
    with pytest.raises(ConfigError, match="no unit 'b3' in the fleet; there are b1, b2"):
        fleet.select(["b3"])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('camera = "imu"', 'kamera = "imu"'), r"fleet\.toml: unit\[1\]: .*kamera"),
        (('camera = "imu"', 'camera = "moving"'), r"fleet\.toml: unit\[1\]\.camera"),
        (('runs_folder = "data/runs"', 'runs = "x"'), r"fleet\.toml: .*runs"),
        (('name = "b2"', 'name = "b1"'), r"unit\[1\]\.name: 'b1' stands twice"),
        (("pi-b2.local", "10.0.0.21"), r"unit\[1\]\.address: .* stands twice"),
        (('name = "b2"', 'name = "../b2"'), r"unit\[1\]\.name"),
        (("tcp://pi-b2.local:41733", "pi-b2.local"), r"unit\[1\]\.address: 'pi-b2\.local' is not an address"),
        (("tcp://pi-b2.local:41733", "tcp://pi-b2.local:99999"), "is not an address"),
        (("tcp://pi-b2.local:41733", "ipc:///tmp/x"), "is not an address"),
    ],
)
def test_mistakes_are_named(tmp_path, change, words):
    assert change[0] in GOOD
    with pytest.raises(ConfigError, match=words):
        load(tmp_path, GOOD.replace(*change))


def test_an_address_alone_is_a_unit_of_any_name():
    unit = unit_at("tcp://[::1]:41733")
    assert unit.name == "at-::1-41733".replace("::", "")
    check_name(HelloReply(unit="whatever", software="", simulated=True), unit, unit.address)


def test_a_unit_that_calls_itself_otherwise_is_refused(tmp_path):
    unit = load(tmp_path, GOOD).unit[0]
    check_name(HelloReply(unit="b1", software="", simulated=True), unit, unit.address)
    with pytest.raises(ConfigError, match=r"calls itself 'b2'; the fleet file calls it 'b1'"):
        check_name(HelloReply(unit="b2", software="", simulated=True), unit, unit.address)


def test_a_fleet_file_that_is_not_there_is_told_with_the_remedy(tmp_path):
    with pytest.raises(ConfigError, match=r"no fleet file .*nowhere\.toml.*--fleet"):
        load_fleet(tmp_path / "nowhere.toml")
