"""The encoder's arguments: every one is given, on either kind of Pi."""

from fractions import Fraction
from types import SimpleNamespace
from typing import Any

from bricktrack_device.hardware.camera_settings import PiCameraSettings
from bricktrack_device.hardware.h264 import make_encoder

SETTINGS = PiCameraSettings(bitrate_bps=15_000_000, iperiod=10)


class LibavH264Encoder:
    def __init__(self, **arguments: Any) -> None:
        self.arguments = arguments
        self.preset: str | None = None
        self.threads = -1
        self.drop_final_frames = True


class V4l2H264Encoder:
    def __init__(self, **arguments: Any) -> None:
        self.arguments = arguments


PI_5 = SimpleNamespace(H264Encoder=LibavH264Encoder, LibavH264Encoder=LibavH264Encoder)
PI_4 = SimpleNamespace(H264Encoder=V4l2H264Encoder, LibavH264Encoder=LibavH264Encoder)


def test_a_pi_5_encodes_with_libx264_and_an_explicit_preset() -> None:
    encoder, name, told = make_encoder(SETTINGS, PI_5)
    assert name == "libx264"
    assert encoder.arguments == {
        "bitrate": 15_000_000, "repeat": True, "iperiod": 10, "framerate": 30, "qp": None, "profile": "high",
    }  # fmt: skip
    assert isinstance(encoder.arguments["framerate"], int)
    assert (encoder.preset, encoder.threads, encoder.drop_final_frames) == ("superfast", 0, False)
    assert told["preset"] == "superfast"
    assert str(told["libavcodec"]).count(".") == 2


def test_a_pi_4_encodes_in_hardware() -> None:
    encoder, name, told = make_encoder(SETTINGS, PI_4)
    assert name == "bcm2835-codec"
    assert encoder.arguments["enable_sps_framerate"] is False
    assert (told["class"], told["preset"], told["bitrate_bps"]) == ("H264Encoder", None, 15_000_000)
    assert told["kernel"]


def test_a_fixed_quantiser_takes_the_bit_rates_place() -> None:
    encoder, _, told = make_encoder(PiCameraSettings(qp=20), PI_4)
    assert (encoder.arguments["qp"], encoder.arguments["bitrate"]) == (20, None)
    assert (told["qp"], told["bitrate_bps"]) == (20, None)


def test_a_broken_frame_rate_is_a_fraction_for_libav_and_a_float_for_v4l2() -> None:
    settings = PiCameraSettings(frame_rate_hz=29.97)
    assert make_encoder(settings, PI_5)[0].arguments["framerate"] == Fraction(2997, 100)
    assert isinstance(make_encoder(settings, PI_4)[0].arguments["framerate"], float)
