"""Does the camera do what it was told: its frames' metadata and its mode against what was asked for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from typing import Any

from bricktrack_common.camera_model import SensorMode
from bricktrack_common.errors import HardwareError
from bricktrack_device.hardware.camera_settings import PiCameraSettings

MAX_FRAME_AGE_NS = 1_000_000_000
"""A frame older than this when it is delivered has its stamp from another clock."""
CROP_TOLERANCE_PX = 4
"""The image processor may trim a few columns or rows; more would put the first picture row off the first
sensor row, and every row time with it."""
_GAIN_STEP_AT_1 = 1 / 256
"""An IMX219's analogue gain is 256 / (256 - code): its steps grow as gain / 256."""


@dataclass(frozen=True, slots=True)
class FrameReport:
    """What one frame's metadata say, and when they came.

    Attributes
    ----------
    sensor_timestamp_ns, arrival_ns : int, ns
        Stamp of the frame; CLOCK_MONOTONIC at its delivery.
    exposure_us : int
    analogue_gain : float
    frame_duration_us : int
    digital_gain : float or None
    colour_gains : (float, float) or None
    scaler_crop : (int, int, int, int) or None
        x, y, width, height of the picture in sensor pixels. `None`s are values the camera does not report.
    """

    sensor_timestamp_ns: int
    arrival_ns: int
    exposure_us: int
    analogue_gain: float
    frame_duration_us: int
    digital_gain: float | None
    colour_gains: tuple[float, float] | None
    scaler_crop: tuple[int, int, int, int] | None


def read_report(metadata: Mapping[str, Any], arrival_ns: int) -> FrameReport:
    """Return the values of one frame's libcamera metadata.

    Raises
    ------
    HardwareError
        If a value that must be checked is not there.
    """
    try:
        gains = metadata.get("ColourGains")
        crop = metadata.get("ScalerCrop")
        digital = metadata.get("DigitalGain")
        return FrameReport(
            sensor_timestamp_ns=int(metadata["SensorTimestamp"]),
            arrival_ns=arrival_ns,
            exposure_us=int(metadata["ExposureTime"]),
            analogue_gain=float(metadata["AnalogueGain"]),
            frame_duration_us=int(metadata["FrameDuration"]),
            digital_gain=None if digital is None else float(digital),
            colour_gains=None if gains is None else (float(gains[0]), float(gains[1])),
            scaler_crop=None if crop is None else (int(crop[0]), int(crop[1]), int(crop[2]), int(crop[3])),
        )
    except KeyError as e:
        raise HardwareError(
            f"camera: frames come without {e.args[0]}; expected a Raspberry Pi camera, whose metadata hold "
            "it. Check the camera with 'rpicam-hello --list-cameras'"
        ) from e


class ControlsCheck:
    """Whether frames have come to hold the controls that were set, and keep them.

    Parameters
    ----------
    settings : PiCameraSettings
    line_time_us : float, us
        Exposures and frame periods are whole numbers of lines, rounded down by libcamera.
    """

    def __init__(self, settings: PiCameraSettings, line_time_us: float) -> None:
        self._settings = settings
        self._line_time_us = line_time_us
        self._run: list[FrameReport] = []
        self._why = "no frame came"
        self.n_frames = 0

    @property
    def steady(self) -> bool:
        """Whether enough successive frames held the controls without a change."""
        return len(self._run) >= self._settings.check_frames

    @property
    def reports(self) -> list[FrameReport]:
        """The successive frames that held the controls, up to now."""
        return list(self._run)

    def add(self, report: FrameReport) -> None:
        """Judge the next frame."""
        self.n_frames += 1
        wrong = self._off(report)
        if wrong:
            self._why = "; ".join(wrong)
            self._run = []
            return
        if self._run:
            moved = _moved(self._run[0], report)
            if moved:
                self._why = "the values wander: " + "; ".join(moved)
                self._run = []
        self._run.append(report)

    def require_steady(self) -> None:
        """Make sure that the frames are steady.

        Raises
        ------
        HardwareError
            If they are not: with the values found and wanted, and what to do.
        """
        if not self.steady:
            raise HardwareError(
                f"camera: after {self.n_frames} frames not {self._settings.check_frames} in a row hold the "
                f"controls that were set: {self._why}. Choose values that the sensor mode allows "
                "(camera.exposure_us, camera.analogue_gain, camera.frame_rate_hz), and stop any program "
                "that changes the camera's controls"
            )

    def _off(self, r: FrameReport) -> list[str]:
        s = self._settings
        line_us = self._line_time_us
        wrong = []
        if not s.exposure_us - line_us - 1 <= r.exposure_us <= s.exposure_us + 1:
            wrong.append(f"exposure is {r.exposure_us} µs, wanted {s.exposure_us} µs")
        gain_slack = s.analogue_gain * (0.01 + _GAIN_STEP_AT_1 * s.analogue_gain)
        if abs(r.analogue_gain - s.analogue_gain) > gain_slack:
            wrong.append(f"analogue gain is {r.analogue_gain:.4g}, wanted {s.analogue_gain:.4g}")
        if not s.frame_duration_us - line_us - 1 <= r.frame_duration_us <= s.frame_duration_us + 1:
            wrong.append(f"frame period is {r.frame_duration_us} µs, wanted {s.frame_duration_us} µs")
        if r.colour_gains is not None and any(
            abs(have - want) > 0.01 * want for have, want in zip(r.colour_gains, s.colour_gains, strict=True)
        ):
            wrong.append(f"colour gains are {r.colour_gains}, wanted {s.colour_gains}")
        age_ns = r.arrival_ns - r.sensor_timestamp_ns
        if not 0 <= age_ns <= MAX_FRAME_AGE_NS:
            wrong.append(
                f"the frame's stamp lies {age_ns / 1e6:.1f} ms before its delivery, wanted 0 to "
                f"{MAX_FRAME_AGE_NS / 1e6:.0f} ms: it is not on CLOCK_MONOTONIC"
            )
        return wrong


