"""Finds units in the local network by what they announce (DNS-SD over mDNS).

An announcement is a hint where to look: who answers there is settled by the unit's key and name.
"""

import atexit
import logging
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bricktrack_common.discovery import SERVICE_TYPE, Announcement, parse_announcement
from bricktrack_common.errors import ConfigError
from bricktrack_common.key_files import fingerprint
from bricktrack_host.transfer.fleet_config import UnitConfig

if TYPE_CHECKING:
    import zeroconf

logger = logging.getLogger(__name__)

SEARCH_S = 2.0
"""How long after the first question an answer may take; units answer within one second."""
_RESOLVE_MS = 1000
_TRY_S = 0.7
_POLL_S = 0.05


@dataclass(frozen=True, slots=True)
class FoundUnit:
    """One announcement, and where it says that the unit is.

    Attributes
    ----------
    addresses : tuple of str
        ``tcp://host:port``, IPv4 first.
    """

    announcement: Announcement
    addresses: tuple[str, ...]


class NetworkFinder:
    """Looks for units; asks the network when it is first needed, and listens from then on.

    Parameters
    ----------
    open_network : callable, optional
        Returns a `zeroconf.Zeroconf`; default: on all interfaces of this machine.
    search_s : float, s
        How long to wait for answers.
    """

    def __init__(
        self,
        open_network: "Callable[[], zeroconf.Zeroconf] | None" = None,
        *,
        search_s: float = SEARCH_S,
    ) -> None:
        self._open_network = open_network
        self._search_s = search_s
        self._lock = threading.Lock()
        self._network: zeroconf.Zeroconf | None = None
        self._found: dict[str, FoundUnit] = {}
        self._started_s = 0.0

    def find(self, unit: UnitConfig) -> str | None:
        """Return where a unit says that it is, or `None`; see `bricktrack_host.transfer.contact.Finder`.

        One that announces another key than the fleet file has for it is passed over.
        """
        try:
            self._start()
        except ConfigError as e:
            logger.debug("%s", e)
            return None
        while True:
            for found in self._now():
                if found.announcement.unit == unit.name and _may_be(found.announcement, unit):
                    return _first_that_answers(found.addresses)
            if time.monotonic() >= self._started_s + self._search_s:
                return None
            time.sleep(_POLL_S)

    def find_all(self) -> list[FoundUnit]:
        """Return all units that announce themselves until the search is over, by name.

        Raises
        ------
        ConfigError
            If zeroconf is not installed, or there is no network to ask.
        """
        self._start()
        time.sleep(max(0.0, self._started_s + self._search_s - time.monotonic()))
        return sorted(self._now(), key=lambda f: f.announcement.unit)

    def close(self) -> None:
        """Stop listening. Calling it twice does no harm."""
        with self._lock:
            network, self._network = self._network, None
        if network is not None:
            network.close()

    def _now(self) -> list[FoundUnit]:
        with self._lock:
            return list(self._found.values())

    def _start(self) -> None:
        with self._lock:
            if self._network is not None:
                return
            try:
                import zeroconf
            except ImportError as e:
                raise ConfigError(
                    "units cannot be looked for: zeroconf is not installed. Run 'pip install zeroconf', or "
                    "give each unit an address in fleet.toml"
                ) from e
            try:
                self._network = (
                    self._open_network() if self._open_network is not None else zeroconf.Zeroconf()
                )
            except (OSError, zeroconf.Error) as e:
                raise ConfigError(
                    f"units cannot be looked for: {e}. Is this machine in a network? An address for each "
                    "unit in fleet.toml needs no looking"
                ) from e
            self._started_s = time.monotonic()
            zeroconf.ServiceBrowser(self._network, SERVICE_TYPE, handlers=[self._on_change])
        atexit.register(self.close)

    def _on_change(
        self,
        zeroconf: "zeroconf.Zeroconf",
        service_type: str,
        name: str,
        state_change: "zeroconf.ServiceStateChange",
    ) -> None:
        """Hear of a service; called by zeroconf, with these names, in a thread of its own."""
        if state_change.name == "Removed":
            with self._lock:
                self._found.pop(name, None)
            return
        info = zeroconf.get_service_info(service_type, name, timeout=_RESOLVE_MS)
        announcement = None if info is None else parse_announcement(info.properties)
        if info is None or announcement is None or not info.port:
            logger.debug("%s: not of a unit, or gone", name)
            return
        hosts = sorted(info.parsed_scoped_addresses(), key=lambda a: ":" in a)
        addresses = tuple(f"tcp://[{h}]:{info.port}" if ":" in h else f"tcp://{h}:{info.port}" for h in hosts)
        if addresses:
            with self._lock:
                self._found[name] = FoundUnit(announcement, addresses)


def _may_be(announcement: Announcement, unit: UnitConfig) -> bool:
    return not unit.server_key or announcement.key_fingerprint == fingerprint(unit.server_key)


def _first_that_answers(addresses: tuple[str, ...]) -> str:
    """Return the first address that takes a connection: a unit may have networks that this host is not in."""
    for address in addresses if len(addresses) > 1 else ():
        host, _, port = address.removeprefix("tcp://").rpartition(":")
        try:
            with socket.create_connection((host.strip("[]"), int(port)), timeout=_TRY_S):
                return address
        except OSError:
            continue
    return addresses[0]
