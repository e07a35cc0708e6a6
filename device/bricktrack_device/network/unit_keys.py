"""The keys that a unit keeps: its own, and those of the hosts that may speak to it.

::

    <server.keys>/unit.key_secret    the unit's own pair; mode 0600
    <server.keys>/clients/NAME.key   public keys of hosts; one host may have several while it changes its key

Whatever is missing or cannot be read shuts hosts out; nothing that goes wrong here lets one in.
"""

import logging
from pathlib import Path

from bricktrack_common.errors import ConfigError
from bricktrack_common.key_files import (
    PUBLIC_SUFFIX,
    SECRET_SUFFIX,
    KeyPair,
    fingerprint,
    read_public_key,
    read_secret_key,
)

logger = logging.getLogger(__name__)

UNIT_KEY_NAME = f"unit{SECRET_SUFFIX}"
CLIENTS_NAME = "clients"
MAX_CLIENTS = 1000

_Stamp = tuple[tuple[str, int, int], ...]


class UnitKeys:
    """The keys in a folder. The unit's own is read once; those of hosts follow the folder.

    Parameters
    ----------
    folder : Path

    Raises
    ------
    ConfigError
        If the unit's key or the folder of hosts' keys is missing, unreadable or not private.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.clients_folder = folder / CLIENTS_NAME
        try:
            self.own: KeyPair = read_secret_key(folder / UNIT_KEY_NAME)
        except ConfigError as e:
            if isinstance(e.__cause__, FileNotFoundError):
                raise ConfigError(f"{e}. 'bricktrackd keys create' makes it") from e
            raise
        self._stamp: _Stamp | None = None
        self._clients: dict[str, str] = {}
        self._problems_told: set[str] = set()
        self._read_clients()
        if not self._clients:
            logger.warning("%s: no host's key is there: nobody can reach this unit", self.clients_folder)

    def client_name(self, public: str) -> str | None:
        """Return the name of the host that a public key belongs to; `None` for a stranger, or if in doubt."""
        try:
            self._read_clients()
        except ConfigError as e:
            self._tell_once(f"{e}. Nobody is let in")
            return None
        return self._clients.get(public)

    def clients(self) -> dict[str, str]:
        """Return the hosts that may speak to this unit: name by public key.

        Raises
        ------
        ConfigError
            If the folder is missing or cannot be read.
        """
        self._read_clients()
        return dict(self._clients)

    def _read_clients(self) -> None:
        """Read the folder again if something in it has changed."""
        try:
            files = sorted(p for p in self.clients_folder.iterdir() if p.suffix == PUBLIC_SUFFIX)
            stamp = tuple((p.name, (s := p.stat()).st_mtime_ns, s.st_size) for p in files[:MAX_CLIENTS])
        except OSError as e:
            self._stamp, self._clients = None, {}
            raise ConfigError(
                f"{self.clients_folder}: the folder of hosts' keys cannot be read: {e.strerror or e}. "
                "'bricktrackd keys create' makes it"
            ) from e
        if stamp == self._stamp:
            return
        clients: dict[str, str] = {}
        for path in files[:MAX_CLIENTS]:
            try:
                clients[read_public_key(path)] = path.stem
            except ConfigError as e:
                self._tell_once(f"{e}. Left aside")
        for public in clients.keys() - self._clients.keys():
            logger.info("host %s (%s) may speak to this unit", clients[public], fingerprint(public))
        for public in self._clients.keys() - clients.keys():
            logger.info("host %s (%s) may not any more", self._clients[public], fingerprint(public))
        self._stamp, self._clients = stamp, clients

    def _tell_once(self, words: str) -> None:
        if words not in self._problems_told and len(self._problems_told) < MAX_CLIENTS:
            self._problems_told.add(words)
            logger.warning("%s", words)
