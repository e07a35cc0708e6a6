import gc

import pytest
from gpiozero.pins.mock import MockFactory, MockPin

from bricktrack_common.errors import HardwareError
from bricktrack_device.capture.first_edge import FirstEdgeFinder
from bricktrack_device.capture.trigger import Trigger
from bricktrack_device.config import TriggerTable

MS = 1_000_000


class Line:
    """A mock pin whose edges are stamped by hand: the clock stands at the stamp when it is reported."""

    def __init__(self, **settings: object) -> None:
        self.now_ns = 5_000 * MS
        self.factory = MockFactory()
        self.pin: MockPin = self.factory.pin("GPIO17")
        self.n_first = 0
        self.trigger = Trigger(self.factory, TriggerTable(**settings), clock=lambda: self.now_ns)  # type: ignore[arg-type]

    def arm(self) -> int:
        return self.trigger.arm(self._count)

    def _count(self) -> None:
        self.n_first += 1

    def edge(self, t_ns: int, level: int, *, reported_ns: int | None = None) -> None:
        """Report a change as gpiozero does: through the pin's weak reference, ticks in seconds."""
        self.now_ns = t_ns if reported_ns is None else reported_ns
        method = self.pin.when_changed
        assert method is not None
        method(t_ns / 1e9, level)


def test_the_first_rising_edge_after_arming_is_t0_and_all_later_ones_are_logged() -> None:
    line = Line()
    t = line.arm()
    for k in range(5):
        line.edge(t + (10 + 20 * k) * MS, 1)
        line.edge(t + (20 + 20 * k) * MS, 0)
    train = line.trigger.disarm()
    assert train.t0_ns == t + 10 * MS
    assert train.edges_ns == [t + (10 + 20 * k) * MS for k in range(5)]
    assert (train.n_ignored, train.problems, line.n_first) == (0, [], 1)


def test_real_mock_pin_changes_arrive_through_the_hook() -> None:
    factory = MockFactory()
    trigger = Trigger(factory, TriggerTable())
    hits: list[int] = []
    trigger.arm(lambda: hits.append(1))
    pin = factory.pin("GPIO17")
    pin.drive_high()
    pin.drive_low()
    pin.drive_high()
    assert hits == [1] and trigger.n_edges == 2 and trigger.line_is_high is True
    trigger.close()
    assert trigger.line_is_high is None


def test_a_line_high_at_arming_must_go_low_first() -> None:
    line = Line()
    line.pin.drive_high()
    t = line.arm()
    line.edge(t + 1 * MS, 1)  # a lost falling edge: the level was never seen low
    assert line.trigger.t0_ns is None
    line.edge(t + 5 * MS, 0)
    line.edge(t + 15 * MS, 1)
    train = line.trigger.snapshot()
    assert train.t0_ns == t + 15 * MS and train.n_ignored == 1


def test_without_require_low_the_next_rising_edge_counts() -> None:
    line = Line(require_low=False)
    line.pin.drive_high()
    t = line.arm()
    line.edge(t + 1 * MS, 1)
    assert line.trigger.t0_ns == t + 1 * MS


def test_an_edge_stamped_before_arming_but_reported_after_does_not_count() -> None:
    line = Line()
    t = line.arm()
    line.edge(t - 1, 1, reported_ns=t + MS)
    line.edge(t + 4 * MS, 0)
    line.edge(t + 14 * MS, 1)
    assert line.trigger.snapshot().t0_ns == t + 14 * MS


def test_a_quiet_gap_skips_the_pulses_that_come_too_soon() -> None:
    line = Line(quiet_gap_ms=30.0)
    t = line.arm()
    line.edge(t + 10 * MS, 1)  # 10 ms after arming
    line.edge(t + 20 * MS, 0)
    line.edge(t + 49 * MS, 1)  # 29 ms quiet
    line.edge(t + 55 * MS, 0)
    line.edge(t + 85 * MS, 1)  # 30 ms quiet
    train = line.trigger.snapshot()
    assert (train.t0_ns, train.n_ignored) == (t + 85 * MS, 2)


def test_a_stamp_off_the_monotonic_clock_is_refused_in_words() -> None:
    line = Line()
    t = line.arm()
    line.edge(t + 60_000 * MS, 1, reported_ns=t + 1 * MS)  # a real-time or foreign clock
    line.edge(t + 2 * MS, 1)
    train = line.trigger.snapshot()
    assert train.t0_ns == t + 2 * MS
    assert len(train.problems) == 1 and "CLOCK_MONOTONIC" in train.problems[0]


def test_edges_that_a_unit_hears_of_after_it_stood_still_for_seconds_count() -> None:
    line = Line()
    t = line.arm()
    for k in range(3):
        line.edge(t + (10 + 20 * k) * MS, 1, reported_ns=t + 4000 * MS)
    stale = t - 3000 * MS
    line.edge(stale, 0, reported_ns=t + 4000 * MS)  # from before it was armed, or of another clock
    train = line.trigger.disarm()
    assert train.edges_ns == [t + (10 + 20 * k) * MS for k in range(3)]
    assert len(train.problems) == 1 and "1 edges have stamps up to 7.000 s off" in train.problems[0]


