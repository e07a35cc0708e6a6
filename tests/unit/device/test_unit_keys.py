import os
import time
from pathlib import Path

import pytest

from bricktrack_common.errors import ConfigError
from bricktrack_common.key_files import make_key_pair, write_public_key, write_secret_key
from bricktrack_device.network.unit_keys import UnitKeys


def make_folder(folder: Path, **clients: str) -> Path:
    write_secret_key(folder / "unit.key_secret", make_key_pair(), what="unit")
    (folder / "clients").mkdir()
    for name, public in clients.items():
        write_public_key(folder / "clients" / f"{name}.key", public, what=name)
    return folder


def test_hosts_are_known_by_their_keys_and_one_host_may_have_two(tmp_path: Path) -> None:
    old, new, stranger = (make_key_pair().public for _ in range(3))
    keys = UnitKeys(make_folder(tmp_path, lab=old, lab_new=new))
    assert keys.client_name(old) == "lab" and keys.client_name(new) == "lab_new"
    assert keys.client_name(stranger) is None and keys.client_name("") is None


def test_keys_that_come_and_go_count_at_once(tmp_path: Path) -> None:
    first, second = make_key_pair().public, make_key_pair().public
    keys = UnitKeys(make_folder(tmp_path, a=first))
    write_public_key(tmp_path / "clients" / "b.key", second, what="b")
    assert keys.client_name(second) == "b"
    (tmp_path / "clients" / "a.key").unlink()
    assert keys.client_name(first) is None and keys.client_name(second) == "b"


def test_a_missing_or_unreadable_folder_lets_nobody_in(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    public = make_key_pair().public
    keys = UnitKeys(make_folder(tmp_path, a=public))
    (tmp_path / "clients").rename(tmp_path / "elsewhere")
    assert keys.client_name(public) is None and keys.client_name(public) is None
    assert caplog.text.count("Nobody is let in") == 1
    with pytest.raises(ConfigError, match=r"clients.*cannot be read"):
        UnitKeys(tmp_path)
    (tmp_path / "clients").write_text("a file")
    assert keys.client_name(public) is None
    (tmp_path / "clients").unlink()
    (tmp_path / "elsewhere").rename(tmp_path / "clients")
    assert keys.client_name(public) == "a"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_folder_without_permission_lets_nobody_in(tmp_path: Path) -> None:
    make_folder(tmp_path)
    (tmp_path / "clients").chmod(0)
    with pytest.raises(ConfigError, match="cannot be read"):
        UnitKeys(tmp_path)


def test_a_broken_file_shuts_out_its_host_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    good = make_key_pair().public
    folder = make_folder(tmp_path, good=good)
    (folder / "clients" / "bad.key").write_text("nonsense")
    (folder / "clients" / "note.txt").write_text(f'public-key = "{make_key_pair().public}"')
    write_secret_key(folder / "clients" / "leaked.key", make_key_pair(), what="x")
    keys = UnitKeys(folder)
    assert list(keys.clients().values()) == ["good"]
    assert "bad.key" in caplog.text and "leaked.key" in caplog.text and "no business" in caplog.text


def test_a_changed_key_of_the_same_name_replaces_the_old_one(tmp_path: Path) -> None:
    old, new = make_key_pair().public, make_key_pair().public
    keys = UnitKeys(make_folder(tmp_path, a=old))
    path = tmp_path / "clients" / "a.key"
    path.unlink()
    write_public_key(path, new, what="a")
    os.utime(path, ns=(time.time_ns() + 10**9,) * 2)  # file systems with coarse stamps
    assert keys.client_name(new) == "a" and keys.client_name(old) is None


def test_the_units_own_key_must_be_there_and_private(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"unit\.key_secret.*bricktrackd keys create"):
        UnitKeys(tmp_path)
    make_folder(tmp_path)
    (tmp_path / "unit.key_secret").chmod(0o644)
    with pytest.raises(ConfigError, match="expected 0600"):
        UnitKeys(tmp_path)
