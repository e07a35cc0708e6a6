from pathlib import Path

import pytest

from bricktrack_common.errors import ConfigError
from bricktrack_common.key_files import fingerprint, make_key_pair
from bricktrack_device.config import DeviceConfig, ServerTable
from bricktrack_device.health.keys import check_keys
from bricktrack_device.network.key_folder import allow_client, create_unit_key, unit_public_key


def with_keys(folder: Path) -> DeviceConfig:
    return DeviceConfig(server=ServerTable(keys=str(folder)))


def test_a_unit_without_keys_says_what_that_means() -> None:
    (found,) = check_keys(DeviceConfig())
    assert found.level == "ok" and "nothing is encrypted" in found.detail


def test_a_unit_that_no_host_may_speak_to_is_warned_about(tmp_path: Path) -> None:
    create_unit_key(tmp_path)
    (found,) = check_keys(with_keys(tmp_path))
    assert found.level == "warn" and "bricktrack keys install" in found.remedy
    allow_client(tmp_path, "lab", make_key_pair().public)
    (found,) = check_keys(with_keys(tmp_path))
    assert found.level == "ok" and "lab" in found.detail
    assert fingerprint(unit_public_key(tmp_path)) in found.detail


def test_keys_that_are_no_good_are_an_error_with_its_remedy(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="bricktrackd keys create"):
        check_keys(with_keys(tmp_path))
    create_unit_key(tmp_path)
    (tmp_path / "unit.key_secret").chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600") as e:
        check_keys(with_keys(tmp_path))
    assert "keys create" not in str(e.value)
    (tmp_path / "unit.key_secret").chmod(0o600)
    (tmp_path / "clients").rmdir()
    with pytest.raises(ConfigError, match="clients.*bricktrackd keys create"):
        check_keys(with_keys(tmp_path))
