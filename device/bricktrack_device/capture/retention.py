"""Makes room on the card by deleting runs that a host holds, where the configuration says that it may."""

import logging

from bricktrack_common.errors import BricktrackError
from bricktrack_device.capture.room import disk_needed_bytes
from bricktrack_device.config import DeviceConfig
from bricktrack_device.storage.run_store import RunStore

logger = logging.getLogger(__name__)


def make_room(config: DeviceConfig, store: RunStore, duration_s: float) -> list[str]:
    """Delete confirmed runs, the oldest first, until a run of ``duration_s`` fits; return their ids.

    Does nothing without ``storage.delete_confirmed``. A run that no host has confirmed is never touched.
    """
    if not config.storage.delete_confirmed:
        return []
    needed = disk_needed_bytes(config, duration_s)
    deleted: list[str] = []
    if store.free_bytes() >= needed:
        return deleted
    for run in store.list_runs():
        if not run.confirmed:
            continue
        try:
            store.delete(run.run_id)
        except BricktrackError as e:
            logger.warning("no room made: %s", e)
            continue
        deleted.append(run.run_id)
        if store.free_bytes() >= needed:
            break
    if deleted:
        logger.info("deleted %d confirmed runs to make room, from %s on", len(deleted), deleted[0])
    return deleted
