"""Announces the unit in the local network (mDNS), where zeroconf is installed; harmless where it is not."""

import ipaddress
import logging
import socket
from typing import TYPE_CHECKING

from bricktrack_common.discovery import SERVICE_TYPE, Announcement
from bricktrack_device.priority import at_low_priority

if TYPE_CHECKING:
    import zeroconf

logger = logging.getLogger(__name__)


class Advertisement:
    """Says where the unit is, from `start` to `stop`. Nothing that goes wrong here stops the unit.

    Parameters
    ----------
    announcement : Announcement
    address : str
        That the server listens on; a loopback address is announced to nobody.
    port : int
    """

    def __init__(self, announcement: Announcement, address: str, port: int) -> None:
        self._announcement = announcement
        self._address = address
        self._port = port
        self._zeroconf: zeroconf.Zeroconf | None = None

    def start(self) -> None:
        """Begin, if there is anybody to tell; the answering is done at low priority."""
        if ipaddress.ip_address(self._address).is_loopback:
            return
        try:
            at_low_priority(self._register)
        except ImportError:
            logger.info("not announced in the network: zeroconf is not installed")
        except Exception as e:  # noqa: BLE001  as in `stop`
            logger.warning("not announced in the network: %s: %s", type(e).__name__, e)
            self.stop()

    def stop(self) -> None:
        """Take the announcement back. Calling it twice does no harm."""
        opened, self._zeroconf = self._zeroconf, None
        if opened is None:
            return
        try:
            opened.unregister_all_services()
            opened.close()
        except Exception as e:  # noqa: BLE001  whatever it is, a unit goes on and comes to its end without
            logger.warning("the announcement was not taken back: %s: %s", type(e).__name__, e)

    def _register(self) -> None:
        import zeroconf

        is_any = ipaddress.ip_address(self._address).is_unspecified
        self._zeroconf = zeroconf.Zeroconf(
            interfaces=zeroconf.InterfaceChoice.All if is_any else [self._address]
        )
        addresses = _own_addresses() if is_any else [self._address]
        info = zeroconf.ServiceInfo(
            SERVICE_TYPE,
            self._announcement.service_name,
            port=self._port,
            properties=self._announcement.as_txt(),
            parsed_addresses=addresses,
            server=f"{socket.gethostname().partition('.')[0]}.local.",
        )
        self._zeroconf.register_service(info, allow_name_change=True)
        logger.info("announced in the network as %s at %s", info.name, ", ".join(addresses))


def _own_addresses() -> list[str]:
    """Return this machine's IPv4 addresses that others can reach."""
    import ifaddr

    found = [ip.ip for adapter in ifaddr.get_adapters() for ip in adapter.ips if isinstance(ip.ip, str)]
    return [a for a in found if not ipaddress.ip_address(a).is_loopback]
