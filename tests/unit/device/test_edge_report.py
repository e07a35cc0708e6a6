import numpy as np
import pytest

from bricktrack_device.capture.edge_report import judge_edges

T0 = 3_000_000_000_000
P = 5_000_000  # 200 Hz


def wave(n: int, *, period_ns: float = P, jitter_us: float = 0.0) -> list[int]:
    rng = np.random.default_rng(5)
    return (T0 + np.rint(np.arange(n) * period_ns + rng.normal(0, jitter_us * 1e3, n))).astype(int).tolist()


def test_a_clean_wave_has_its_frequency_and_no_words() -> None:
    edges = wave(1000, period_ns=P * (1 + 50e-6), jitter_us=30)
    report, words = judge_edges(edges, nominal_hz=200.0, end_ns=edges[-1] + P // 2)
    # 50 ppm slow; jitter of 30 us at either end of 5 s is 8 ppm.
    assert report.hz == pytest.approx(200 / (1 + 50e-6), rel=2e-5)
    assert (report.n_missed, report.n_extra, report.n_late, report.n_after_last, words) == (0, 0, 0, 0, [])


@pytest.mark.parametrize("nominal_hz", [200.0, None])
def test_missed_extra_and_late_edges_are_each_counted(nominal_hz: float | None) -> None:
    edges = wave(1000)
    late = edges[500]
    edges[500] += round(0.2 * P)
    for i in (700, 300, 301):
        del edges[i]
    edges = sorted([*edges, T0 + round(100.5 * P), T0 + round(200.4 * P)])
    report, words = judge_edges(edges, nominal_hz=nominal_hz, end_ns=edges[-1])
    assert (report.n_missed, report.n_extra, report.n_late) == (3, 2, 1) and late not in edges
    assert words == [
        "trigger: edges of the wave: 3 missed, 2 extra, out of step, 1 late; all that came are in the stream"
    ]


def test_a_wave_that_stops_says_when_how_many_are_missing_and_the_level() -> None:
    edges = wave(401)
    report, words = judge_edges(edges, nominal_hz=200.0, end_ns=T0 + 15_000_000_000, line_is_high=True)
    # 2 s of wave; (15 - 2) s at 200 Hz are 2600 more, the last of them on the window's end.
    assert report.last_edge_ns == T0 + 2_000_000_000 and report.n_after_last in (2599, 2600)
    assert "stopped 2.000 s after t = 0" in words[0] and "the line is high now" in words[0]


def test_another_frequency_than_configured_is_said_with_both() -> None:
    edges = wave(300, period_ns=1e7)
    report, words = judge_edges(edges, nominal_hz=200.0, end_ns=edges[-1])
    assert report.hz == pytest.approx(100.0) and report.n_missed == 0
    assert "100 Hz where trigger.nominal_hz is 200" in words[0]


def test_a_few_pulses_without_a_configured_frequency_are_not_judged() -> None:
    report, words = judge_edges([T0, T0 + 20, T0 + 90], nominal_hz=None, end_ns=T0 + 10**9)
    assert report.hz is None and report.last_edge_ns == T0 + 90 and words == []
    assert judge_edges([], nominal_hz=200.0, end_ns=T0)[0].last_edge_ns is None


def test_rejected_edges_are_kept_and_told() -> None:
    edges = wave(20)
    report, words = judge_edges(edges, nominal_hz=200.0, end_ns=edges[-1], rejected_ns=[T0 - 12_300_000])
    assert report.rejected_ns == [T0 - 12_300_000]
    assert words == [
        "trigger: 1 rising edges before t = 0 did not count, the last 12.3 ms before it; the manifest keeps their stamps"
    ]
