"""Text files as other programs write them, and as they should not be."""

import numpy as np
import pytest

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.errors import ConfigError, RunFormatError, VideoError
from bricktrack_host.recordings.loose_files import read_edges_csv, read_imu_csv, read_rig, read_timestamps


@pytest.fixture
def write(tmp_path):
    def write(text, name="file.txt"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


@pytest.mark.parametrize(
    ("text", "expected_us"),
    [
        ("0\n33327\n66654\n", [0, 33327, 66654]),
        ("# made by hand\n\n0\n33327\n", [0, 33327]),
        ("# timecode format v2\n0.000\n33.327\n66.654\n", [0, 33327, 66654]),
        ("# timecode format v2\n0\n33\n67\n", [0, 33000, 67000]),
        ("0.000\r\n33.327\r\n", [0, 33327]),
        ("\ufeff0\n33327", [0, 33327]),
        ("99981\n133308\n", [99981, 133308]),
    ],
)
def test_stamps_in_both_units(write, text, expected_us):
    stamps = read_timestamps(write(text))
    assert stamps.dtype == np.int64
    assert stamps.tolist() == expected_us


def test_milliseconds_are_exact_where_floats_are_not(write):
    """1000 * 32.776 is 32775.999999999996 in binary."""
    assert read_timestamps(write("0.000\n32.776\n")).tolist() == [0, 32776]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no time stamps"),
        ("0\n33327\n33327\n", "line 3.*does not come after"),
        ("0\n33327\n20\n", "line 3.*does not come after"),
        ("0\nabc\n", "line 2.*'abc' is no number"),
        ("0\nnan\n", "line 2"),
        ("0\ninf\n", "line 2"),
        ("0\n33\n67\n", "µs apart.*--timestamps-unit"),
        ("0.0\n33327.0\n66654.0\n", "µs apart.*--timestamps-unit"),
    ],
)
def test_stamps_that_cannot_be_right_are_refused(write, text, words):
    with pytest.raises(VideoError, match=words):
        read_timestamps(write(text))


def test_the_unit_may_be_said(write):
    assert read_timestamps(write("0\n33\n67\n"), unit="ms").tolist() == [0, 33000, 67000]


IMU_HEADER = "t_ns,ax_mps2,ay_mps2,az_mps2,gx_dps,gy_dps,gz_dps\n"


def test_imu_rows_keep_every_nanosecond(write):
    """Nine times 10^15 and one is beyond the whole numbers that floats hold."""
    imu = read_imu_csv(write(IMU_HEADER + "9007199254740993,0.2,-9.53,0.25,-0.625,0.25,0.5\n"))
    assert imu.t_ns.tolist() == [9007199254740993]
    assert imu.acc_mps2.tolist() == [[0.2, -9.53, 0.25]]
    assert imu.gyro_dps.tolist() == [[-0.625, 0.25, 0.5]]


def test_columns_are_found_by_name_and_radians_turned(write):
    text = "gz_radps,note,t_ns,az_mps2,ay_mps2,ax_mps2,gx_radps,gy_radps\n3.141592653589793,x,5,3,2,1,0,0\n"
    imu = read_imu_csv(write(text))
    assert imu.acc_mps2.tolist() == [[1, 2, 3]]
    assert imu.gyro_dps[0] == pytest.approx([0, 0, 180])


def test_an_empty_value_is_a_missing_sample(write):
    imu = read_imu_csv(write(IMU_HEADER + "1,1,2,3,4,5,6\n2,,2,3,4,5,6\n3,1,2,3,4,nan,6\n"))
    assert np.isnan(imu.acc_mps2).all(axis=1).tolist() == [False, True, True]
    assert np.isnan(imu.gyro_dps).all(axis=1).tolist() == [False, True, True]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (IMU_HEADER, "no rows"),
        ("t_ns,ax_mps2\n1,2\n", "no column ay_mps2"),
        (
            IMU_HEADER.replace(",", ";") + "1;1,5;2;3;4;5;6\n",
            "parted by semicolons.*commas between.*points in",
        ),
        (IMU_HEADER.replace(",", "\t") + "1\t1\t2\t3\t4\t5\t6\n", "parted by tabs"),
        (IMU_HEADER + "1,1,2,3,4,5\n", "line 2: 6 fields"),
        (IMU_HEADER + "1,1,2,3,4,5,x\n", "line 2: 'x' is no number"),
        (IMU_HEADER + "1.5,1,2,3,4,5,6\n", "line 2: t_ns is '1.5'"),
        (IMU_HEADER + "2,1,2,3,4,5,6\n2,1,2,3,4,5,6\n", "line 3: t_ns 2 does not come after"),
    ],
)
def test_bad_imu_files_are_refused_with_the_line(write, text, words):
    with pytest.raises(RunFormatError, match=words):
        read_imu_csv(write(text))


def test_edges(write):
    assert read_edges_csv(write("t_ns\n5118514105508\n5118519102835\n")).tolist() == [
        5118514105508,
        5118519102835,
    ]
    with pytest.raises(RunFormatError, match="no column t_ns"):
        read_edges_csv(write("time\n1\n"))


RIG = """
simulated = true
[sensor]
width = 1920
height = 1080
exposure_us = 4000
line_time_us = 18.9035
[motion]
first_sensor_timestamp_ns = 5118442907613
[static]
first_sensor_timestamp_ns = 7
rolling_shutter = false
[trigger]
square_wave_hz = 200.0
[calibration]
anything = 1
"""


def test_a_rig_file_says_mode_exposure_and_start(write):
    rig = read_rig(write(RIG), table="motion")
    assert rig.mode.matches(IMX219_1080P)
    assert rig.mode.line_time_ns == pytest.approx(18903.5)
    assert (rig.exposure_us, rig.first_sensor_timestamp_ns) == (4000, 5118442907613)
    assert (rig.simulated, rig.square_wave_hz) == (True, 200.0)


def test_a_take_without_rolling_shutter_has_no_line_time(write):
    assert read_rig(write(RIG), table="static").mode.line_time_ns == 0


def test_another_size_is_read_from_the_sensors_corner(write):
    rig = read_rig(write(RIG.replace("1920", "1640").replace("1080", "1232")), table="motion")
    assert (rig.mode.crop_width, rig.mode.crop_height, rig.mode.crop_x) == (1640, 1232, 0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("exposure_us = 4000\n", ""), r"\[sensor\].*exposure_us"),
        (("exposure_us = 4000", "exposure_us = -1"), r"\[sensor\]: exposure_us"),
        (("exposure_us = 4000", "exposure_us = 4000\nexposure_ms = 4"), "exposure_ms"),
        (("[motion]", "[other]"), r"no table \[motion\]; --rig-table may be other, static"),
        (("simulated = true", "simulated = 'yes'"), "simulated"),
    ],
)
def test_a_wrong_rig_file_names_the_key(write, change, words):
    with pytest.raises(ConfigError, match=words):
        read_rig(write(RIG.replace(*change)), table="motion")


@pytest.mark.parametrize("text", ["1E100000", "-1E19", "NaN", "Infinity", "1e999999999"])
def test_a_stamp_beyond_all_time_is_refused_at_once(tmp_path, text):
    path = tmp_path / "stamps.txt"
    path.write_text(f"0\n{text}\n")
    with pytest.raises(VideoError, match="line 2"):
        read_timestamps(path)
