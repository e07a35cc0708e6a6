"""Text files of recordings made by other means: stamps of pictures, inertial samples, edges, the rig."""

from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.camera_model import IMX219_1080P, SensorMode
from bricktrack_common.errors import ConfigError, VideoError
from bricktrack_common.typed_data import convert, load_toml
from bricktrack_host.recordings.timed_csv import TimedCsv, read_text

TimestampUnit = Literal["auto", "us", "ms"]
_MAX_FRAME_RATE_HZ = 1000.0
_MAX_EXPOSURE_US = 1e6
_ACC_COLUMNS = ("ax_mps2", "ay_mps2", "az_mps2")
_GYRO_COLUMNS = {
    "dps": ("gx_dps", "gy_dps", "gz_dps"),
    "radps": ("gx_radps", "gy_radps", "gz_radps"),
}
_Positive = Annotated[float, msgspec.Meta(gt=0)]


@dataclass(frozen=True, slots=True, eq=False)
class LooseImu:
    """Inertial samples from a CSV file, in the sensor's axes.

    Attributes
    ----------
    t_ns : ndarray of int64, shape (n,), ns, the file's own clock
    acc_mps2, gyro_dps : ndarray, shape (n, 3)
        NaN in a row whose sample the file says is missing.
    """

    t_ns: IntArray
    acc_mps2: FloatArray
    gyro_dps: FloatArray


_MAX_DECIMAL_EXPONENT = 18  # of int64


def read_timestamps(path: Path, *, unit: TimestampUnit = "auto") -> IntArray:
    """Return the stamps of a video's pictures, int64 us, one a line, strictly increasing.

    Whole numbers are us, as `bricktrack` and ``*_pts_us.txt`` files have them; numbers with decimals, and
    files that begin with ``# timecode format v2`` (picamera2, mkvmerge), are ms. Lines with ``#`` and empty
    ones are skipped.

    Raises
    ------
    VideoError
        If a line is no number, stamps do not increase, or the unit cannot be as read.
    """
    lines = [(n, text.strip()) for n, text in enumerate(read_text(path, VideoError).splitlines(), start=1)]
    is_timecode = any(text.lower().startswith("# timecode format v2") for _, text in lines[:3])
    rows = [(n, text) for n, text in lines if text and not text.startswith("#")]
    if not rows:
        raise VideoError(f"{path}: no time stamps; expected one number a line")
    if unit == "auto":
        unit = "ms" if is_timecode or any("." in text for _, text in rows) else "us"
    scale = 1000 if unit == "ms" else 1
    stamps = np.empty(len(rows), dtype=np.int64)
    for i, (n, text) in enumerate(rows):
        try:
            value = Decimal(text) * scale
            if value and value.adjusted() > _MAX_DECIMAL_EXPONENT:  # before a million digits are written out
                raise OverflowError
            if value != value.to_integral_value() and unit == "us":
                raise VideoError(f"{path}: line {n}: {text!r} µs is no whole number. Is the file in ms?")
            stamps[i] = int(value.to_integral_value())
        except (ArithmeticError, ValueError) as e:  # of Decimal, int and int64
            if isinstance(e, VideoError):
                raise
            raise VideoError(
                f"{path}: line {n}: {text[:40]!r} is no number; expected a time in {unit}"
            ) from e
        if i and stamps[i] <= stamps[i - 1]:
            raise VideoError(
                f"{path}: line {n}: {text} does not come after the stamp before it. The file was put "
                "together wrongly, or its pictures are not in the order of time"
            )
    if len(stamps) > 1:
        step_us = float(np.median(np.diff(stamps)))
        if not 1e6 / _MAX_FRAME_RATE_HZ <= step_us <= 10e6:
            raise VideoError(
                f"{path}: read in {unit}, the stamps are {step_us:g} µs apart, which no camera run here is. "
                "Give the unit with --timestamps-unit"
            )
    return stamps


def read_exposures_us(path: Path, *, n_frames: int) -> IntArray:
    """Return each picture's exposure, int64 us, shape (n_frames,), one a line; as `read_timestamps` reads.

    Raises
    ------
    VideoError
        If a line is no time between 1 us and a second, or there is not one for each stamp.
    """
    lines = [(n, text.strip()) for n, text in enumerate(read_text(path, VideoError).splitlines(), start=1)]
    rows = [(n, text) for n, text in lines if text and not text.startswith("#")]
    if len(rows) != n_frames:
        raise VideoError(
            f"{path} holds {len(rows)} exposures for {n_frames} stamps; expected one a line for each picture"
        )
    exposures_us = np.empty(n_frames, dtype=np.int64)
    for i, (n, text) in enumerate(rows):
        try:
            exposure_us = float(text)
        except ValueError:
            exposure_us = float("nan")
        if not 1 <= exposure_us <= _MAX_EXPOSURE_US:
            raise VideoError(
                f"{path}: line {n}: {text[:40]!r}; expected an exposure time in us, from 1 to 1000000"
            )
        exposures_us[i] = round(exposure_us)
    return exposures_us


