"""The host's own key, its units' public keys in the fleet file, and putting one on the other side by SSH."""

import json
import re
import shlex
import subprocess
import tomllib
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from bricktrack_common.errors import BricktrackError, ConfigError, StorageError, UnitError
from bricktrack_common.key_files import (
    KeyPair,
    check_public_key,
    make_key_pair,
    read_secret_key,
    write_secret_key,
)
from bricktrack_host.durable_files import rename_durably, write_durably
from bricktrack_host.transfer.fleet_config import UnitConfig

DEFAULT_KEY = Path("~/.config/bricktrack/host.key_secret")
REMOTE_COMMAND = "sudo /opt/bricktrack/bin/bricktrackd"
SSH_TIMEOUT_S = 60.0
_TABLE = re.compile(r"^\s*\[")
_UNIT_TABLE = re.compile(r"^\s*\[\[\s*unit\s*\]\]")
_KEY_LINE = re.compile(r"^\s*server_key\s*=")


def create_host_key(path: Path, *, name: str) -> KeyPair:
    """Make this host's key pair and return it.

    Raises
    ------
    StorageError
        If the file exists already or cannot be written.
    """
    pair = make_key_pair()
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as e:
        raise StorageError(f"{path.parent}: cannot be made: {e.strerror or e}") from e
    write_secret_key(path, pair, what=f"host {name}")
    return pair


def next_key_path(path: Path) -> Path:
    """Return where the key waits that will follow, while units learn it."""
    return path.with_name(f"{path.name}.next")


def next_host_key(path: Path, *, name: str) -> KeyPair:
    """Return the key that will follow this host's own: the one that waits already, or a new one."""
    waiting = next_key_path(path)
    return read_secret_key(waiting) if waiting.exists() else create_host_key(waiting, name=name)


def take_next_key(path: Path) -> Path:
    """Put the key that waits into the place of this host's own; return where the old one is kept."""
    old = path.with_name(f"{path.name}.old")
    try:
        path.replace(old)
        rename_durably(next_key_path(path), path)
    except OSError as e:
        raise StorageError(f"{path}: the new key cannot be put in place: {e.strerror or e}") from e
    return old


@dataclass(frozen=True, slots=True)
class RemoteUnit:
    """A unit's ``bricktrackd keys``, spoken to by SSH.

    Attributes
    ----------
    target : str
        What `ssh` connects to: ``pi@10.0.0.21``.
    command : str
        How bricktrackd is called there.
    folder : str
        The unit's folder of keys, if it is not the usual one.
    """

    target: str
    command: str = REMOTE_COMMAND
    folder: str = ""

    def install(self, name: str, public: str) -> str:
        """Let a host speak to the unit, make the unit's own key if it has none, and return the public one.

        Raises
        ------
        UnitError
            If SSH or the command fails there; the message carries its words.
        """
        made = self._call("create", "--json")
        self._call("allow", name, public)
        try:
            key = json.loads(made)["public"]
        except (ValueError, KeyError, TypeError) as e:
            raise UnitError(
                f"{self.target}: 'keys create' answered {made[:200]!r}; expected its public key. Is "
                "bricktrack there as new as here?",
                code="ssh",
            ) from e
        return check_public_key(str(key), where=f"{self.target}: keys create")

    def forbid(self, public: str) -> None:
        """Let a host's key no more; see `install` for what is raised."""
        self._call("forbid", public)

    def _call(self, *arguments: str) -> str:
        words = [*arguments, *(["--folder", self.folder] if self.folder else [])]
        # The other side's shell takes the words apart again.
        remote = f"{self.command} keys {shlex.join(words)}"
        try:
            done = subprocess.run(
                ["ssh", "-o", "ConnectTimeout=10", "--", self.target, remote],
                capture_output=True,
                text=True,
                timeout=SSH_TIMEOUT_S,
                check=False,
            )
        except FileNotFoundError as e:
            raise UnitError(
                "ssh is not installed here; docs/how-to/keys.md says how to do it by hand", code="ssh"
            ) from e
        except subprocess.TimeoutExpired as e:
            raise UnitError(f"{self.target}: no answer by SSH within {SSH_TIMEOUT_S:g} s", code="ssh") from e
        if done.returncode != 0:
            said = " ".join(done.stderr.split())[-500:] or f"exit status {done.returncode}"
            raise UnitError(f"{self.target}: '{remote}' failed: {said}", code="ssh")
        return done.stdout


def ssh_target(ssh: str, unit: UnitConfig) -> str:
    """Return ``user@host`` for a unit: as given, or a user at the unit's own address.

    Raises
    ------
    ConfigError
        If only a user is given and the unit has no address.
    """
    if "@" in ssh:
        return ssh
    host = urlsplit(unit.address).hostname if unit.address else None
    if not host:
        raise ConfigError(f"unit {unit.name} has no address in the fleet file; give --ssh {ssh}@ADDRESS")
    return f"{ssh}@{host}"


def set_server_key(fleet_file: Path, unit: str, key: str) -> None:
    """Write a unit's key into the fleet file, and leave everything else in it as it is.

    Raises
    ------
    ConfigError
        If the unit cannot be found in the file's text: the message has the line to put there by hand.
    """
    line = f'server_key = "{key}"'
    by_hand = ConfigError(f"{fleet_file}: put this line under the [[unit]] of {unit} by hand: {line}")
    try:
        text = fleet_file.read_text(encoding="utf-8")
        before = tomllib.loads(text)
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as e:
        raise ConfigError(f"{fleet_file}: {e}. {by_hand}") from e
    lines = text.splitlines()
    units = before.get("unit", [])
    index = next((i for i, u in enumerate(units) if u.get("name") == unit), None)
    starts = [i for i, words in enumerate(lines) if _UNIT_TABLE.match(words)]
    if index is None or len(starts) != len(units):
        raise by_hand
    start = starts[index]
    end = next((i for i in range(start + 1, len(lines)) if _TABLE.match(lines[i])), len(lines))
    old = [i for i in range(start + 1, end) if _KEY_LINE.match(lines[i])]
    if old:
        lines[old[0]] = line
    else:
        last = max(i for i in range(start, end) if lines[i].strip() and not lines[i].lstrip().startswith("#"))
        lines.insert(last + 1, line)
    new = "\n".join(lines) + "\n"
    units[index]["server_key"] = key
    try:
        if tomllib.loads(new) != before:
            raise by_hand
    except tomllib.TOMLDecodeError as e:
        raise by_hand from e
    _replace(fleet_file, new.encode("utf-8"))


def _replace(path: Path, data: bytes) -> None:
    temporary = path.with_name(f".{path.name}.new")
    try:
        temporary.unlink(missing_ok=True)
        write_durably(temporary, data)
        temporary.chmod(path.stat().st_mode & 0o777)
        rename_durably(temporary, path)
    except BricktrackError:
        raise
    except OSError as e:
        raise StorageError(f"{path}: cannot be written: {e.strerror or e}") from e
