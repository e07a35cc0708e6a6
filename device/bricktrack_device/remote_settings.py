"""What a host may change in the unit's configuration, kept across restarts beside the runs.

The unit's own file stays as it is: `<storage>/configured.json` holds only the keys that a host has set. They
pass the same checks as the file, together with it.
"""

import logging
from collections.abc import Mapping
from pathlib import Path

import msgspec

from bricktrack_common.errors import BricktrackError, ConfigError
from bricktrack_common.typed_data import dump_json, load_json
from bricktrack_common.wire_messages import ConfigValue
from bricktrack_device.config import DeviceConfig, with_values
from bricktrack_device.storage.disk import Disk, storage_error

logger = logging.getLogger(__name__)

FILE_NAME = "configured.json"
REMOTE_KEYS = (
    "camera.exposure_us", "camera.analogue_gain", "camera.colour_gains", "camera.bitrate_bps",
    "leds.count",
    "trigger.nominal_hz", "trigger.quiet_gap_ms",
    "recording.duration_s", "recording.pre_roll_s", "recording.post_roll_s", "recording.auto_arm",
    "recording.label",
)  # fmt: skip
"""Nothing that says who the unit is, where runs are kept, how it is reached or what hangs on which pin."""


class _Configured(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    version: int = 1
    values: dict[str, ConfigValue]


class RemoteSettings:
    """The unit's configuration, with what hosts have changed in it. For one thread at a time.

    Parameters
    ----------
    base : DeviceConfig
        What the unit's own file and command line say.
    folder : Path
        The storage folder.
    disk : Disk
    """

    def __init__(self, base: DeviceConfig, folder: Path, *, disk: Disk | None = None) -> None:
        self._base = base
        self._path = folder / FILE_NAME
        self._disk = disk or Disk()
        self._values: dict[str, ConfigValue] = {}
        self.config = base
        self.problem = ""
        """Why what hosts had set could not be taken over at the start, in words."""

    def load(self) -> DeviceConfig:
        """Take over what was set before this start, and return the configuration that results.

        What does not go with the unit's own file any more is left aside as a whole: the unit then works by
        its file, and `problem` says so.
        """
        try:
            if not self._is_there():
                return self.config
            stored = load_json(self._path, _Configured, error=ConfigError)
            if stored.version != 1:
                raise ConfigError(f"{self._path}: version {stored.version}; this bricktrack reads version 1")
            self.config = self._with(stored.values)
            self._values = stored.values
        except ConfigError as e:
            self.problem = f"what hosts have configured is not used: {e}. Configure it anew"
            logger.warning("%s", self.problem)
        return self.config

    def _is_there(self) -> bool:
        try:
            return self._path.exists()
        except OSError as e:
            raise ConfigError(f"{self._path}: {e.strerror or e}") from e

    def change(self, values: Mapping[str, ConfigValue]) -> DeviceConfig:
        """Take all of some values, or none; return the configuration that results.

        Parameters
        ----------
        values : mapping
            By dotted key; `None` goes back to what the unit's own file says.

        Raises
        ------
        ConfigError
            If a key cannot be configured from a host, or a value does not pass the checks.
        StorageError
            If they cannot be written down.
        """
        merged: dict[str, ConfigValue] = {
            k: v for k, v in {**self._values, **values}.items() if v is not None
        }
        config = self._with({**values, **merged})
        text = dump_json(_Configured(values=merged))
        try:
            self._disk.replace_file(self._path, text)
        except OSError as e:
            raise storage_error(f"{self._path}: the configuration cannot be written", e) from e
        for key in values:
            logger.info("configured: %s = %r", key, merged.get(key, "as in the unit's file"))
        self._values, self.config, self.problem = merged, config, ""
        return config

    def values(self) -> dict[str, ConfigValue]:
        """Return every key that can be configured, with its value now."""
        data = msgspec.to_builtins(self.config)
        found: dict[str, ConfigValue] = {}
        for key in REMOTE_KEYS:
            table, _, name = key.partition(".")
            value = data[table][name]
            found[key] = list(value) if isinstance(value, tuple) else value
        return found

    def changed_keys(self) -> list[str]:
        """Return the keys that a host has set."""
        return sorted(self._values)

    def _with(self, values: Mapping[str, ConfigValue]) -> DeviceConfig:
        unknown = sorted(set(values) - set(REMOTE_KEYS))
        if unknown:
            raise ConfigError(
                f"{', '.join(unknown)}: cannot be configured from a host; what can: {', '.join(REMOTE_KEYS)}"
            )
        try:
            return with_values(self._base, values, where="configured")
        except BricktrackError as e:
            raise ConfigError(str(e)) from e
