import numpy as np
import pytest
from device_fakes import FakeCamera, FakeRig

from bricktrack_common.errors import HardwareError, ShapeError
from bricktrack_common.run_manifest import CameraSection
from bricktrack_device.config import DeviceConfig
from bricktrack_device.interfaces import EncodedPacket, FrameMetadata, FrameSink
from bricktrack_device.timing.start_estimate import estimate_start, initialisation_ms
from bricktrack_device.timing.start_test import evaluate_start, print_report, run_start_test

T_MS = 1000 / 30


def test_counting_frames_finds_the_papers_start_without_its_quantisation() -> None:
    # Many cameras that take 285.7 ms, sd 13.85; stopped at any phase. What counting adds is T^2 / 12.
    rng = np.random.default_rng(28)
    true_ms = rng.normal(285.7, 13.85, 4000)
    window_ms = 15_000 + rng.uniform(0, T_MS, 4000)
    counts = np.floor((window_ms - true_ms) / T_MS).astype(int) + 1
    found = estimate_start(
        [initialisation_ms(w, n, T_MS) for w, n in zip(window_ms, counts, strict=True)], T_MS
    )
    # 4000 runs: the mean to 17 / sqrt(4000) = 0.27 ms, the deviation to 1.1 %; three times that.
    assert found.mean_ms == pytest.approx(285.7, abs=0.8)
    assert found.sd_ms == pytest.approx((13.85**2 + T_MS**2 / 12) ** 0.5, rel=0.035)
    assert found.sd_ms == pytest.approx(16.86, rel=0.035)
    assert found.sd_corrected_ms == pytest.approx(13.85, rel=0.05)
    assert found.mean_standard_error_ms == pytest.approx(found.sd_ms / 4000**0.5)


def test_a_spread_below_that_of_counting_is_zero_and_not_negative() -> None:
    assert estimate_start([100.0, 100.1, 99.9], T_MS).sd_corrected_ms == 0.0


@pytest.mark.parametrize("values", [[], [1.0], [1.0, float("nan")]])
def test_too_few_or_bad_values_are_refused(values: list[float]) -> None:
    with pytest.raises(ShapeError, match="expected two or more finite"):
        estimate_start(values, T_MS)


def test_one_start_is_read_from_its_stamps() -> None:
    # Command at 1 s, first frame 300 ms later, a frame every 40 ms, window 1 s: 18 frames by 1.98 s.
    stamps = [1_300_000_000 + k * 40_000_000 for k in range(30)]
    start = evaluate_start(
        stamps, first_packet_us=1_500_000, command_ns=1_000_000_000, window_ns=1_000_000_000,
        period_ns=40_000_000,
    )  # fmt: skip
    assert (start.first_frame_ms, start.first_packet_ms, start.n_frames) == (300.0, 500.0, 18)
    assert start.counted_ms == 1000 - 17.5 * 40 and abs(start.counted_ms - start.first_frame_ms) <= 20


# Lost in the middle, two in a row, and at the end of the window of 1 s, which holds frames 0 to 17.
@pytest.mark.parametrize("lost", [{12}, {3, 4, 9}, {16, 17}, {17, 18, 19}, set(range(1, 17, 2))])
def test_lost_frames_are_counted_by_the_gaps_that_they_left(lost: set[int]) -> None:
    stamps = [1_300_000_000 + k * 40_000_000 for k in range(30) if k not in lost]
    start = evaluate_start(
        stamps, first_packet_us=0, command_ns=1_000_000_000, window_ns=1_000_000_000, period_ns=40_000_000
    )
    assert (start.n_frames, start.n_lost) == (18, len(lost & set(range(18))))
    assert (start.counted_ms, start.period_ms) == (1000 - 17.5 * 40, 40.0)


def test_more_than_half_lost_or_stamps_off_the_grid_say_nothing() -> None:
    few = [k * 40_000_000 for k in range(30) if k % 3 == 0]
    with pytest.raises(HardwareError, match="17 of 26 frames were lost; at most 50 %"):
        evaluate_start(few, first_packet_us=0, command_ns=0, window_ns=10**9, period_ns=40_000_000)
    wandering = [k * 40_000_000 + (k == 7) * 15_000_000 for k in range(30)]
    with pytest.raises(HardwareError, match="55.00 ms apart; expected multiples of 40.00 ms"):
        evaluate_start(wandering, first_packet_us=0, command_ns=0, window_ns=10**9, period_ns=40_000_000)
    with pytest.raises(HardwareError, match="1 frames in 10 ms"):
        evaluate_start(few, first_packet_us=0, command_ns=0, window_ns=10**7, period_ns=40_000_000)


class EveryThirdLost:
    """A sink that loses frames on their way to another."""

    def __init__(self, sink: FrameSink) -> None:
        self.sink, self.n = sink, 0

    def on_metadata(self, metadata: FrameMetadata) -> None:
        self.n += 1
        if self.n % 3:
            self.sink.on_metadata(metadata)

    def on_packet(self, packet: EncodedPacket) -> None:
        if self.n % 3:
            self.sink.on_packet(packet)


class LossyCamera(FakeCamera):
    def start(self, sink: FrameSink) -> CameraSection:
        return super().start(EveryThirdLost(sink))


def test_a_camera_that_loses_every_third_frame_still_gives_its_start_time(
    capsys: pytest.CaptureFixture[str],
) -> None:
    result = run_start_test(DeviceConfig(backend="sim"), FakeRig(camera=LossyCamera()), n_runs=2)
    v = result.values
    # A count tells the start to a fraction of a period, whatever was lost.
    assert all(abs(c - f) < 34 for c, f in zip(v["counted_ms"], v["first_frame_ms"], strict=True))
    assert 0.25 < result.settings["frames_lost"] / result.settings["frames"] < 0.4
    print_report(result)
    assert "frames were lost" in capsys.readouterr().out


def test_a_test_of_two_starts_runs_and_reports(capsys: pytest.CaptureFixture[str]) -> None:
    camera = FakeCamera()
    result = run_start_test(DeviceConfig(backend="sim"), FakeRig(camera=camera), n_runs=2)
    assert camera.n_stops == 2 and result.simulated
    v = result.values
    assert all(abs(c - f) < 34 for c, f in zip(v["counted_ms"], v["first_frame_ms"], strict=True))
    assert 0 <= v["first_frame_ms"][0] < 100
    print_report(result)
    said = capsys.readouterr().out
    assert "SIMULATED" in said and "285.7" in said


def test_a_camera_that_does_not_start_fails_the_test() -> None:
    with pytest.raises(HardwareError, match="no cable"):
        run_start_test(DeviceConfig(backend="sim"), FakeRig(camera=FakeCamera(fail="no cable")), n_runs=4)
