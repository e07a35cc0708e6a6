"""What a camera's frames must say before it counts as started. Numbers are an IMX219's, by hand."""

from itertools import count

import pytest

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.errors import HardwareError
from bricktrack_device.hardware.camera_checks import (
    ControlsCheck,
    FrameReport,
    check_configuration,
    check_frame_rate,
    read_report,
    sensor_mode,
)
from bricktrack_device.hardware.camera_settings import MODES, PiCameraSettings

SETTINGS = PiCameraSettings()
LINE_US = 18.9035
# 2000 us are 105 whole lines, 1984.87 us; 33333 us are 1763 lines, 33326.9 us; libcamera drops fractions.
METADATA = {
    "SensorTimestamp": 5_000_000_000,
    "ExposureTime": 1984,
    "AnalogueGain": 1.0,
    "DigitalGain": 1.0076,
    "ColourGains": (1.5, 1.5),
    "FrameDuration": 33326,
    "ScalerCrop": (680, 692, 1920, 1080),
}


def report(**changes: object) -> FrameReport:
    metadata = METADATA | changes
    return read_report(metadata, arrival_ns=int(str(metadata["SensorTimestamp"])) + 40_000_000)


def judged(*reports: FrameReport, settings: PiCameraSettings = SETTINGS) -> ControlsCheck:
    check = ControlsCheck(settings, LINE_US)
    for r in reports:
        check.add(r)
    return check


def test_frames_that_hold_the_controls_are_steady_after_enough_of_them() -> None:
    assert not judged(*[report()] * 14).steady
    check = judged(*[report()] * 15)
    assert check.steady
    check.require_steady()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"ExposureTime": 1964}, "exposure is 1964 µs, wanted 2000 µs"),  # one line less than it must be
        ({"ExposureTime": 2004}, "exposure is 2004 µs, wanted 2000 µs"),
        ({"AnalogueGain": 1.1}, "analogue gain is 1.1, wanted 1"),
        ({"FrameDuration": 40000}, "frame period is 40000 µs, wanted 33333 µs"),
        ({"ColourGains": (1.5, 2.0)}, r"colour gains are \(1.5, 2.0\), wanted \(1.5, 1.5\)"),
    ],
)
def test_a_control_that_is_not_held_is_told_with_both_values(changes: dict[str, object], words: str) -> None:
    check = judged(*[report(**changes)] * 60)
    assert not check.steady
    with pytest.raises(HardwareError, match=rf"after 60 frames not 15 in a row.*{words}.*Choose values"):
        check.require_steady()


def test_the_first_frames_after_a_start_may_be_wrong() -> None:
    check = judged(*[report(ExposureTime=100)] * 3, *[report()] * 15)
    assert check.steady
    assert len(check.reports) == 15


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"AnalogueGain": 1.004}, "analogue_gain from"),
        ({"DigitalGain": 1.02}, "digital_gain from"),
        ({"ScalerCrop": (680, 690, 1920, 1080)}, "scaler crop from"),
    ],
)
def test_values_that_wander_within_their_tolerance_are_refused(
    changes: dict[str, object], words: str
) -> None:
    check = judged(*[report(), report(**changes)] * 40)
    with pytest.raises(HardwareError, match=f"the values wander: {words}"):
        check.require_steady()


def test_the_gain_of_an_imx219_may_be_a_step_off() -> None:
    # Code 230 gives 256 / 26 = 9.846, code 231 gives 256 / 25 = 10.24: neither is 10.
    settings = PiCameraSettings(analogue_gain=10.0)
    assert judged(*[report(AnalogueGain=256 / 26)] * 15, settings=settings).steady
    assert not judged(*[report(AnalogueGain=256 / 23)] * 15, settings=settings).steady


@pytest.mark.parametrize("age_ns", [-1, 1_100_000_000])
def test_a_stamp_of_another_clock_is_refused(age_ns: int) -> None:
    stamped = read_report(METADATA, arrival_ns=METADATA["SensorTimestamp"] + age_ns)
    with pytest.raises(HardwareError, match="not on CLOCK_MONOTONIC"):
        judged(stamped).require_steady()


def test_no_frame_at_all_is_told() -> None:
    with pytest.raises(HardwareError, match="after 0 frames.*no frame came"):
        judged().require_steady()


