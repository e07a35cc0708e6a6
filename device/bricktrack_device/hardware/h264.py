"""The H.264 encoder of this Pi: in hardware where there is one, libx264 where not; every argument given."""

import importlib
import os
from fractions import Fraction
from typing import Any

from bricktrack_device.hardware.camera_settings import PiCameraSettings
from bricktrack_device.hardware.versions import installed

EncoderSettings = dict[str, str | int | float | bool | None]


def make_encoder(settings: PiCameraSettings, picamera2_encoders: Any) -> tuple[Any, str, EncoderSettings]:
    """Return an encoder that is not started, its name, and its settings for the manifest.

    ``H264Encoder`` is two different classes under one name, with different defaults, chosen by picamera2 from
    the platform; so no default is left.

    Parameters
    ----------
    settings : PiCameraSettings
    picamera2_encoders : module
        ``picamera2.encoders``.
    """
    is_software = picamera2_encoders.H264Encoder is picamera2_encoders.LibavH264Encoder
    rate = Fraction(settings.frame_rate_hz).limit_denominator(1000)
    framerate: int | float | Fraction = rate
    if rate.denominator == 1:
        framerate = int(rate)
    elif not is_software:
        framerate = float(rate)
    common: dict[str, Any] = {
        # A fixed quantiser and a bit rate exclude each other.
        "bitrate": settings.bitrate_bps if settings.qp is None else None,
        "repeat": True,
        "iperiod": settings.iperiod,
        "framerate": framerate,
        "qp": settings.qp,
        "profile": settings.profile,
    }
    told: EncoderSettings = {
        "bitrate_bps": common["bitrate"],
        "qp": settings.qp,
        "iperiod": settings.iperiod,
        "repeat_headers": True,
        "framerate_hz": float(rate),
        "profile": settings.profile,
    }
    if is_software:
        encoder = picamera2_encoders.H264Encoder(**common)
        encoder.preset = settings.preset
        encoder.threads = 0
        encoder.drop_final_frames = False
        told |= {"class": "LibavH264Encoder", "preset": settings.preset, "tune": "zerolatency", "threads": 0}
        told |= _libav_versions()
        return encoder, "libx264", told
    encoder = picamera2_encoders.H264Encoder(**common, enable_sps_framerate=False)
    told |= {"class": "H264Encoder", "preset": None, "kernel": os.uname().release}
    return encoder, "bcm2835-codec", told


def _libav_versions() -> EncoderSettings:
    # Not an import statement: PyAV comes with the Pi's picamera2 and must not become a dependency here.
    av = importlib.import_module("av")
    codec = av.library_versions.get("libavcodec", ())
    return {"pyav": installed("av") or av.__version__, "libavcodec": ".".join(str(n) for n in codec)}
