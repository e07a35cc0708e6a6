"""What the fleet file says of a camera's own motion: taken if it goes together, else refused by its key."""

import msgspec
import pytest
from run_folders import make_run

from bricktrack_common.clocks import ClockTriplet
from bricktrack_common.errors import ConfigError
from bricktrack_common.run_manifest import MANIFEST_NAME, ClocksSection, read_manifest, write_manifest
from bricktrack_host.stages.camera_sensor import CameraSensor, choose_camera_sensor
from bricktrack_host.stages.settings import ProcessSettings
from bricktrack_host.transfer.fleet_config import load_fleet

AXES = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0))
FLEET = """
[[unit]]
name = "b7-2"
camera = "imu"

[unit.camera_imu]
unit = "b7-1"
imu = "brick"
to_camera_mm = [40.0, -12.0, 3.5]
rotation = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]

[[unit]]
name = "b7-1"

[[unit]]
name = "b7-3"
camera = "table"

[unit.camera_table]
columns = ["AX", "AY", "AZ"]
measured_in = "g"
"""


def load(tmp_path, text):
    path = tmp_path / "fleet.toml"
    path.write_text(text)
    return load_fleet(path)


def test_sensors_of_moving_cameras_are_read(tmp_path):
    first, second, third = load(tmp_path, FLEET).unit
    assert (first.camera_imu.unit, first.camera_imu.imu) == ("b7-1", "brick")
    assert first.camera_imu.to_camera_mm == (40.0, -12.0, 3.5) and first.camera_imu.rotation == AXES
    assert second.camera_imu is None and second.camera_table is None
    assert third.camera_table.columns == ("AX", "AY", "AZ") and third.camera_table.measured_in == "g"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('camera = "imu"', 'camera = "static"'), r'unit\[0\]\.camera_imu: belongs to camera = "imu"'),
        (('camera = "table"', 'camera = "imu"'), r'unit\[2\]\.camera_table: belongs to camera = "table"'),
        (('unit = "b7-1"', 'unit = "b7-9"'), r"unit\[0\]\.camera_imu\.unit: 'b7-9' is no other unit"),
        (('unit = "b7-1"', 'unit = "b7-2"'), r"unit\[0\]\.camera_imu\.unit: 'b7-2' is no other unit"),
        (("[0, 0, 1]", "[0, 0, -1]"), r"unit\[0\]\.camera_imu\.rotation: .* is not a rotation matrix"),
        (("40.0", "nan"), r"unit\[0\]\.camera_imu\.to_camera_mm: .* three finite numbers"),
        (('"g"', '"gal"'), r"unit\[2\]\.camera_table\.measured_in"),
    ],
)
def test_what_does_not_go_together_is_named(tmp_path, change, words):
    with pytest.raises(ConfigError, match=words):
        load(tmp_path, FLEET.replace(*change))


def test_settings_are_stored_one_by_one():
    sensor = CameraSensor(kind="imu", imu="camera", to_camera_mm=(1.0, 2.0, 3.0), rotation=AXES)
    facts = ProcessSettings(camera="imu", camera_sensor=sensor).facts()
    assert facts["camera"] == "imu" and facts["camera_sensor_imu"] == "camera"
    assert list(facts["camera_sensor_to_camera_mm"]) == [1.0, 2.0, 3.0]
    assert facts["camera_sensor_rotation"] == [0.0, 0.0, 1.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0]
    assert not any(isinstance(value, dict) for value in facts.values())
    assert not any(name.startswith("camera_sensor") for name in ProcessSettings().facts())


def run_of(runs, run_id, unit, *, date_s=None, label="shake-12"):
    folder = make_run(runs, run_id, {}, unit=unit)
    clocks = ClocksSection()
    if date_s is not None:
        date_ns = 1_790_000_000_000_000_000 + int(date_s * 1e9)
        clocks = ClocksSection(trigger=ClockTriplet(monotonic_ns=1, boottime_ns=1, realtime_ns=date_ns))
    manifest = msgspec.structs.replace(read_manifest(folder / MANIFEST_NAME), label=label, clocks=clocks)
    write_manifest(folder / MANIFEST_NAME, manifest)
    return folder


def test_the_other_units_run_of_the_same_shake_is_found_beside_this_one(tmp_path):
    unit = load(tmp_path, FLEET).unit[0]
    runs = tmp_path / "runs"
    own = run_of(runs, "b7-2_aa_0002_shake-12", "b7-2", date_s=100.0)
    run_of(runs, "b7-1_bb_0001_other", "b7-1", date_s=100.0, label="other")
    with pytest.raises(ConfigError, match=r"there is none of that unit.*--camera-run"):
        choose_camera_sensor(own, unit)
    first = run_of(runs, "b7-1_bb_0002_shake-12", "b7-1")
    assert choose_camera_sensor(own, unit).source == f"../{first.name}"
    run_of(runs, "b7-1_bb_0003_shake-12", "b7-1")
    with pytest.raises(ConfigError, match="are 2 runs of that unit labelled 'shake-12'"):
        choose_camera_sensor(own, unit)
    assert choose_camera_sensor(own, unit, camera_run=first).source == f"../{first.name}"
    last = run_of(runs, "b7-1_bb_0004_shake-12", "b7-1", date_s=100.4)
    assert choose_camera_sensor(own, unit).source == f"../{last.name}"
