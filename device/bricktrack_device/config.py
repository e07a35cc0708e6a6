"""The unit's configuration: a TOML file as frozen, checked values; every key has a default.

`systemd/bricktrackd.toml` shows every key with its meaning.
"""

import ipaddress
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from bricktrack_common.errors import ConfigError
from bricktrack_common.imu_records import AxisMap
from bricktrack_common.typed_data import load_toml
from bricktrack_common.wire_messages import DEFAULT_PORT
from bricktrack_device.sim.settings import SimSettings

ImuMode = Literal["amg", "accgyro", "imuplus", "ndof"]
Pull = Literal["down", "up", "none"]
CameraModeName = Literal["1080p-crop", "full-field"]

_NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9-]{0,31}$"
_US_PER_S = 1e6


class _Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of the tables: frozen, by keyword, and strict about unknown keys."""


class UnitTable(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[unit]``: the name that stands in every run id; letters, digits and hyphens."""

    name: Annotated[str, msgspec.Meta(pattern=_NAME_PATTERN)] = "unit"


class StorageTable(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[storage]``: where runs are kept, and how many bytes must stay free beside a run.

    With ``delete_confirmed`` the oldest runs that a host has confirmed are deleted when the card is too full
    to arm; otherwise none is, but by a host's command. ``black_box`` is a folder in memory (tmpfs) for a copy
    of the run under way, which outlives a daemon that is killed; ``""`` takes one in systemd's runtime
    directory, and none where there is no such directory.
    """

    folder: str = "/var/lib/bricktrack"
    black_box: str = ""
    margin_mb: Annotated[int, msgspec.Meta(ge=0)] = 256
    delete_confirmed: bool = False


class ServerTable(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[server]``: where the file server listens; port 0 takes a free one and logs it.

    ``keys`` is the folder of the unit's key and of those of the hosts that may speak to it; ``""`` for none:
    then only a loopback address is served, and nothing is encrypted. With ``advertise`` a unit that can be
    reached from the network is announced there (mDNS), where zeroconf is installed.
    """

    address: str = "127.0.0.1"
    port: Annotated[int, msgspec.Meta(ge=0, le=65535)] = DEFAULT_PORT
    keys: str = ""
    advertise: bool = True


class CameraTable(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[camera]``: fixed exposure, gains and encoder; automatic control is off.

    ``mode`` is "1080p-crop" (the sensor's centre at full sampling) or "full-field" (all of it, binned by
    two); a calibration belongs to one of them. ``qp`` fixes the encoder's quantiser instead of the bit rate.
    With ``required = true`` a unit whose camera does not start refuses to arm; with ``false`` it arms and the
    run says that the video is missing.
    """

    required: bool = True
    mode: CameraModeName = "1080p-crop"
    exposure_us: Annotated[int, msgspec.Meta(ge=75, le=33_000)] = 2000
    analogue_gain: Annotated[float, msgspec.Meta(ge=1.0, le=16.0)] = 1.0
    colour_gains: tuple[
        Annotated[float, msgspec.Meta(gt=0, le=32)], Annotated[float, msgspec.Meta(gt=0, le=32)]
    ] = (1.5, 1.5)
    frame_rate_hz: Annotated[float, msgspec.Meta(gt=0, le=240)] = 30.0
    bitrate_bps: Annotated[int, msgspec.Meta(ge=25_000, le=25_000_000)] = 12_000_000
    iperiod: Annotated[int, msgspec.Meta(ge=1, le=300)] = 12
    qp: Annotated[int, msgspec.Meta(ge=1, le=51)] | None = None


class LedsTable(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[leds]``: how many LEDs the camera looks at, and the pins that switch them, if they hang on any.

    ``active_high = false`` where a pin sinks the current. A simulated unit has LEDs on any pin.
    """

    count: Annotated[int, msgspec.Meta(ge=1, le=64)] = 7
    pins: list[Annotated[str, msgspec.Meta(pattern=r"^(GPIO|BCM|BOARD)?[0-9]{1,2}$")]] = []
    active_high: bool = True


class TriggerTable(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[trigger]``: the pin of the square wave, and which edge counts as the first.

    With ``nominal_hz`` an edge is believed as the first only when those after it come at that period, so that
    a lone glitch starts no run; without it the first edge after arming is. ``quiet_gap_ms`` is how long the
    line must have been quiet before the first edge, 0 for no such gap; ``require_low`` asks that the line
    was seen low after arming.
    """

    pin: Annotated[str, msgspec.Meta(pattern=r"^(GPIO|BCM|BOARD)?[0-9]{1,2}$")] = "GPIO17"
    pull: Pull = "down"
    nominal_hz: Annotated[float, msgspec.Meta(ge=1, le=10_000)] | None = None
    quiet_gap_ms: Annotated[float, msgspec.Meta(ge=0, le=600_000)] = 0.0
    require_low: bool = True


class RecordingTable(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[recording]``: how much is kept around the first edge, and whether the unit arms itself.

    A run holds ``pre_roll_s`` before t = 0 and ``duration_s + post_roll_s`` after it. With ``auto_arm``
    the unit arms at start and after every saved run, until it is disarmed by command. A daemon that was
    killed while a host's command had it armed arms again within ``arm_again_within_s`` of that command.
    """

    duration_s: Annotated[float, msgspec.Meta(gt=0, le=600)] = 15.0
    pre_roll_s: Annotated[float, msgspec.Meta(ge=0, le=60)] = 0.5
    post_roll_s: Annotated[float, msgspec.Meta(ge=0, le=60)] = 0.5
    auto_arm: bool = False
    arm_again_within_s: Annotated[float, msgspec.Meta(ge=0, le=604_800)] = 43_200.0
    label: Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9_-]{0,32}$")] = ""


class ImuTable(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[[imu]]``: one BNO055.

    ``mode`` is "amg" (raw, ±16 g, the choice for shakes with impacts), "accgyro" (raw without
    magnetometer), "imuplus" or "ndof" (the chip's own orientation; ±4 g). ``latency_us`` is added to the
    middle of the bus transaction to give the sample time: negative for a filter's lag. ``axis_map`` is the
    placement whose remap the chip applies (data sheet, section 3.4; "P1" turns nothing). In the fusion modes
    a calibration saved for this chip is written into it at every start, and with
    ``save_calibration = true`` it is saved after a run, or at disarming, whenever the chip says that it is
    fully calibrated. With
    ``required = true`` a unit whose sensor does not start refuses to arm.
    """

    name: Annotated[str, msgspec.Meta(pattern=r"^[a-z0-9_-]{1,16}$")]
    bus: str = "/dev/i2c-3"
    address: Literal[0x28, 0x29] = 0x28
    mode: ImuMode = "amg"
    period_ms: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 10
    latency_us: Annotated[int, msgspec.Meta(ge=-100_000, le=100_000)] = 0
    status_every: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 10
    axis_map: AxisMap = "P1"
    save_calibration: bool = False
    required: bool = False


class SamplerTable(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[sampler]``: what the inertial samplers ask of the scheduler; refused wishes are only noted.

    ``priority`` is that of SCHED_FIFO, 0 for the ordinary scheduler; ``cpu`` the core to stay on, -1 to
    choose: the last one where there are four or more, none in particular otherwise.
    """

    priority: Annotated[int, msgspec.Meta(ge=0, le=90)] = 50
    cpu: Annotated[int, msgspec.Meta(ge=-1, le=255)] = -1
    lock_memory: bool = True


class DeviceConfig(_Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything that `bricktrackd` can be told."""

    backend: str = "hardware"
    unit: UnitTable = UnitTable()
    storage: StorageTable = StorageTable()
    server: ServerTable = ServerTable()
    camera: CameraTable = CameraTable()
    leds: LedsTable = LedsTable()
    trigger: TriggerTable = TriggerTable()
    recording: RecordingTable = RecordingTable()
    imu: list[ImuTable] = msgspec.field(default_factory=lambda: [ImuTable(name="brick")])
    sampler: SamplerTable = SamplerTable()
    sim: SimSettings = msgspec.field(default_factory=SimSettings)

    @property
    def storage_folder(self) -> Path:
        """The storage folder, absolute."""
        return Path(self.storage.folder).expanduser().absolute()

    @property
    def keys_folder(self) -> Path | None:
        """The folder of keys, absolute; `None` without keys."""
        return Path(self.server.keys).expanduser().absolute() if self.server.keys else None

    @property
    def calibration_folder(self) -> Path:
        """Where the calibrations of inertial sensors are kept, absolute."""
        return self.storage_folder / "calibration"

    def span_s(self, duration_s: float | None = None) -> float:
        """Return how long a run is from the start of its pre-roll to the end of its post-roll, s."""
        r = self.recording
        return r.pre_roll_s + (r.duration_s if duration_s is None else duration_s) + r.post_roll_s

    def video_bytes(self, duration_s: float | None = None) -> int:
        """Return how many bytes of video a run of ``duration_s`` takes at the configured bit rate."""
        return round(self.camera.bitrate_bps / 8 * self.span_s(duration_s))


def load_config(path: Path | None, overrides: dict[str, Any] | None = None) -> DeviceConfig:
    """Return the configuration in a file, or the defaults without one, with a command line's overrides.

    Parameters
    ----------
    path : Path or None
    overrides : dict
        Values by dotted key, as ``{"server.port": 0, "backend": "sim"}``; `None` values are left out.

    Raises
    ------
    ConfigError
        If the file is missing or not TOML, a key is unknown or wrong, or values contradict each other;
        the message names the file and the key.
    """
    config = DeviceConfig() if path is None else load_toml(path, DeviceConfig)
    check_config(config, where="defaults" if path is None else str(path))
    return with_values(config, overrides or {}, where="command line")


def with_values(config: DeviceConfig, values: Mapping[str, object], *, where: str) -> DeviceConfig:
    """Return a configuration with some values replaced, checked as a whole.

    Parameters
    ----------
    values : mapping
        Values by dotted key; `None` values are left out.
    where : str
        Where they come from, to be named in the error.

    Raises
    ------
    ConfigError
        If a value is wrong, or does not go with the others.
    """
    for key, value in values.items():
        if value is not None:
            config = _replaced(config, key, value, where=where)
    check_config(config, where=where)
    return config


def _replaced(config: DeviceConfig, key: str, value: object, *, where: str) -> DeviceConfig:
    data = msgspec.to_builtins(config)
    table, _, name = key.rpartition(".")
    (data[table] if table else data)[name] = value
    try:
        return msgspec.convert(data, DeviceConfig, strict=True)
    except msgspec.ValidationError as e:
        problem = str(e).partition(" - at `")[0]
        raise ConfigError(f"{where}: {key}: {problem}; got {value!r}") from e


def check_config(config: DeviceConfig, *, where: str) -> None:
    """Make sure that the values go together; see `load_config`."""
    _check_address(config.server, where)
    names = [i.name for i in config.imu]
    if len(set(names)) < len(names):
        raise ConfigError(f"{where}: imu: a name stands twice in {names}; give each sensor its own")
    places = [(i.bus, i.address) for i in config.imu]
    if len(set(places)) < len(places):
        raise ConfigError(f"{where}: imu: two sensors with the same bus and address; set one to 0x29")
    pins = [_plain_pin(p) for p in config.leds.pins]
    if len(set(pins)) < len(pins):
        raise ConfigError(f"{where}: leds.pins: a pin stands twice in {config.leds.pins}; name each once")
    if _plain_pin(config.trigger.pin) in pins:
        raise ConfigError(
            f"{where}: leds.pins: {config.trigger.pin} is the trigger's pin too: the unit would drive the "
            "square wave's line. Give the LEDs another pin"
        )
    period_us = _US_PER_S / config.camera.frame_rate_hz
    if config.camera.exposure_us >= period_us:
        raise ConfigError(
            f"{where}: camera.exposure_us: {config.camera.exposure_us} µs does not fit the frame period "
            f"of {period_us:.0f} µs at {config.camera.frame_rate_hz:g} Hz"
        )


def _plain_pin(name: str) -> str:
    """Return one name for GPIO17, BCM17 and 17; pins of the header's own numbering keep theirs."""
    return name if name.startswith("BOARD") else name.lstrip("GPIOBCM").lstrip("0") or "0"


def _check_address(server: ServerTable, where: str) -> None:
    address = server.address
    try:
        is_loopback = ipaddress.ip_address(address).is_loopback
    except ValueError as e:
        raise ConfigError(
            f"{where}: server.address: {address!r} is no IP address; expected one such as 127.0.0.1"
        ) from e
    if not is_loopback and not server.keys:
        raise ConfigError(
            f"{where}: server.address: {address} can be reached from the network, and without keys anyone "
            "there could arm this unit and read its runs. Make keys ('bricktrackd keys create') and set "
            "server.keys, or use 127.0.0.1 (and an SSH tunnel to reach it)"
        )
