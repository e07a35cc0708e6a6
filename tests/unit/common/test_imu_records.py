import dataclasses
import struct

import msgspec
import numpy as np
import pytest

from bricktrack_common.errors import RunFormatError
from bricktrack_common.imu_records import (
    UNUSABLE,
    ImuDescription,
    ImuFlag,
    ImuRecord,
    decode_imu,
    read_imu,
    read_imu_samples,
    write_imu,
)

AMG = ImuDescription(
    name="led", chip_id="00" * 16, bus="sim", address=0x28, opr_mode=7, fusion=False, acc_range_g=16.0,
    period_ns=10_000_000, t0_ns=1_000_000_000,
)  # fmt: skip


def burst(i, acc=(0, 0, 981), gyro=(16, 0, 0), quaternion=(0, 0, 0, 0)):
    """Registers 0x08..0x35: counts, little-endian; the magnetometer counts up so that no two are equal."""
    words = (*acc, i, 0, 0, *gyro, 0, 0, 0, *quaternion, 0, 0, 0, 0, 0, 0)
    return struct.pack("<22hbB", *words, 25, 0x30)


def record(slot, data, errno=0, status=None):
    t = AMG.t0_ns + slot * AMG.period_ns + 100_000
    return ImuRecord(slot, t, t + 1_300_000, data, errno, status)


def decode(records, description=AMG):
    return decode_imu(description, records)


def test_registers_become_units():
    s = decode([record(0, burst(1, acc=(100, -200, 981), gyro=(160, -32, 16)))])
    np.testing.assert_allclose(s.acc_mps2, [[1.0, -2.0, 9.81]])
    np.testing.assert_allclose(np.rad2deg(s.gyro_radps), [[10.0, -2.0, 1.0]])
    assert s.t_ns.tolist() == [1_000_750_000]
    assert s.temperature_degc.tolist() == [25.0]
    assert s.calibration.tolist() == [0x30]
    assert s.flags.tolist() == [0]


def test_a_failed_read_and_a_skipped_slot_are_gaps_at_their_due_time():
    s = decode([record(0, burst(0)), record(1, None, errno=121), record(3, burst(3))])
    assert [bool(f & ImuFlag.GAP) for f in s.flags] == [False, True, True, False]
    assert np.isnan(s.acc_mps2[1:3]).all()
    assert s.t_ns[2] == AMG.t0_ns + 2 * AMG.period_ns


def test_a_read_that_outlasts_its_slot_is_a_gap_for_nobody_knows_when_it_was_measured():
    hung = dataclasses.replace(record(1, burst(1)), t_after_ns=AMG.t0_ns + 80 * AMG.period_ns)
    s = decode([record(0, burst(0)), hung, record(81, burst(81))])
    assert s.flags[1] == ImuFlag.GAP and np.isnan(s.acc_mps2[1:81]).all()
    assert (np.diff(s.t_ns) > 0).all()
    backwards = dataclasses.replace(hung, t_after_ns=hung.t_before_ns - 1)
    assert decode([backwards]).flags.tolist() == [ImuFlag.GAP]
    just_in_time = dataclasses.replace(hung, t_after_ns=hung.t_before_ns + AMG.period_ns)
    assert decode([just_in_time]).flags.tolist() == [0]


def test_reads_that_take_longer_than_a_short_slot_are_samples_of_every_second_slot():
    fast = msgspec.structs.replace(AMG, period_ns=4_000_000)
    starts = [fast.t0_ns + slot * fast.period_ns for slot in (0, 2, 4)]
    s = decode([ImuRecord(2 * i, t, t + 6_000_000, burst(i), 0, None) for i, t in enumerate(starts)], fast)
    assert [bool(f & ImuFlag.GAP) for f in s.flags] == [False, True, False, True, False]
    assert s.t_ns[::2].tolist() == [t + 3_000_000 for t in starts]


def test_an_equal_sample_is_kept_and_flagged_as_a_repeat():
    s = decode([record(0, burst(7)), record(1, burst(7)), record(2, burst(8))])
    assert s.flags.tolist() == [0, int(ImuFlag.REPEAT), 0]
    assert np.isfinite(s.acc_mps2).all()


def test_a_sensor_that_repeats_for_long_is_stuck_and_not_believed():
    s = decode([record(i, burst(7)) for i in range(15)])
    assert (s.flags[1:] & ImuFlag.STUCK != 0).all()
    assert np.isnan(s.acc_mps2[1:]).all()


def test_gaps_between_equal_samples_do_not_make_a_stuck_sensor_believed():
    # Every other slot is lost, as on a busy processor: by its neighbours alone no sample would be a repeat.
    s = decode([record(i, burst(i if i < 10 else 10)) for i in range(0, 50, 2)])
    held = np.arange(12, 49, 2)  # slot 10 is the last one that measured
    assert (s.flags[held] & (ImuFlag.STUCK | ImuFlag.REPEAT) == ImuFlag.STUCK | ImuFlag.REPEAT).all()
    assert np.isnan(s.acc_mps2[held]).all() and np.isfinite(s.acc_mps2[:12:2]).all()


