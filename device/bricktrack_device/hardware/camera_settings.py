"""What the Pi's camera is told: sensor mode, fixed controls and encoder, and nothing left to a default."""

from dataclasses import dataclass, field

_US_PER_S = 1e6


@dataclass(frozen=True, slots=True)
class CameraMode:
    """One way to read the sensor.

    Attributes
    ----------
    name : str
        For people: part of the mode's name in the manifest.
    picture_size, sensor_size : (int, int), px
        Width and height of the delivered picture and of the sensor's output. They are equal in the modes
        below, so a picture row is a sensor row.
    bit_depth : int
        Of the sensor's output. A mode with fewer bits may have another line time.
    """

    name: str
    picture_size: tuple[int, int]
    sensor_size: tuple[int, int]
    bit_depth: int = 10


MODES = {
    "1080p-crop": CameraMode("crop", (1920, 1080), (1920, 1080)),
    "full-field": CameraMode("full", (1640, 1232), (1640, 1232)),
}
"""The modes of an IMX219 that serve: its centre at full sampling, or all of its field binned by two."""


@dataclass(frozen=True, slots=True)
class PiCameraSettings:
    """Everything that `PiCamera` can be told.

    Attributes
    ----------
    mode : CameraMode
    exposure_us : int
    analogue_gain : float
    colour_gains : (float, float)
        Red and blue.
    frame_rate_hz : float
    bitrate_bps : int
    iperiod : int, frames
        From one keyframe to the next: how coarsely a run's start can be cut.
    qp : int or None
        Fixed quantiser instead of a bit rate.
    profile : str
        H.264 profile.
    preset : str
        Of libx264, where there is no hardware encoder.
    camera_num : int
        Which camera, in picamera2's order.
    picture_format : str
        The main stream's pixel format. Every Raspberry Pi delivers YUV420.
    check_frames : int
        How many successive frames must hold the controls before the camera counts as started.
    rate_tolerance : float
        How far the median time between those frames may lie from the period that their metadata tell.
    buffer_counts : tuple of int
        How many buffers are tried for, one number after the other while memory is short.
    """

    mode: CameraMode = field(default_factory=lambda: MODES["1080p-crop"])
    exposure_us: int = 2000
    analogue_gain: float = 1.0
    colour_gains: tuple[float, float] = (1.5, 1.5)
    frame_rate_hz: float = 30.0
    bitrate_bps: int = 12_000_000
    iperiod: int = 12
    qp: int | None = None
    profile: str = "high"
    preset: str = "superfast"
    camera_num: int = 0
    picture_format: str = "YUV420"
    check_frames: int = 15
    rate_tolerance: float = 0.01
    buffer_counts: tuple[int, ...] = (6, 5, 4)

    @property
    def frame_duration_us(self) -> int:
        """The frame period that is asked for; the sensor rounds it down to whole lines."""
        return round(_US_PER_S / self.frame_rate_hz)

    def controls(self, noise_reduction_off: object) -> dict[str, object]:
        """Return the fixed controls, all for one call.

        libcamera drops an exposure or gain that arrives while its automatic mode is on, so the values and
        the switches go together.

        Parameters
        ----------
        noise_reduction_off
            libcamera's value for no noise reduction, which would move the centres of small blobs.
        """
        period_us = self.frame_duration_us
        return {
            "AeEnable": False,
            "ExposureTime": self.exposure_us,
            "AnalogueGain": self.analogue_gain,
            "AwbEnable": False,
            "ColourGains": self.colour_gains,
            "FrameDurationLimits": (period_us, period_us),
            "NoiseReductionMode": noise_reduction_off,
        }
