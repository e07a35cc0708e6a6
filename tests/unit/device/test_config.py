import re
from pathlib import Path

import msgspec
import pytest

from bricktrack_common.errors import ConfigError
from bricktrack_device.backends import open_rig
from bricktrack_device.config import DeviceConfig, load_config
from bricktrack_device.sim.settings import SimFaults, SimSettings

EXAMPLE = Path(__file__).parents[3] / "systemd" / "bricktrackd.toml"


def write(folder: Path, text: str) -> Path:
    path = folder / "bricktrackd.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_defaults_are_a_valid_configuration_on_loopback() -> None:
    config = load_config(None)
    assert config.server.address == "127.0.0.1" and config.recording.duration_s == 15.0
    assert config.imu[0].mode == "amg" and config.imu[0].period_ms == 10
    # 16 s at 12 Mbit/s.
    assert config.video_bytes() == 24_000_000


def test_the_example_loads_and_says_the_defaults(tmp_path: Path) -> None:
    config = load_config(EXAMPLE)
    defaults = DeviceConfig(backend="sim")
    for table in ("server", "camera", "trigger", "recording", "sampler", "storage", "imu", "sim"):
        assert getattr(config, table) == getattr(defaults, table), table


def test_the_examples_commented_simulation_is_one_that_loads(tmp_path: Path) -> None:
    lines = EXAMPLE.read_text().split("# [sim]")[1].splitlines()
    keys = [line.removeprefix("# ") for line in lines if re.match(r"# (\[sim|[a-z_]+ = [^ ]+)", line)]
    sim = load_config(write(tmp_path, "\n".join(["[sim]", *keys]))).sim
    assert (sim.dropouts, sim.faults.late_edges) == ([(4.0, 0.5)], [(12, 400.0)])
    assert sim.hidden_leds[0].name == "m2"
    plain = msgspec.structs.replace(sim, dropouts=[], hidden_leds=[], faults=SimFaults())
    assert plain == SimSettings()  # what is no fault and hides nothing is the default


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[unit]\nnam = 'a'", ["unit", "nam"]),
        ("[camera]\nexposure_us = 'short'", ["camera.exposure_us"]),
        ("[camera]\nexposure_us = 20000\nframe_rate_hz = 60.0", ["camera.exposure_us", "frame period"]),
        ("[recording]\nduration_s = -1.0", ["recording.duration_s"]),
        ("[[imu]]\nname = 'a'\nmode = 'compass'", ["imu[0].mode"]),
        ("[[imu]]\nname = 'a'\naddress = 0x30", ["imu[0].address"]),
        ("[[imu]]\nname = 'a'\n[[imu]]\nname = 'a'\nbus = 'other'", ["a name stands twice"]),
        ("[[imu]]\nname = 'a'\n[[imu]]\nname = 'b'", ["same bus and address"]),
        ("[server]\naddress = '0.0.0.0'", ["server.address", "network", "SSH"]),
        ("[server]\naddress = '192.168.1.10'", ["server.address", "network"]),
        ("[server]\naddress = 'brick.local'", ["no IP address"]),
        ("[server]\nport = 70000", ["server.port"]),
        ("[unit]\nname = '../etc'", ["unit.name"]),
        ("[trigger]\npin = 'rm -rf'", ["trigger.pin"]),
        ("[leds]\npins = ['GPIO22', '22']", ["leds.pins", "stands twice"]),
        ("[trigger]\npin = 'GPIO7'\n[leds]\npins = ['BCM07']", ["leds.pins", "the trigger's pin too"]),
        ("[sim]\nno_such_key = 1", ["sim", "no_such_key"]),
        ("nonsense = [", ["not valid TOML"]),
    ],
)
def test_a_wrong_file_is_refused_with_file_and_key(tmp_path: Path, text: str, words: list[str]) -> None:
    path = write(tmp_path, text)
    with pytest.raises(ConfigError) as e:
        load_config(path)
    for word in [str(path), *words]:
        assert word in str(e.value)


def test_the_command_line_overrides_the_file_and_is_checked_too(tmp_path: Path) -> None:
    path = write(tmp_path, "[unit]\nname = 'a'\n[server]\nport = 5")
    config = load_config(path, {"unit.name": "b", "server.port": 0, "backend": None})
    assert (config.unit.name, config.server.port, config.backend) == ("b", 0, "hardware")
    with pytest.raises(ConfigError, match=r"command line: server\.port.*99999"):
        load_config(path, {"server.port": 99999})


def test_an_unknown_backend_names_those_that_exist(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"'abacus'.*sim"):
        open_rig(load_config(None, {"backend": "abacus"}))


@pytest.mark.parametrize("camera", ['mode = "full-field"', "qp = 22"])
def test_the_simulation_refuses_what_it_cannot_film(tmp_path, camera):
    path = tmp_path / "unit.toml"
    path.write_text(f'backend = "sim"\n[camera]\n{camera}\n')
    with pytest.raises(ConfigError, match="leave both out for backend 'sim'"):
        open_rig(load_config(path))
