import pytest

from bricktrack_common.camera_model import IMX219_1080P, SensorMode

FULL_FIELD = SensorMode(
    name="imx219-1640x1232",
    width=1640,
    height=1232,
    crop_width=3280,
    crop_height=2464,
    binning=2,
    line_time_ns=18903.5,
)


def test_the_whole_picture_is_read_in_the_published_time():
    # read-out of IMX219 modes: 20.42 ms for 1080 rows, 23.29 ms for 1232 binned rows (kernel driver's line length)
    for mode, read_out_ms in ((IMX219_1080P, 20.42), (FULL_FIELD, 23.29)):
        rows_ms = (mode.row_delay_ns(mode.height - 0.5) - mode.row_delay_ns(-0.5)) / 1e6
        assert float(rows_ms) == pytest.approx(read_out_ms, abs=0.005)


def test_a_scaled_picture_keeps_the_time_of_its_sensor_rows():
    scaled = SensorMode(
        name="x", width=1920, height=1080, crop_width=3280, crop_height=1844, binning=2, line_time_ns=18903.5
    )
    # 1080 picture rows show 922 sensor rows: the centre of both is read at the same instant
    assert float(scaled.row_delay_ns(539.5)) == pytest.approx(460.5 * 18903.5)


def test_a_picture_flipped_after_read_out_is_read_from_below():
    flipped = SensorMode(
        name="x",
        width=1920,
        height=1080,
        crop_width=1920,
        crop_height=1080,
        line_time_ns=10.0,
        row_order="up",
    )
    assert flipped.row_delay_ns([0, 1079]).tolist() == [10790.0, 0.0]


def test_modes_match_by_field_and_not_by_name():
    renamed = SensorMode(
        name="other",
        width=1920,
        height=1080,
        crop_x=680,
        crop_y=692,
        crop_width=1920,
        crop_height=1080,
        line_time_ns=1,
    )
    assert renamed.matches(IMX219_1080P)
    assert not FULL_FIELD.matches(IMX219_1080P)
