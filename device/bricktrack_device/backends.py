"""The only module that chooses between simulation and hardware."""

from collections.abc import Callable

from bricktrack_common.errors import ConfigError
from bricktrack_device.config import DeviceConfig
from bricktrack_device.interfaces import Rig


def _open_sim(config: DeviceConfig) -> Rig:
    if config.camera.mode != "1080p-crop" or config.camera.qp is not None:
        raise ConfigError(
            f"camera: mode = {config.camera.mode!r}, qp = {config.camera.qp!r}: the simulated camera has "
            "'1080p-crop' and a bit rate only; leave both out for backend 'sim'"
        )
    try:
        from bricktrack_device.sim.sim_rig import SimRig
    except ModuleNotFoundError as e:
        if e.name != "av":
            raise
        raise ConfigError(
            "backend: 'sim' needs PyAV, which is not installed here; run pip install 'bricktrack[sim]'"
        ) from e
    return SimRig(config.sim, config.camera)


def _open_hardware(config: DeviceConfig) -> Rig:
    from bricktrack_device.hardware.pi_rig import PiRig

    return PiRig(config)


BACKENDS: dict[str, Callable[[DeviceConfig], Rig]] = {"hardware": _open_hardware, "sim": _open_sim}


def open_rig(config: DeviceConfig) -> Rig:
    """Return the rig that the configuration names.

    Raises
    ------
    ConfigError
        If there is no such backend.
    """
    try:
        opener = BACKENDS[config.backend]
    except KeyError:
        raise ConfigError(
            f"backend: {config.backend!r} does not exist here; expected one of: {', '.join(sorted(BACKENDS))}"
        ) from None
    return opener(config)
