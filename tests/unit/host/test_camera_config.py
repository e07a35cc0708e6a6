"""What the fleet file says of a camera's own motion: taken if it goes together, else refused by its key."""

import pytest

from bricktrack_common.errors import ConfigError
from bricktrack_host.stages.camera_sensor import CameraSensor
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
