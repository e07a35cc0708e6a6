import errno
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from device_fakes import FakeBus, FakeBusOpener, FakeRig

from bricktrack_common.errors import HardwareError
from bricktrack_common.imu_records import ImuRecord
from bricktrack_device.config import DeviceConfig, ImuTable, SamplerTable
from bricktrack_device.inertial.imu_sampler import sample
from bricktrack_device.timing import loops
from bricktrack_device.timing.imu_test import choose_imu, print_report, run_imu_test
from bricktrack_device.timing.loops import Block, adaptive_loop, naive_loop, plan_blocks, run_block
from bricktrack_device.timing.result_file import to_json
from bricktrack_device.timing.slot_statistics import accumulated_ms, drift_ppm, figures_of
from bricktrack_device.timing.text_histogram import text_histogram

PERIOD = 10_000_000
IMU = ImuTable(name="brick", bus="a")


class Clock:
    """Time that passes by sleeping, and 1.5 ms by each burst."""

    def __init__(self) -> None:
        self.now = 0

    def __call__(self) -> int:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += round(seconds * 1e9) + 60_000  # a wake-up is 60 us late

    def sleep_until(self, due_ns: int) -> None:
        self.sleep(max(due_ns - self.now, 0) * 1e-9)

    def bus(self) -> FakeBus:
        clock = self

        class Slow(FakeBus):
            def read_burst(self, address: int, register: int, n_bytes: int) -> bytes:
                clock.now += 1_500_000
                return super().read_burst(address, register, n_bytes)

        return Slow()


def block(
    t_before_ns: list[int], slots: list[int] | None = None, *, t0: int = 0, n: int | None = None
) -> Block:
    slots = slots or list(range(len(t_before_ns)))
    records = [
        ImuRecord(s, t, t + 1_500_000, s.to_bytes(46, "little"), 0, None)
        for s, t in zip(slots, t_before_ns, strict=True)
    ]
    return Block("grid", t0, n or len(records), records)


def test_the_naive_loop_is_late_by_all_that_it_does_not_sleep() -> None:
    clock, records = Clock(), []
    naive_loop(clock.bus(), IMU, 100, records.append, sleep=clock.sleep, clock=clock)  # type: ignore[arg-type]
    # 10 ms of sleep, 1.5 of bus, 0.06 of waking up: by hand.
    assert {b.t_before_ns - a.t_before_ns for a, b in pairwise(records)} == {11_560_000}
    found = figures_of([Block("naive", 0, 100, records)], PERIOD)
    assert found["drift_ppm"] == pytest.approx(156_000, rel=1e-9)
    assert found["accumulated_drift_ms"] == pytest.approx(99 * 1.56)
    assert found["bus_time_us_p50"] == 1500


def test_the_adaptive_loop_is_late_by_what_it_does_not_measure() -> None:
    clock, records = Clock(), []
    adaptive_loop(clock.bus(), IMU, 100, records.append, sleep=clock.sleep, clock=clock)  # type: ignore[arg-type]
    assert {b.t_before_ns - a.t_before_ns for a, b in pairwise(records)} == {10_060_000}


def test_a_read_that_fails_is_a_record_with_its_errno() -> None:
    clock, records = Clock(), []
    bus = FakeBus(fail_every=4)
    naive_loop(bus, IMU, 8, records.append, sleep=clock.sleep, clock=clock)
    assert [r.errno for r in records] == [0, 0, 0, errno.EREMOTEIO] * 2
    figures = figures_of([Block("naive", 0, 8, records)], PERIOD)
    assert figures["failed_by_errno"] == {"EREMOTEIO": 2} and figures["failed_reads"] == 2


def test_lateness_that_scatters_is_no_drift() -> None:
    rng = np.random.default_rng(5)
    late = rng.exponential(80_000, 3000).astype(int)
    b = block([k * PERIOD + int(d) for k, d in enumerate(late)])
    slope, error = drift_ppm([b], PERIOD)
    # Standard error of a slope: sd / (T sqrt(n / 12)) = 80 us / (30 s * 15.8).
    assert error == pytest.approx(80 / (30 * np.sqrt(3000 / 12)), rel=0.1)
    assert abs(slope) < 4 * error


def test_a_grid_that_runs_slow_is_found_across_its_blocks() -> None:
    # Each block is on the grid by itself but for 20 ppm; 5 us in a block, 600 us over the test.
    blocks = []
    for i in range(30):
        t0 = i * 100 * PERIOD
        blocks.append(block([round((t0 + k * PERIOD) * (1 + 20e-6)) for k in range(25)], t0=t0))
    assert drift_ppm(blocks, PERIOD)[0] == pytest.approx(20, rel=1e-3)
    assert accumulated_ms(blocks, PERIOD) == pytest.approx(30 * 24 * 10 * 20e-6, rel=1e-2)


