import os
import stat
from pathlib import Path

import pytest
import zmq.auth

from bricktrack_common.errors import ConfigError, StorageError
from bricktrack_common.key_files import (
    KeyPair,
    check_public_key,
    fingerprint,
    make_key_pair,
    read_public_key,
    read_secret_key,
    write_public_key,
    write_secret_key,
)

# The pair of the ZeroMQ manual's zmq_curve(7).
PUBLIC = "Yne@$w-vo<fVvi]a<NY6T1ed:M$fCG*[IaLV{hID"
SECRET = "D:)Q[IlAW!ahhC2ac:9*A}h:p?([4%wOTJ%JR%cs"


@pytest.fixture
def secret_file(tmp_path: Path) -> Path:
    path = tmp_path / "unit.key_secret"
    write_secret_key(path, KeyPair(PUBLIC, SECRET), what="unit b1")
    return path


def test_files_read_back_by_us_and_by_pyzmq_and_are_private(secret_file: Path, tmp_path: Path) -> None:
    assert read_secret_key(secret_file) == KeyPair(PUBLIC, SECRET)
    assert read_public_key(secret_file) == PUBLIC
    assert zmq.auth.load_certificate(secret_file) == (PUBLIC.encode(), SECRET.encode())
    assert stat.S_IMODE(secret_file.stat().st_mode) == 0o600
    public = tmp_path / "host.key"
    write_public_key(public, PUBLIC, what="host lab")
    assert read_public_key(public) == PUBLIC and SECRET not in public.read_text()


def test_a_secret_key_is_private_whatever_the_umask(tmp_path: Path) -> None:
    before = os.umask(0o000)
    try:
        write_secret_key(tmp_path / "a.key_secret", make_key_pair(), what="a")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.key_secret").stat().st_mode) == 0o600


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o620, 0o644])
def test_a_key_that_others_could_read_is_refused_with_the_remedy(secret_file: Path, mode: int) -> None:
    secret_file.chmod(mode)
    with pytest.raises(ConfigError, match=rf"mode {mode:04o}.*chmod 600 {secret_file}"):
        read_secret_key(secret_file)


def test_a_key_is_never_written_over(secret_file: Path) -> None:
    with pytest.raises(StorageError, match="exists already"):
        write_secret_key(secret_file, make_key_pair(), what="b")
    assert read_secret_key(secret_file).public == PUBLIC


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "No public key"),
        ('curve\n  public-key = "short"\n  secret-key = "short"\n', "is no key"),
        (f'curve\n  public-key = "{PUBLIC}"\n', "holds no secret key"),
        (f'curve\n  public-key = "{PUBLIC}"\n  secret-key = "{PUBLIC}"\n', "do not belong together"),
        ('curve\n  public-key = "' + "#" * 40 + '"\n  secret-key = "' + "#" * 40 + '"\n', "is no key"),
        ("public-key\n", "no key file"),
        ("x" * 5000, "4096 bytes"),
    ],
)
def test_what_is_no_key_is_refused_with_the_file(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "x.key_secret"
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(ConfigError, match=words) as e:
        read_secret_key(path)
    assert str(path) in str(e.value)


def test_a_missing_file_a_folder_and_bytes_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "none.key", tmp_path):
        with pytest.raises(ConfigError):
            read_public_key(path)
    (tmp_path / "b.key").write_bytes(b'public-key = "\xff\xfe"')
    with pytest.raises(ConfigError, match="no key file"):
        read_public_key(tmp_path / "b.key")


def test_a_secret_among_the_public_keys_is_refused(secret_file: Path, tmp_path: Path) -> None:
    path = tmp_path / "host.key"
    path.write_bytes(secret_file.read_bytes())
    with pytest.raises(ConfigError, match="has no business here"):
        read_public_key(path)


def test_pairs_are_new_each_time_keep_quiet_and_have_fingerprints() -> None:
    a, b = make_key_pair(), make_key_pair()
    assert a.public != b.public and a.secret not in repr(a)
    # echo -n KEY | python -c "z85 decode" | sha256sum
    assert fingerprint(PUBLIC) == "ebb3-af4d-d99c-eff3" != fingerprint(a.public)
    assert check_public_key(a.public, where="x") == a.public
