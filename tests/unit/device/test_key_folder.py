import json
import stat
from pathlib import Path

import pytest
from typer.testing import CliRunner

from bricktrack_common.errors import BricktrackError, ConfigError, StorageError
from bricktrack_common.key_files import make_key_pair
from bricktrack_device.network.key_folder import (
    allow_client,
    client_files,
    create_unit_key,
    forbid_client,
    unit_public_key,
)
from bricktrack_device.network.keys_cli import app
from bricktrack_device.network.unit_keys import UnitKeys


def test_a_made_folder_is_what_the_daemon_reads(tmp_path: Path) -> None:
    folder = tmp_path / "etc" / "keys"
    assert create_unit_key(folder) and not create_unit_key(folder)
    host = make_key_pair().public
    assert allow_client(folder, "lab", host) == "lab"
    assert allow_client(folder, "other", host) == "lab"  # the key is known already
    keys = UnitKeys(folder)
    assert keys.own.public == unit_public_key(folder) and keys.client_name(host) == "lab"
    assert stat.S_IMODE((folder / "unit.key_secret").stat().st_mode) == 0o600
    assert stat.S_IMODE(folder.stat().st_mode) & 0o007 == 0


def test_a_replaced_key_is_kept_beside_the_new_one(tmp_path: Path) -> None:
    create_unit_key(tmp_path)
    old = (tmp_path / "unit.key_secret").read_bytes()
    assert create_unit_key(tmp_path, replace=True)
    assert (
        (tmp_path / "unit.key_secret.old").read_bytes() == old != (tmp_path / "unit.key_secret").read_bytes()
    )
    assert stat.S_IMODE((tmp_path / "unit.key_secret").stat().st_mode) == 0o600


def test_a_host_goes_by_name_or_by_key(tmp_path: Path) -> None:
    a, b = make_key_pair().public, make_key_pair().public
    allow_client(tmp_path, "a", a)
    allow_client(tmp_path, "b", b)
    assert forbid_client(tmp_path, a) == ["a"] and forbid_client(tmp_path, "b") == ["b"]
    assert client_files(tmp_path) == []
    with pytest.raises(ConfigError, match="there are: none"):
        forbid_client(tmp_path, "b")


@pytest.mark.parametrize("name", ["", "../x", "a b", "-x", "x" * 65, "a/b"])
def test_a_name_that_is_no_file_name_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="no name for a host"):
        allow_client(tmp_path, name, make_key_pair().public)


def test_another_key_of_the_same_name_and_no_key_are_refused(tmp_path: Path) -> None:
    allow_client(tmp_path, "lab", make_key_pair().public)
    with pytest.raises(StorageError, match="exists already"):
        allow_client(tmp_path, "lab", make_key_pair().public)
    with pytest.raises(ConfigError, match="is no key"):
        allow_client(tmp_path, "x", "short")


def test_the_commands_speak_json_and_change_the_folder(tmp_path: Path) -> None:
    run = CliRunner()
    folder = str(tmp_path / "keys")
    made = json.loads(run.invoke(app, ["create", "--json", "--folder", folder]).stdout)
    assert made["created"] and len(made["public"]) == 40
    shown = json.loads(run.invoke(app, ["show", "--json", "--folder", folder]).stdout)
    assert shown == made | {"created": False}
    host = make_key_pair().public
    assert run.invoke(app, ["allow", "lab", host, "--folder", folder]).exit_code == 0
    listed = json.loads(run.invoke(app, ["list", "--json", "--folder", folder]).stdout)
    assert listed == {"clients": [{"name": "lab", "public": host}]}
    assert run.invoke(app, ["forbid", "lab", "--folder", folder]).exit_code == 0
    failed = run.invoke(app, ["forbid", "lab", "--folder", folder])
    assert isinstance(failed.exception, BricktrackError)


@pytest.mark.parametrize("command", ["create", "show", "allow", "forbid", "list"])
def test_help_has_an_example(command: str) -> None:
    shown = CliRunner().invoke(app, [command, "--help"]).stdout
    assert f"bricktrackd keys {command}" in shown.split("Example", 1)[1]