def read_imu_csv(path: Path) -> LooseImu:
    """Return the samples of a CSV file with the columns ``t_ns, ax_mps2 .. az_mps2, gx_dps .. gz_dps``.

    Other columns are ignored; the gyroscope may be in ``g?_radps``. A row with an empty or NaN value is a
    missing sample.

    Raises
    ------
    RunFormatError
        If a column is missing, a field is no number, or times do not increase.
    """
    table = TimedCsv.read(path)
    gyro_unit = next((u for u, names in _GYRO_COLUMNS.items() if set(names) <= set(table.header)), "dps")
    t_ns, values = table.columns(
        (*_ACC_COLUMNS, *_GYRO_COLUMNS[gyro_unit]),
        expected="t_ns, ax_mps2, ay_mps2, az_mps2, gx_dps, gy_dps and gz_dps (or g?_radps)",
    )
    values[~np.isfinite(values).all(axis=1)] = np.nan
    gyro = np.rad2deg(values[:, 3:]) if gyro_unit == "radps" else values[:, 3:]
    return LooseImu(t_ns, values[:, :3], gyro)


def read_edges_csv(path: Path) -> IntArray:
    """Return the rising edges in the column ``t_ns`` of a CSV file, int64 ns, strictly increasing."""
    return TimedCsv.read(path).columns((), expected="t_ns")[0]


class _Sensor(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[sensor]`` of a rig file; the crop may be left out where the mode's is not known."""

    name: str = ""
    width: Annotated[int, msgspec.Meta(ge=16)]
    height: Annotated[int, msgspec.Meta(ge=16)]
    exposure_us: _Positive
    line_time_us: Annotated[float, msgspec.Meta(ge=0)]
    frame_period_us: _Positive | None = None
    crop_x: int = 0
    crop_y: int = 0
    crop_width: int | None = None
    crop_height: int | None = None
    binning: int = 1
    row_order: Literal["down", "up"] = "down"


class _Take(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The table of one video: when it began, and whether its rows were read one after another."""

    first_sensor_timestamp_ns: int
    rolling_shutter: bool = True


class _Trigger(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    square_wave_hz: _Positive | None = None


@dataclass(frozen=True, slots=True)
class LooseRig:
    """How the sensor of a loose recording was read.

    Attributes
    ----------
    simulated : bool or None
        As the rig file says; `None` if it does not.
    square_wave_hz : float or None, Hz
        By the laboratory's clock.
    """

    mode: SensorMode
    exposure_us: int
    first_sensor_timestamp_ns: int
    simulated: bool | None = None
    square_wave_hz: float | None = None


def read_rig(path: Path, *, table: str) -> LooseRig:
    """Return what a rig file says of the video that its table ``[table]`` describes.

    Tables of other videos and of the calibration are left alone.

    Raises
    ------
    ConfigError
        If the file, a table or a key is missing or wrong.
    """
    data: dict[str, Any] = load_toml(path, dict[str, Any])
    for name in ("sensor", table):
        if not isinstance(data.get(name), dict):
            takes = [k for k, v in data.items() if isinstance(v, dict) and "first_sensor_timestamp_ns" in v]
            raise ConfigError(
                f"{path}: no table [{name}]"
                + (f"; --rig-table may be {', '.join(takes)}" if name == table and takes else "")
            )
    sensor = convert(data["sensor"], _Sensor, where=f"{path}: [sensor]", error=ConfigError)
    take = convert(data[table], _Take, where=f"{path}: [{table}]", error=ConfigError)
    trigger = convert(data.get("trigger", {}), _Trigger, where=f"{path}: [trigger]", error=ConfigError)
    simulated = data.get("simulated")
    if simulated is not None and not isinstance(simulated, bool):
        raise ConfigError(f"{path}: simulated: {simulated!r}; expected true or false")
    mode = sensor_mode(
        width=sensor.width,
        height=sensor.height,
        line_time_us=sensor.line_time_us if take.rolling_shutter else 0.0,
        name=sensor.name,
        crop_x=sensor.crop_x,
        crop_y=sensor.crop_y,
        crop_width=sensor.crop_width,
        crop_height=sensor.crop_height,
        binning=sensor.binning,
        row_order=sensor.row_order,
    )
    return LooseRig(
        mode, round(sensor.exposure_us), take.first_sensor_timestamp_ns, simulated, trigger.square_wave_hz
    )


def sensor_mode(
    *,
    width: int,
    height: int,
    line_time_us: float,
    name: str = "",
    crop_x: int = 0,
    crop_y: int = 0,
    crop_width: int | None = None,
    crop_height: int | None = None,
    binning: int = 1,
    row_order: Literal["down", "up"] = "down",
) -> SensorMode:
    """Return a sensor mode from what is known of it.

    Where the crop is not known, a picture of 1920 x 1080 is taken for the IMX219's centre crop, as
    ``bricktrack calibrate`` does; any other for the sensor read from its corner.
    """
    known = IMX219_1080P
    if crop_width is None and crop_height is None and (width, height, binning) == (
        known.width, known.height, known.binning,
    ):  # fmt: skip
        return msgspec.structs.replace(
            known, name=name or known.name, line_time_ns=line_time_us * 1000.0, row_order=row_order
        )
    try:
        return msgspec.convert(
            {
                "name": name or f"{width}x{height}",
                "width": width,
                "height": height,
                "crop_x": crop_x,
                "crop_y": crop_y,
                "crop_width": crop_width or width * binning,
                "crop_height": crop_height or height * binning,
                "binning": binning,
                "line_time_ns": line_time_us * 1000.0,
                "row_order": row_order,
            },
            SensorMode,
        )
    except msgspec.ValidationError as e:
        raise ConfigError(f"sensor mode {width} x {height}: {e}") from e