def _moved(first: FrameReport, now: FrameReport) -> list[str]:
    """Return which values differ between two frames that both lie near what was wanted."""
    moved = []
    for name, slack in (
        ("exposure_us", 0.5),
        ("analogue_gain", 1e-4),
        ("frame_duration_us", 1.5),
        ("digital_gain", 1e-3),
    ):
        a, b = getattr(first, name), getattr(now, name)
        if (a is None) != (b is None) or (a is not None and abs(a - b) > slack):
            moved.append(f"{name} from {a} to {b}")
    if first.scaler_crop != now.scaler_crop:
        moved.append(f"scaler crop from {first.scaler_crop} to {now.scaler_crop}")
    return moved


def check_frame_rate(reports: Sequence[FrameReport], *, tolerance: float) -> None:
    """Make sure that frames come as often as their metadata say.

    The median is compared, so that single dropped frames do not count.

    Raises
    ------
    HardwareError
        If they come slower or faster by more than ``tolerance``, relative.
    """
    stamps = [r.sensor_timestamp_ns for r in reports]
    gaps_us = [(b - a) / 1000 for a, b in pairwise(stamps)]
    if not gaps_us:
        return
    found_us, said_us = median(gaps_us), reports[-1].frame_duration_us
    if abs(found_us - said_us) > tolerance * said_us:
        raise HardwareError(
            f"camera: frames come every {found_us:.0f} µs, but their metadata say {said_us} µs. This "
            "computer does not keep up: lower camera.frame_rate_hz or camera.bitrate_bps, and stop other "
            "programs"
        )


def check_configuration(found: Mapping[str, Any], settings: PiCameraSettings) -> None:
    """Make sure that libcamera took the configuration as it was asked for.

    Parameters
    ----------
    found : dict
        As from `Picamera2.camera_configuration`.

    Raises
    ------
    HardwareError
        If it adjusted the picture or the sensor mode.
    """
    mode = settings.mode
    wanted: dict[str, object] = {
        "picture size": mode.picture_size,
        "picture format": settings.picture_format,
    }
    main = found["main"]
    have: dict[str, object] = {
        "picture size": tuple(main["size"]),
        "picture format": main["format"],
    }
    sensor = found.get("sensor")
    if sensor is not None:
        wanted |= {"sensor output": mode.sensor_size, "sensor bit depth": mode.bit_depth}
        have |= {
            "sensor output": tuple(sensor["output_size"]),
            "sensor bit depth": sensor["bit_depth"],
        }
    wrong = [f"{k} is {have[k]}, wanted {wanted[k]}" for k in wanted if have[k] != wanted[k]]
    if wrong:
        raise HardwareError(
            f"camera: this sensor has no such mode: {'; '.join(wrong)}. Choose another camera mode; "
            "'rpicam-hello --list-cameras' shows them"
        )


def sensor_mode(
    *,
    model: str,
    settings: PiCameraSettings,
    mode_crop: tuple[int, int, int, int],
    scaler_crop: tuple[int, int, int, int],
    line_time_ns: float,
) -> SensorMode:
    """Return the running sensor mode.

    Parameters
    ----------
    model : str
        The sensor's name, as ``imx219``.
    settings : PiCameraSettings
    mode_crop, scaler_crop : (int, int, int, int), sensor px
        x, y, width, height that the sensor reads, and that the picture shows.
    line_time_ns : float, ns

    Returns
    -------
    mode : SensorMode
        Its rows are in order of time: libcamera flips pictures in the sensor, so the first row of a
        picture is the first that is read whatever the flip.

    Raises
    ------
    HardwareError
        If the picture is not what the sensor reads, or the binning is not a whole number.
    """
    if any(abs(a - b) > CROP_TOLERANCE_PX for a, b in zip(mode_crop, scaler_crop, strict=True)):
        raise HardwareError(
            f"camera: the picture shows {scaler_crop} of the sensor, which reads {mode_crop} (x, y, width, "
            "height): its rows have no simple times. Use a picture of the sensor mode's shape"
        )
    width, height = settings.mode.sensor_size
    binning = round(mode_crop[2] / width)
    if binning < 1 or (mode_crop[2], mode_crop[3]) != (binning * width, binning * height):
        raise HardwareError(
            f"camera: the sensor reads {mode_crop[2]}x{mode_crop[3]} px into {width}x{height} px; expected "
            "the same whole number of rows and columns in each. Choose another camera mode"
        )
    picture_width, picture_height = settings.mode.picture_size
    return SensorMode(
        name=f"{model}-{picture_width}x{picture_height}-{settings.mode.name}",
        width=picture_width,
        height=picture_height,
        crop_x=mode_crop[0],
        crop_y=mode_crop[1],
        crop_width=mode_crop[2],
        crop_height=mode_crop[3],
        binning=binning,
        line_time_ns=line_time_ns,
        row_order="down",
    )
