"""What libcamera's virtual camera lacks to pass for a Raspberry Pi's: controls that act, and metadata.

Import it before a `Picamera2` is made. Below it lies the virtual Pi's own shim, which makes picamera2 accept the
virtual pipeline at all. The controls never reach libcamera: they are remembered and told back in each frame's
metadata, rounded as an IMX219 rounds them. `Quirks` makes it behave badly.
"""

import dataclasses

import shim_picamera2  # noqa: F401  the virtual Pi's: patches picamera2 on import
from picamera2 import Picamera2, encoders
from picamera2.request import CompletedRequest

LINE_TIME_NS = 18903.508771929824
FRAME_LINES = 1763


@dataclasses.dataclass
class Quirks:
    """How the sensor misbehaves; all off by default."""

    exposure_us: int | None = None
    gain_wanders: bool = False
    crop: tuple[int, int, int, int] | None = None
    without: str = ""


quirks = Quirks()
_frames_seen = 0
_configure = Picamera2.configure_
_get_metadata = CompletedRequest.get_metadata
_camera_controls = Picamera2.camera_controls.fget


def _configure_without_controls(self, config):
    config = dict(config)
    self.virtual_controls = config["controls"]
    self.virtual_size = config["main"]["size"]
    config["controls"] = {}
    return _configure(self, config)


def _controls_with_crop(self):
    crop = (0, 0, *getattr(self, "virtual_size", (640, 480)))
    return _camera_controls(self) | {"ScalerCrop": (crop, crop, crop)}


def _rounded_down(us):
    return int(int(us * 1000 / LINE_TIME_NS) * LINE_TIME_NS / 1000)


def _metadata_of_a_sensor(self):
    global _frames_seen
    _frames_seen += 1
    metadata = _get_metadata(self)
    told = getattr(self.picam2, "virtual_controls", None)
    if not told:
        return metadata
    metadata |= {
        "ExposureTime": _rounded_down(quirks.exposure_us or told["ExposureTime"]),
        "AnalogueGain": told["AnalogueGain"] * (1.0 + 0.003 * (_frames_seen % 2) * quirks.gain_wanders),
        "DigitalGain": 1.0,
        "ColourGains": told["ColourGains"],
        "FrameDuration": _rounded_down(told["FrameDurationLimits"][0]),
        "ScalerCrop": quirks.crop or (0, 0, *self.picam2.virtual_size),
    }
    metadata.pop(quirks.without, None)
    return metadata


Picamera2.configure_ = _configure_without_controls
Picamera2.camera_controls = property(_controls_with_crop)
CompletedRequest.get_metadata = _metadata_of_a_sensor
# As on a Pi 5: no hardware encoder. Here picamera2 would look for a Pi 4's.
encoders.H264Encoder = encoders.LibavH264Encoder
