"""What `bricktrackd check` looks at: every part the daemon needs, each with a remedy where it is not well."""

import socket
from collections.abc import Callable

from bricktrack_common.errors import HardwareError
from bricktrack_device.capture.saving import software_versions
from bricktrack_device.config import DeviceConfig, ImuTable
from bricktrack_device.health import machine, storage
from bricktrack_device.health.camera import check_camera
from bricktrack_device.health.findings import CheckResult, good, tried
from bricktrack_device.health.inertial import check_adapter, check_imu
from bricktrack_device.health.keys import check_keys
from bricktrack_device.health.trigger_line import check_trigger
from bricktrack_device.interfaces import Rig

Check = Callable[[], list[CheckResult]]


def run_checks(config: DeviceConfig, rig: Rig) -> list[CheckResult]:
    """Try every part in turn; a failure stops none of the others."""
    results = []
    for name, remedy, check in _checks(config, rig):
        results += tried(name, remedy, check)
    return results


def _checks(config: DeviceConfig, rig: Rig) -> list[tuple[str, str, Check]]:
    """Return name, the remedy for an error on purpose, and what to call."""
    wiring = "Check wiring, supply, [[imu]] bus and address (0x28 or 0x29)"
    return [
        ("clocks", "Reboot the unit and disable suspend", machine.check_clocks),
        (
            "storage",
            "Set storage.folder to a folder that this user may write",
            lambda: storage.check_space(config),
        ),
        ("storage speed", "Set storage.folder to a folder that this user may write", lambda: _speed(config)),
        ("port", "Stop the program that holds it, or set server.port", lambda: _check_port(config)),
        ("keys", "See docs/how-to/keys.md", lambda: check_keys(config)),
        ("permissions", "Run it as the service's user", lambda: _permissions(config, rig)),
        ("real-time rights", "See [sampler]", lambda: machine.check_realtime(config.sampler)),
        ("temperature", "Cool the unit", machine.check_temperature),
        (
            "throttling",
            "Use the official supply",
            lambda: machine.check_throttling(machine.read_throttled(may_start_process=True)),
        ),
        (
            "trigger",
            "Check trigger.pin and that no other program holds it",
            lambda: check_trigger(config, rig),
        ),
        ("camera", "Check the camera's cable and the [camera] settings", lambda: check_camera(config, rig)),
        *((f"imu {imu.name}", wiring, _imu_check(imu, rig)) for imu in config.imu),
        *((f"bus of imu {imu.name}", wiring, _adapter_check(imu, rig)) for imu in config.imu),
        ("versions", "", lambda: machine.check_versions(software_versions(), rig.describe())),
    ]


def _imu_check(imu: ImuTable, rig: Rig) -> Check:
    return lambda: check_imu(imu, rig)


def _adapter_check(imu: ImuTable, rig: Rig) -> Check:
    def check() -> list[CheckResult]:
        rig.bus_opener(imu.bus)  # the rig looks at the adapter here, and opens nothing
        return check_adapter(imu, rig.describe(), simulated=rig.simulated)

    return check


def _speed(config: DeviceConfig) -> list[CheckResult]:
    folder = config.storage_folder
    folder.mkdir(parents=True, exist_ok=True)
    return storage.check_speed(config, storage.write_speed_bps(folder))


def _permissions(config: DeviceConfig, rig: Rig) -> list[CheckResult]:
    if rig.simulated:
        return [good("permissions", "none needed: the sensors are simulated")]
    return machine.check_permissions([imu.bus for imu in config.imu])


def _check_port(config: DeviceConfig) -> list[CheckResult]:
    address, port = config.server.address, config.server.port
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except OSError as e:
            raise HardwareError(f"{address} port {port}: {e.strerror}") from e
    return [good("port", f"{address} port {port} is free")]