def test_a_late_callback_keeps_the_kernels_stamp() -> None:
    line = Line()
    t = line.arm()
    line.edge(t + 10 * MS, 1, reported_ns=t + 400 * MS)
    assert line.trigger.t0_ns == t + 10 * MS


def test_edges_out_of_order_are_left_out_and_counted() -> None:
    line = Line()
    t = line.arm()
    for at in (10, 30, 20, 50):
        line.edge(t + at * MS, 1)
    train = line.trigger.snapshot()
    assert train.edges_ns == [t + 10 * MS, t + 30 * MS, t + 50 * MS]
    assert "1 edges were stamped before" in train.problems[0]


def test_arming_again_forgets_the_train_before() -> None:
    line = Line()
    t = line.arm()
    line.edge(t + 1 * MS, 1)
    line.edge(t + 2 * MS, 0)
    line.now_ns = t + 100 * MS
    again = line.arm()
    assert line.trigger.t0_ns is None
    line.edge(again + 1 * MS, 1)
    assert line.trigger.snapshot().edges_ns == [again + 1 * MS] and line.n_first == 2


def test_the_hook_lives_as_long_as_the_trigger_and_no_longer() -> None:
    line = Line()
    t = line.arm()
    gc.collect()
    line.edge(t + 1 * MS, 1)
    assert line.n_first == 1
    del line.trigger
    gc.collect()
    assert line.pin.when_changed is None  # gpiozero holds it weakly
    line.pin.drive_low()


def test_half_an_hour_of_ticks_in_float_seconds_keeps_nanoseconds() -> None:
    # Ticks come as float seconds: after 12 days of uptime (1e6 s) a float still resolves 0.12 ns.
    line = Line()
    line.now_ns = 1_000_000 * 10**9
    t = line.arm()
    line.edge(t + 123_456_789, 1)
    assert line.trigger.t0_ns == t + 123_456_789


def test_a_pin_that_does_not_exist_is_a_hardware_error_naming_it() -> None:
    with pytest.raises(HardwareError, match="GPIO99"):
        Trigger(MockFactory(), TriggerTable(pin="GPIO99"))


def wave(line: Line, start_ns: int, n: int, *, period_ns: int = 20 * MS) -> list[int]:
    rises = [start_ns + k * period_ns for k in range(n)]
    for t in rises:
        line.edge(t, 1)
        line.edge(t + period_ns // 2, 0)
    return rises


def test_with_a_known_period_a_glitch_before_the_wave_is_kept_apart() -> None:
    line = Line(nominal_hz=50.0)
    t = line.arm()
    line.edge(t + 500 * MS, 1)
    line.edge(t + 501 * MS, 0)
    assert line.trigger.t0_ns is None and line.n_first == 0 and line.trigger.n_edges == 0
    rises = wave(line, t + 777 * MS, 2)
    assert line.trigger.t0_ns is None  # provisional until a third edge
    rises += wave(line, t + 817 * MS, 8)
    train = line.trigger.snapshot()
    assert train.t0_ns == rises[0] and train.edges_ns == rises and line.n_first == 1
    assert (train.n_ignored, train.rejected_ns) == (1, [t + 500 * MS])


def test_a_minute_at_1_khz_is_logged_without_a_loss() -> None:
    line = Line(nominal_hz=1000.0)
    rises = wave(line, line.arm() + 5 * MS, 60_000, period_ns=MS)
    assert line.trigger.snapshot().edges_ns == rises


def test_a_line_that_is_stuck_high_is_said_with_how_long() -> None:
    line = Line()
    line.pin.drive_high()
    t = line.arm()
    line.now_ns = t + 90_000 * MS
    words = line.trigger.waiting_words()
    assert "armed for 90 s and the line was high all the time" in words and "goes low" in words


def test_a_line_that_is_stuck_low_stays_armed_and_says_how_long() -> None:
    line = Line(nominal_hz=50.0)
    t = line.arm()
    line.now_ns = t + 3600_000 * MS
    assert line.trigger.waiting_words() == "armed for 3600 s; the line is low, unchanged for 3600 s"
    line.edge(t + 3600_000 * MS, 1)
    line.now_ns += 2000 * MS
    assert "an edge 2.0 s ago waits for others in step" in line.trigger.waiting_words()
    wave(line, line.now_ns, 3)
    assert line.trigger.waiting_words() == ""


def test_an_error_never_reaches_the_pins_thread_and_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    line = Line(nominal_hz=50.0)
    t = line.arm()
    line.edge(t + 10 * MS, 1)

    def break_down(self: FirstEdgeFinder, *args: object, **more: object) -> None:
        raise ZeroDivisionError("a bug")

    with monkeypatch.context() as patch:
        patch.setattr(FirstEdgeFinder, "take", break_down)
        line.edge(t + 20 * MS, 1)  # would end lgpio's thread
        assert "edges were lost: internal error: ZeroDivisionError" in line.trigger.waiting_words()
    for k in (1, 2, 3):
        line.edge(t + (10 + 20 * k) * MS, 1)
    train = line.trigger.disarm()
    assert train.t0_ns == t + 10 * MS and len(train.edges_ns) == 4
    assert train.problems == ["trigger: edges were lost: internal error: ZeroDivisionError: a bug"]
