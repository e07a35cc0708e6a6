import numpy as np
import pytest

from bricktrack_device.capture.first_edge import Believed, FirstEdgeFinder

MS = 1_000_000
P = 20 * MS  # 50 Hz


def feed(finder: FirstEdgeFinder, edges_ns: list[int], *, armed_ns: int = 0) -> tuple[int, Believed] | None:
    """Return after which edge the first one was believed, and what."""
    last = armed_ns
    for i, t in enumerate(edges_ns):
        believed = finder.take(t, quiet_ns=t - last, since_armed_ns=t - armed_ns)
        last = t + 1000  # each pulse falls 1 us later
        if believed is not None:
            return i, believed
    return None


def wave(first_ns: int, n: int, period_ns: int = P) -> list[int]:
    return [first_ns + k * period_ns for k in range(n)]


def test_without_a_known_period_the_first_edge_is_believed_at_once() -> None:
    assert feed(FirstEdgeFinder(None, 0), [7 * MS]) == (0, Believed(7 * MS, [7 * MS]))


def test_a_wave_is_believed_at_its_third_edge_and_nothing_of_it_is_lost() -> None:
    edges = wave(100 * MS, 5)
    assert feed(FirstEdgeFinder(P, 0), edges) == (2, Believed(100 * MS, edges[:3]))


@pytest.mark.parametrize("glitch_ms", [-3, -7, -13, -50, -333, -4000])
def test_a_lone_glitch_before_the_wave_is_not_t0(glitch_ms: int) -> None:
    edges = wave(5000 * MS, 5)
    finder = FirstEdgeFinder(P, 0)
    found = feed(finder, [5000 * MS + glitch_ms * MS, *edges])
    assert found is not None and found[1].t0_ns == 5000 * MS
    assert finder.rejected_ns == [5000 * MS + glitch_ms * MS] and finder.n_rejected == 1


def test_a_glitch_alone_starts_nothing_and_is_provisional_only() -> None:
    finder = FirstEdgeFinder(P, 0)
    assert feed(finder, [100 * MS]) is None
    assert finder.provisional_t0_ns == 100 * MS


def test_a_missed_second_edge_keeps_the_true_first() -> None:
    edges = wave(100 * MS, 6)
    del edges[1]
    found = feed(FirstEdgeFinder(P, 0), edges)
    assert found is not None and found[1].t0_ns == 100 * MS and found[1].edges_ns == edges[:3]


def test_spurious_edges_between_do_not_hide_the_wave() -> None:
    edges = sorted([*wave(100 * MS, 5), 107 * MS, 131 * MS])
    found = feed(FirstEdgeFinder(P, 0), edges)
    assert found is not None and found[1].t0_ns == 100 * MS


def test_bursts_of_noise_are_rarely_believed_and_the_wave_after_them_is_found() -> None:
    # 300 bursts of ten edges within 60 ms: by chance three of them may be in step, with at most two others between.
    # Edges of such a burst lie 6 ms apart in the mean: some per cent at worst (13 of 300 measured).
    rng = np.random.default_rng(7)
    n_wrong = 0
    for _ in range(300):
        burst = np.sort(rng.integers(0, 60 * MS, 10)).tolist()
        finder = FirstEdgeFinder(P, 0)
        found = feed(finder, [*burst, *wave(1000 * MS, 6)])
        assert found is not None
        n_wrong += found[1].t0_ns != 1000 * MS
    assert n_wrong <= 30


@pytest.mark.parametrize("hz", [25.0, 33.0, 60.0, 100.0, 1000.0])
def test_a_steady_wave_of_another_frequency_is_believed_from_its_first_edge(hz: float) -> None:
    edges = wave(100 * MS, 8, round(1e9 / hz))
    found = feed(FirstEdgeFinder(P, 0), edges)
    assert found is not None and found[1].t0_ns == 100 * MS and found[0] <= 4


def test_a_slow_wave_is_not_believed_when_its_pre_roll_would_be_gone() -> None:
    assert feed(FirstEdgeFinder(P, 0), wave(0, 6, 2000 * MS)) is None


def test_jitter_of_a_millisecond_does_not_hide_a_50_hz_wave_s_first_edge() -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        edges = [t + int(rng.integers(-MS, MS)) for t in wave(100 * MS, 6)]
        found = feed(FirstEdgeFinder(P, 0), edges)
        assert found is not None and found[1].t0_ns == edges[0]


class TestQuietGap:
    GAP = 100 * MS

    def test_a_wave_that_runs_at_arming_does_not_count_until_it_paused(self) -> None:
        running, after = wave(15 * MS, 20), wave(15 * MS + 19 * P + 150 * MS, 5)
        finder = FirstEdgeFinder(P, self.GAP)
        assert feed(finder, running) is None
        found = feed(finder, after)
        assert found is not None and found[1].t0_ns == after[0]
        assert finder.rejected_ns == running

    def test_a_glitch_in_the_gap_does_not_hide_the_wave_after_it(self) -> None:
        found = feed(FirstEdgeFinder(P, self.GAP), [450 * MS, *wave(500 * MS, 5)])
        assert found is not None and found[1].t0_ns == 500 * MS

    def test_a_pause_that_is_too_short_is_no_gap(self) -> None:
        running = wave(15 * MS, 20)
        assert feed(FirstEdgeFinder(P, self.GAP), [*running, *wave(running[-1] + 70 * MS, 5)]) is None
