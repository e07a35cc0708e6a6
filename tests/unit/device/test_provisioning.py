"""The playbook that makes units of many cards: its syntax, and the settings and keys that it gives each."""

import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import jinja2
import pytest
import yaml

from bricktrack_common.key_files import read_secret_key
from bricktrack_device.config import DeviceConfig, load_config

FOLDER = Path(__file__).resolve().parents[3] / "systemd/provisioning"
SYSTEMD = FOLDER.parent


def inventory() -> dict[str, Any]:
    return yaml.safe_load((FOLDER / "inventory.example.yml").read_text())["units"]["hosts"]


def tasks() -> dict[str, dict[str, Any]]:
    (play,) = yaml.safe_load((FOLDER / "provision.yml").read_text())
    return {task["name"]: task for task in play["tasks"]}


def settings_of(host: str, folder: Path) -> DeviceConfig:
    """Return what the daemon makes of the file that this host of the example gets."""
    common = yaml.safe_load((FOLDER / "group_vars/units.yml").read_text())
    template = jinja2.Environment(undefined=jinja2.StrictUndefined).from_string(
        (FOLDER / "bricktrackd.toml.j2").read_text()
    )
    path = folder / f"{host}.toml"
    path.write_text(template.render(inventory_hostname=host, **(common | inventory()[host])))
    return load_config(path, {})


@pytest.mark.skipif(shutil.which("ansible-playbook") is None, reason="needs ansible-core")
def test_the_playbook_is_well_formed_and_reaches_every_unit_of_the_example() -> None:
    def ansible(*arguments: str) -> str:
        done = subprocess.run(
            ["ansible-playbook", "-i", "inventory.example.yml", *arguments, "provision.yml"], cwd=FOLDER,
            env=os.environ | {"LC_ALL": "C.UTF-8"}, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    ansible("--syntax-check")
    assert all(host in ansible("--list-hosts") for host in inventory())


def test_each_unit_gets_its_own_name_and_the_settings_of_all(tmp_path: Path) -> None:
    found = {host: settings_of(host, tmp_path) for host in inventory()}
    assert len(found) >= 2
    for host, config in found.items():
        assert (config.unit.name, config.backend) == (host, "hardware")
        assert config.trigger.nominal_hz == 200.0 and config.imu[0].bus == "/dev/i2c-3"
        assert config.server.address == "0.0.0.0" and config.server.keys == "/etc/bricktrack/keys"
    assert found["north-2"].leds.pins == ["GPIO22"] and found["north-1"].leds.pins == []


def test_everything_that_the_script_reads_is_copied() -> None:
    copied = {item["from"] for item in tasks()["The script and its files"]["loop"]}
    assert copied == {f"systemd/{p.name}" for p in SYSTEMD.iterdir() if p.is_file()} | {
        "docs/device-setup.md"
    }


def test_a_units_key_is_made_and_its_public_half_told_by_the_daemons_own_command(tmp_path: Path) -> None:
    def run(name: str) -> str:
        argv = tasks()[name]["ansible.builtin.command"]["argv"]
        filled = [str(a).replace("{{ keys }}", str(tmp_path / "keys")) for a in argv[1:]]
        return subprocess.run(
            [sys.executable, "-m", "bricktrack_device.cli", *filled],
            check=True,
            capture_output=True,
            text=True,
        ).stdout

    run("The unit's own key, made there and never copied")
    secret = tmp_path / "keys/unit.key_secret"
    assert secret.stat().st_mode & 0o777 == 0o600
    public = json.loads(run("The unit's public key"))["public"]
    assert read_secret_key(secret).public == public
    # Keys have braces and percent signs in them: they pass Jinja as a value, and TOML as a JSON string.
    entry = tasks()["The public key here, as it belongs into the host's fleet.toml"]["ansible.builtin.copy"]
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined)
    environment.filters |= {"from_json": json.loads, "to_json": json.dumps}
    text = environment.from_string(entry["content"]).render(
        inventory_hostname="north-1",
        ansible_host="192.168.7.11",
        shown={"stdout": json.dumps({"public": public})},
    )
    (unit,) = tomllib.loads(text)["unit"]
    assert (unit["name"], unit["address"], unit["server_key"]) == (
        "north-1",
        "tcp://192.168.7.11:41733",
        public,
    )