def test_lost_slots_and_repeats_are_counted() -> None:
    b = block([0, PERIOD, 4 * PERIOD, 5 * PERIOD], [0, 1, 4, 5], n=6)
    same = ImuRecord(6, 6 * PERIOD, 6 * PERIOD + 1, b.records[-1].data, 0, None)
    figures = figures_of([Block("grid", 0, 7, [*b.records, same])], PERIOD)
    assert figures["slots_lost"] == 2 and figures["repeats"] == 1
    # Five reads in seven slots of 10 ms, four of them new.
    assert figures["rate_hz"] == pytest.approx(5 / 0.07) and figures["unique_rate_hz"] == pytest.approx(
        4 / 0.07
    )


@pytest.mark.parametrize(("stop_ns", "slots"), [(0, [*range(20)]), (35_000_000, [*range(8), *range(11, 20)])])
def test_a_block_of_the_grid_has_its_slots_and_ends(
    monkeypatch: pytest.MonkeyPatch, stop_ns: int, slots: list[int]
) -> None:
    clock = Clock()

    class Stops(FakeBus):
        def read_burst(self, address: int, register: int, n_bytes: int) -> bytes:
            clock.now += stop_ns if self.n_bursts == 7 and n_bytes == 46 else 0
            return super().read_burst(address, register, n_bytes)

    monkeypatch.setattr(loops, "monotonic_ns", clock)
    monkeypatch.setattr(loops, "sample", partial(sample, clock=clock, sleep_until=clock.sleep_until))
    got = run_block(Stops(), IMU, "grid", 20)
    assert got.n_slots == 20 and got.t0_ns % PERIOD == 0
    assert [r.slot for r in got.records] == slots
    # A wake-up is 60 us late, and the grid does not shift when the bus has stood still for 35 ms.
    assert {r.t_before_ns - got.t0_ns - r.slot * PERIOD for r in got.records} == {60_000}


def test_methods_take_turns() -> None:
    plan = plan_blocks(500, ("grid", "naive", "adaptive"), block_slots=250)
    assert [m for m, _ in plan] == ["grid", "naive", "adaptive"] * 2
    assert {m: sum(n for k, n in plan if k == m) for m, _ in plan} == dict.fromkeys(
        ("grid", "naive", "adaptive"), 500
    )


def test_both_kinds_of_test_run_on_a_rig_and_say_what_they_found(capsys: pytest.CaptureFixture[str]) -> None:
    config = DeviceConfig(backend="sim", imu=[IMU], sampler=SamplerTable(lock_memory=False))
    rig = FakeRig(buses={"a": FakeBusOpener()})
    for compare in (False, True):
        result = run_imu_test(config, rig, name=None, n_slots=60, compare=compare)
        assert set(result.figures) == ({"grid", "naive", "adaptive"} if compare else {"grid"})
        grid = result.figures["grid"]
        assert grid["slots"] == 60 and grid["reads"] + grid["slots_lost"] == 60 and grid["failed_reads"] == 0
        assert len(result.values["grid_lateness_us"]) == grid["reads"]
        assert min(result.values["grid_lateness_us"]) >= 0
        print_report(result)
        assert "SIMULATED" in capsys.readouterr().out
        assert '"tool": "imu-test"' in to_json(result)


def test_a_missing_sensor_is_told_in_words() -> None:
    config = DeviceConfig(backend="sim", imu=[IMU])
    with pytest.raises(HardwareError, match="no inertial sensor 'other' is configured; there are: brick"):
        choose_imu(config, "other")
    rig = FakeRig(buses={"a": FakeBusOpener(present=False)})
    with pytest.raises(HardwareError, match="0x28"):
        run_imu_test(config, rig, name=None, n_slots=100, compare=True)


def test_a_histogram_counts_what_lies_outside() -> None:
    lines = text_histogram([-1, 0.5, 1.5, 1.5, 9, float("nan")], unit="us", n_bins=2, limits=(0, 2))
    assert lines[0] == "below 0 us: 1" and lines[-1] == "above 2 us: 1"
    assert lines[1].endswith(" 1") and lines[2].endswith(" 2") and lines[2].count("█") == 40
    assert text_histogram([float("nan")], unit="us") == ["no values"]
