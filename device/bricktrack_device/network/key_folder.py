"""Makes and changes the folder of keys that a unit reads; as root, for the daemon's user."""

import os
import pwd
import re
from pathlib import Path

from bricktrack_common.errors import ConfigError, StorageError
from bricktrack_common.key_files import (
    PUBLIC_SUFFIX,
    check_public_key,
    make_key_pair,
    read_public_key,
    read_secret_key,
    write_public_key,
    write_secret_key,
)
from bricktrack_device.network.unit_keys import CLIENTS_NAME, UNIT_KEY_NAME

DAEMON_USER = "bricktrack"
_HOST_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


def create_unit_key(folder: Path, *, replace: bool = False) -> bool:
    """Make the unit's key if it has none, or a new one with ``replace``; tell whether one was made.

    The replaced key is kept beside it, as ``unit.key_secret.old``.

    Raises
    ------
    StorageError
        If the folder or a file cannot be written.
    """
    _make_folders(folder)
    path = folder / UNIT_KEY_NAME
    if path.exists() and not replace:
        return False
    try:
        new = folder / f"{UNIT_KEY_NAME}.new"
        new.unlink(missing_ok=True)
        write_secret_key(new, make_key_pair(), what="this unit")
        _give_to_daemon(new, as_owner=True)
        if path.exists():
            path.replace(folder / f"{UNIT_KEY_NAME}.old")
        new.rename(path)
    except PermissionError as e:
        raise StorageError(f"{path}: cannot be written: {e.strerror}. Run it with sudo") from e
    return True


def unit_public_key(folder: Path) -> str:
    """Return the unit's public key; root may look at what belongs to the daemon's user."""
    path = folder / UNIT_KEY_NAME
    return read_public_key(path) if os.geteuid() == 0 else read_secret_key(path).public


def client_files(folder: Path) -> list[Path]:
    """Return the files of the hosts' keys.

    Raises
    ------
    ConfigError
        If their folder is missing or cannot be read.
    """
    clients = folder / CLIENTS_NAME
    try:
        return sorted(p for p in clients.iterdir() if p.suffix == PUBLIC_SUFFIX)
    except OSError as e:
        raise ConfigError(
            f"{clients}: cannot be read: {e.strerror or e}. 'bricktrackd keys create' makes it"
        ) from e


def allow_client(folder: Path, name: str, public: str) -> str:
    """Let a host speak to this unit; return the name that it goes by, an older one if its key is known.

    Raises
    ------
    ConfigError
        If the name or the key is none.
    StorageError
        If another key goes by this name, or the file cannot be written.
    """
    if not _HOST_NAME.fullmatch(name):
        raise ConfigError(f"{name!r:.80}: no name for a host; expected letters, digits, _ and -, at most 64")
    check_public_key(public, where="public key")
    _make_folders(folder)
    for path in client_files(folder):
        if read_public_key(path) == public:
            return path.stem
    path = folder / CLIENTS_NAME / f"{name}{PUBLIC_SUFFIX}"
    write_public_key(path, public, what=f"host {name}")
    _give_to_daemon(path)
    return name


def forbid_client(folder: Path, host: str) -> list[str]:
    """Let a host, by its name or one of its keys, speak to this unit no more; return the names that went.

    Raises
    ------
    ConfigError
        If there is no such host.
    """
    files = client_files(folder)
    found = [p for p in files if host in (p.stem, read_public_key(p))]
    if not found:
        names = ", ".join(p.stem for p in files) or "none"
        raise ConfigError(f"no host {host!r:.80} may speak to this unit; there are: {names}")
    for path in found:
        path.unlink()
    return [p.stem for p in found]


def _make_folders(folder: Path) -> None:
    try:
        for path in (folder, folder / CLIENTS_NAME):
            if not path.is_dir():
                path.mkdir(mode=0o750, parents=True)
                _give_to_daemon(path)
    except OSError as e:
        raise StorageError(
            f"{folder}: cannot be made: {e.strerror or e}. Run it with sudo, or give another --folder"
        ) from e


def _give_to_daemon(path: Path, *, as_owner: bool = False) -> None:
    """Let the daemon's user read a file or folder, or own it; only root may say so, and needs to."""
    if os.geteuid() != 0:
        return
    try:
        user = pwd.getpwnam(DAEMON_USER)
    except KeyError:
        return
    os.chown(path, user.pw_uid if as_owner else 0, user.pw_gid)
