import errno
from pathlib import Path

import msgspec
import pytest

from bricktrack_common.errors import ConfigError, StorageError
from bricktrack_device.config import CameraTable, DeviceConfig, RecordingTable, TriggerTable
from bricktrack_device.remote_settings import REMOTE_KEYS, RemoteSettings
from bricktrack_device.storage.disk import Disk

BASE = DeviceConfig(
    camera=CameraTable(exposure_us=1500),
    recording=RecordingTable(duration_s=7.0),
    trigger=TriggerTable(nominal_hz=50.0),
)


class FullDisk(Disk):
    def write_file(self, path: Path, fill: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")


def test_what_a_host_sets_survives_a_restart_and_the_rest_stays_as_in_the_file(tmp_path: Path) -> None:
    config = RemoteSettings(BASE, tmp_path).change(
        {"camera.exposure_us": 900, "camera.colour_gains": [2, 1.25], "recording.label": "trial"}
    )
    assert (config.camera.exposure_us, config.camera.colour_gains) == (900, (2.0, 1.25))
    again = RemoteSettings(BASE, tmp_path)
    assert again.load() == config and again.problem == ""
    assert again.changed_keys() == ["camera.colour_gains", "camera.exposure_us", "recording.label"]
    assert again.config.recording.duration_s == 7.0
    values = again.values()
    assert set(values) == set(REMOTE_KEYS)
    assert values["camera.colour_gains"] == [2.0, 1.25] and values["trigger.nominal_hz"] == 50.0


def test_none_goes_back_to_the_file(tmp_path: Path) -> None:
    settings = RemoteSettings(BASE, tmp_path)
    settings.change({"camera.exposure_us": 900, "leds.count": 5})
    settings.change({"camera.exposure_us": None})
    assert settings.config.camera.exposure_us == 1500 and settings.config.leds.count == 5
    assert settings.changed_keys() == ["leds.count"]


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"unit.name": "other"}, "unit.name: cannot be configured from a host"),
        ({"storage.folder": None}, "storage.folder: cannot be configured"),
        ({"server.address": "0.0.0.0"}, "server.address: cannot"),
        ({"camera.exposure_us": "long"}, "camera.exposure_us.*str.*got 'long'"),
        ({"camera.exposure_us": True}, "camera.exposure_us.*bool"),
        ({"camera.exposure_us": 34_000}, "camera.exposure_us.*33000"),
        ({"camera.analogue_gain": float("nan")}, "camera.analogue_gain"),
        ({"camera.colour_gains": [1.0]}, "camera.colour_gains"),
        ({"recording.label": "../etc"}, "recording.label"),
        ({"recording.duration_s": 5.0, "leds.count": 0}, "leds.count"),
    ],
)
def test_a_wrong_value_is_refused_and_changes_nothing(
    tmp_path: Path, values: dict[str, object], words: str
) -> None:
    settings = RemoteSettings(BASE, tmp_path)
    settings.change({"leds.count": 6})
    before = (tmp_path / "configured.json").read_bytes()
    with pytest.raises(ConfigError, match=words):
        settings.change(values)  # type: ignore[arg-type]
    assert settings.config.leds.count == 6 and settings.config.recording.duration_s == 7.0
    assert (tmp_path / "configured.json").read_bytes() == before


def test_values_that_contradict_the_file_are_left_aside_with_words(tmp_path: Path) -> None:
    RemoteSettings(BASE, tmp_path).change({"camera.exposure_us": 20_000})
    # The file is edited since: at 60 Hz a frame lasts 16 667 us.
    faster = msgspec.structs.replace(BASE, camera=CameraTable(exposure_us=1500, frame_rate_hz=60.0))
    settings = RemoteSettings(faster, tmp_path)
    assert settings.load() == faster
    assert "exposure_us" in settings.problem and "Configure it anew" in settings.problem
    settings.change({"leds.count": 3})
    assert settings.problem == "" and settings.changed_keys() == ["leds.count"]


@pytest.mark.parametrize("text", ["{", '{"values": {"unit.name": "x"}}', '{"version": 9, "values": {}}'])
def test_a_broken_file_does_not_stop_the_unit(tmp_path: Path, text: str) -> None:
    (tmp_path / "configured.json").write_text(text)
    settings = RemoteSettings(BASE, tmp_path)
    assert settings.load() == BASE and settings.problem


def test_a_full_card_changes_nothing(tmp_path: Path) -> None:
    settings = RemoteSettings(BASE, tmp_path, disk=FullDisk())
    with pytest.raises(StorageError, match="No space left.*Make room"):
        settings.change({"leds.count": 3})
    assert settings.config == BASE