def test_one_equal_sample_after_a_gap_is_a_repeat():
    s = decode([record(0, burst(7)), record(1, None, errno=121), record(2, burst(7)), record(3, burst(8))])
    assert s.flags.tolist() == [0, int(ImuFlag.GAP), int(ImuFlag.REPEAT), 0]


@pytest.mark.parametrize("byte", [0x00, 0xFF])
def test_blank_registers_are_not_zero_motion(byte):
    s = decode([record(0, bytes([byte]) * 46)])
    assert s.flags[0] & ImuFlag.BLANK
    assert np.isnan(s.gyro_radps).all()


def test_clipping_is_flagged_but_the_value_stays():
    s = decode([record(0, burst(0, acc=(15690, 0, 0), gyro=(0, 32000, 0)))])
    assert s.flags[0] == ImuFlag.ACC_CLIPPED | ImuFlag.GYRO_CLIPPED
    assert s.acc_mps2[0, 0] == 156.9


def test_a_flipped_top_bit_is_a_jump_and_an_impact_is_not():
    flipped = decode([record(0, burst(0)), record(1, burst(1, gyro=(-32752, 0, 0))), record(2, burst(2))])
    assert not flipped.flags[1] & ImuFlag.JUMP  # 2047 deg/s: no more than the sensor's own range allows
    flipped = decode([record(0, burst(0)), record(1, burst(1, acc=(0, 0, 981 - 32768))), record(2, burst(2))])
    assert flipped.flags[1] & ImuFlag.JUMP
    impact = decode([record(0, burst(0)), record(1, burst(1, acc=(15000, 0, 981))), record(2, burst(2))])
    assert impact.flags[1] == 0


def test_a_silent_reset_voids_the_samples_until_the_mode_is_right_again():
    ok, reset = bytes([0, 0, 7]), bytes([0, 0, 0])
    s = decode([
        record(0, burst(0), status=ok), record(1, burst(1), status=reset), record(2, burst(2)),
        record(3, burst(3), status=ok),
    ])  # fmt: skip
    assert [bool(f & ImuFlag.MODE_CHANGED) for f in s.flags] == [False, True, True, False]
    assert np.isnan(s.acc_mps2[1:3]).all()


def test_a_mode_holds_in_skipped_slots_and_until_the_end():
    ok, reset = bytes([0, 0, 7]), bytes([0, 0, 0])
    s = decode([
        record(5, burst(0), status=reset), record(8, burst(1)), record(9, burst(2), status=ok),
        record(10, burst(3), status=reset), record(12, burst(4)),
    ])  # fmt: skip
    changed = [bool(f & ImuFlag.MODE_CHANGED) for f in s.flags]
    assert changed == [True, True, True, True, False, True, True, True]


def test_a_torn_quaternion_is_not_believed_in_fusion_modes():
    ndof = ImuDescription(
        name="led", chip_id="", bus="sim", address=0x28, opr_mode=12, fusion=True, acc_range_g=4.0,
        period_ns=10_000_000, t0_ns=1_000_000_000,
    )  # fmt: skip
    s = decode(
        [
            record(0, burst(0, quaternion=(16384, 0, 0, 0))),
            record(1, burst(1, quaternion=(16384, 9000, 0, 0))),
        ],
        ndof,
    )
    np.testing.assert_allclose(s.q_wxyz[0], [1, 0, 0, 0])
    assert s.flags[1] & ImuFlag.BAD_QUATERNION
    assert np.isnan(s.q_wxyz[1]).all()


def test_every_unusable_sample_is_nan():
    rng = np.random.default_rng(3)
    records = [record(i, rng.bytes(46) if rng.random() > 0.2 else None) for i in range(300)]
    s = decode(records)
    unusable = s.flags & int(UNUSABLE) != 0
    assert unusable.any()
    np.testing.assert_array_equal(np.isnan(s.acc_mps2).any(axis=1), unusable)


def test_the_stream_survives_the_disk(tmp_path):
    records = [record(0, burst(0), status=b"\0\0\7"), record(1, None, errno=121), record(5, burst(5))]
    path = tmp_path / "imu_led.msgpack"
    with path.open("wb") as file:
        write_imu(file, AMG, records)
    assert read_imu(path) == (AMG, records, 0)
    description, samples, leftover = read_imu_samples(path)
    assert (description, leftover) == (AMG, 0)
    for field, values in dataclasses.asdict(decode(records)).items():
        np.testing.assert_array_equal(getattr(samples, field), values)


def test_numbers_beyond_64_bits_and_a_torn_grid_are_errors_and_no_arrays():
    with pytest.raises(RunFormatError, match="record 1: a number does not fit 64 bits"):
        decode([record(0, burst(0)), record(1 << 64, burst(1))])
    with pytest.raises(RunFormatError, match="2 records over 1000000001 slots; the grid is damaged"):
        decode([record(0, burst(0)), record(10**9, burst(1))])


def test_slots_out_of_order_and_short_bursts_are_refused(tmp_path):
    path = tmp_path / "imu_led.msgpack"
    for records, words in (
        ([record(1, burst(1)), record(1, burst(2))], "slot 1 of record 1 does not come after"),
        ([record(0, b"\0\0")], "record 0: 2 bytes; expected 46"),
    ):
        with path.open("wb") as file:
            write_imu(file, AMG, records)
        with pytest.raises(RunFormatError, match=words):
            read_imu(path)
