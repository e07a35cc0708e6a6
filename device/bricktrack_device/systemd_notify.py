"""Telling systemd how the daemon is: datagrams to ``NOTIFY_SOCKET``, as sd_notify(3) describes."""

import logging
import os
import socket

logger = logging.getLogger(__name__)


def notify(message: str) -> None:
    """Send one message, as ``READY=1``, ``WATCHDOG=1`` or ``STATUS=armed``."""
    path = os.environ.get("NOTIFY_SOCKET", "")
    if not path:
        return
    address = "\0" + path[1:] if path.startswith("@") else path
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel:
            channel.sendto(message.encode(), address)
    except OSError as e:
        logger.debug("systemd was not told %r: %s", message, e)