def test_metadata_without_an_exposure_are_refused() -> None:
    with pytest.raises(HardwareError, match="frames come without ExposureTime"):
        read_report({k: v for k, v in METADATA.items() if k != "ExposureTime"}, arrival_ns=0)


def frames_every(period_ns: int, n: int = 16) -> list[FrameReport]:
    return [report(SensorTimestamp=t) for _, t in zip(range(n), count(10**9, period_ns), strict=False)]


def test_frames_must_come_as_often_as_they_say() -> None:
    check_frame_rate(frames_every(33_326_870), tolerance=0.01)
    with pytest.raises(HardwareError, match="frames come every 40000 µs, but their metadata say 33326 µs"):
        check_frame_rate(frames_every(40_000_000), tolerance=0.01)


def test_single_dropped_frames_do_not_make_another_rate() -> None:
    frames = frames_every(33_326_870)
    check_frame_rate(frames[:4] + frames[5:9] + frames[11:], tolerance=0.01)


FOUND = {
    "main": {"size": (1920, 1080), "format": "YUV420"},
    "sensor": {"output_size": (1920, 1080), "bit_depth": 10},
}


def test_a_configuration_taken_as_asked_for_passes() -> None:
    check_configuration(FOUND, SETTINGS)
    check_configuration(FOUND | {"sensor": None}, SETTINGS)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"main": {"size": (1920, 1072), "format": "YUV420"}}, r"picture size is \(1920, 1072\), wanted"),
        ({"main": {"size": (1920, 1080), "format": "NV12"}}, "picture format is NV12, wanted YUV420"),
        ({"sensor": {"output_size": (1640, 1232), "bit_depth": 10}}, r"sensor output is \(1640, 1232\)"),
        ({"sensor": {"output_size": (1920, 1080), "bit_depth": 8}}, "bit depth is 8, wanted 10"),
    ],
)
def test_an_adjusted_configuration_is_refused(changes: dict[str, object], words: str) -> None:
    with pytest.raises(HardwareError, match=words):
        check_configuration(FOUND | changes, SETTINGS)


def test_the_centre_crop_is_the_mode_that_calibrations_are_made_for() -> None:
    crop = (680, 692, 1920, 1080)
    mode = sensor_mode(
        model="imx219", settings=SETTINGS, mode_crop=crop, scaler_crop=crop, line_time_ns=18903.5
    )
    assert mode == IMX219_1080P


def test_the_full_field_is_binned_by_two_and_its_rows_take_23_ms() -> None:
    crop = (0, 0, 3280, 2464)
    mode = sensor_mode(
        model="imx219",
        settings=PiCameraSettings(mode=MODES["full-field"]),
        mode_crop=crop,
        scaler_crop=crop,
        line_time_ns=3448 / 182.4e6 * 1e9,
    )
    assert (mode.name, mode.binning) == ("imx219-1640x1232-full", 2)
    # 1231 line times from the first to the last row: 23.27 ms.
    assert mode.row_delay_ns(1231) - mode.row_delay_ns(0) == pytest.approx(1231 * 18903.5088, rel=1e-8)


def test_a_picture_cut_out_of_its_mode_has_no_simple_row_times() -> None:
    with pytest.raises(HardwareError, match="its rows have no simple times"):
        sensor_mode(
            model="imx219", settings=SETTINGS, mode_crop=(0, 0, 3280, 2464),
            scaler_crop=(0, 309, 3280, 1845), line_time_ns=18903.5,
        )  # fmt: skip


def test_a_sensor_that_scales_unevenly_is_refused() -> None:
    crop = (0, 0, 2880, 1080)
    with pytest.raises(HardwareError, match="reads 2880x1080 px into 1920x1080 px"):
        sensor_mode(model="imx708", settings=SETTINGS, mode_crop=crop, scaler_crop=crop, line_time_ns=1e4)


def test_all_controls_go_in_one_call_with_automatics_off() -> None:
    controls = PiCameraSettings(frame_rate_hz=25, exposure_us=1500).controls("off")
    assert controls == {
        "AeEnable": False,
        "ExposureTime": 1500,
        "AnalogueGain": 1.0,
        "AwbEnable": False,
        "ColourGains": (1.5, 1.5),
        "FrameDurationLimits": (40000, 40000),
        "NoiseReductionMode": "off",
    }
