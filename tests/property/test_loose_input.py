"""What comes from outside ends in values that hold together, or in an error of ours; never in another one."""

import contextlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bricktrack_common.errors import BricktrackError
from bricktrack_common.imu_records import decode_imu
from bricktrack_host.recordings.annex_b import split_access_units
from bricktrack_host.recordings.h264_headers import PictureOrder
from bricktrack_host.recordings.imu_import import import_imu
from bricktrack_host.recordings.loose_files import LooseImu, read_edges_csv, read_imu_csv, read_timestamps
from bricktrack_host.transfer.fleet_config import check_address

NAL_LIKE = st.lists(
    st.one_of(
        st.sampled_from([b"\0\0\1\x65\x88", b"\0\0\0\1\x67", b"\0\0\1\x41\x9a", b"\0\0\1", b"\0"]),
        st.binary(max_size=8),
    )
).map(b"".join)


@given(NAL_LIKE)
def test_access_units_cover_the_stream_without_gap_or_overlap(data):
    with contextlib.suppress(BricktrackError):
        units = split_access_units(data)
        assert units[0].byte_offset == 0
        ends = [u.byte_offset + u.n_bytes for u in units]
        assert ends == [*(u.byte_offset for u in units[1:]), len(data)]
        assert min(u.n_bytes for u in units) > 0


@given(st.lists(NAL_LIKE, max_size=5))
def test_the_order_of_any_bytes_can_be_asked(units):
    order = PictureOrder()
    for unit in units:
        assert order.check(unit)[0] in ("follows", "gap", "unreadable")


TEXT = st.one_of(
    st.text(max_size=80),
    st.lists(
        st.sampled_from(
            ["0", "33327", "-1", "1e9", "nan", "t_ns", ",", "\n", "#", "1.5", "9" * 30, "\0", '"']
        )
    ).map("".join),
    st.binary(max_size=60),
)


@pytest.mark.parametrize("read", [read_timestamps, read_imu_csv, read_edges_csv])
def test_any_text_is_read_or_refused(read, tmp_path_factory):
    path = tmp_path_factory.mktemp("text") / "file"

    @settings(max_examples=150)
    @given(TEXT)
    def check(text):
        path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8", "surrogatepass"))
        with contextlib.suppress(BricktrackError):
            read(path)

    check()


@given(st.text(max_size=40))
def test_any_address_is_accepted_or_refused(text):
    for address in (text, f"tcp://{text}", f"tcp://{text}:41733"):
        with contextlib.suppress(BricktrackError):
            check_address(address, where="here")


@settings(max_examples=60)
@given(
    n=st.integers(2, 40),
    period_ns=st.integers(1_000_000, 100_000_000),
    scale=st.floats(1e-6, 150),
    step=st.sampled_from([0.01, 1 / 16, 0.0]),
    seed=st.integers(0, 2**32 - 1),
)
def test_imported_samples_are_kept_to_half_a_register_step(n, period_ns, scale, step, seed):
    draw = np.random.default_rng(seed)
    acc, gyro = draw.uniform(-scale, scale, (2, n, 3))
    if step:
        acc, gyro = np.round(acc / step) * step, np.round(gyro / step) * step
    t_ns = 10**12 + np.arange(n, dtype=np.int64) * period_ns
    made = import_imu(LooseImu(t_ns, acc, gyro), name="brick")
    samples = decode_imu(made.description, made.records)
    good = np.isfinite(samples.acc_mps2).all(axis=1)  # what decoding calls stuck, blank or a jump is NaN
    assert samples.t_ns.tolist() == t_ns.tolist()
    half_acc, half_gyro = 0.5 / made.description.acc_lsb_per_mps2, 0.5 / made.description.gyro_lsb_per_dps
    assert np.abs(samples.acc_mps2 - acc)[good].max(initial=0) <= half_acc * (1 + 1e-9)
    assert np.abs(np.rad2deg(samples.gyro_radps) - gyro)[good].max(initial=0) <= half_gyro * (1 + 1e-9)
