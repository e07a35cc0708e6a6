"""The unit's keys: private, readable, and known to somebody."""

from bricktrack_common.key_files import fingerprint
from bricktrack_device.config import DeviceConfig
from bricktrack_device.health.findings import CheckResult, good, warning
from bricktrack_device.network.unit_keys import UnitKeys


def check_keys(config: DeviceConfig) -> list[CheckResult]:
    """Say who this unit is and who may speak to it; raise `ConfigError` if its keys are no good."""
    if config.keys_folder is None:
        return [good("keys", f"none: nothing is encrypted, and only {config.server.address} is served")]
    keys = UnitKeys(config.keys_folder)
    clients = keys.clients()
    words = f"this unit is {fingerprint(keys.own.public)}"
    if not clients:
        remedy = "'bricktrackd keys allow', or 'bricktrack keys install' on a host"
        return [warning("keys", f"{words}; no host may speak to it: {keys.clients_folder} is empty", remedy)]
    names = ", ".join(sorted(clients.values())[:8]) + (" and more" if len(clients) > 8 else "")
    return [good("keys", f"{words}; {len(clients)} hosts' keys may speak to it: {names}")]
