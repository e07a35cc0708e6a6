"""The laboratory's clock from the edges: against trains whose truth is stated here, and the path-traced sample."""

import os
from pathlib import Path

import numpy as np
import pytest

from bricktrack_common.errors import ShapeError
from bricktrack_host.results.daq_clock import EdgeFitError, fit_edges

START_NS = 5_118_514_105_508  # some hours of uptime: too large for float seconds


def square_wave(n: int, *, period_ns: float, jitter_ns: float = 0.0, seed: int = 1) -> np.ndarray:
    jitter = np.random.default_rng(seed).normal(0, jitter_ns, n) if jitter_ns else np.zeros(n)
    return START_NS + np.rint(np.arange(n) * period_ns + jitter).astype(np.int64)


def test_exact_train_gives_period_phase_and_rate_exactly():
    fit = fit_edges(square_wave(3000, period_ns=5_000_100.0), nominal_hz=200.0)
    assert fit.period_ns == pytest.approx(5_000_100.0, abs=1e-3)
    assert fit.rate_ppm == pytest.approx(20.0, abs=1e-6)
    assert abs(fit.t0_ns + fit.t0_fraction_ns - START_NS) < 0.5
    assert fit.missed_index.size == 0
    assert not fit.is_extra.any()
    assert fit.problems() == []


def test_the_path_traced_samples_edges_are_recovered():
    folder = os.environ.get("BRICKTRACK_SAMPLES")
    if not folder:
        pytest.skip("BRICKTRACK_SAMPLES does not name the samples' folder")
    path = Path(folder) / "path-traced" / "edges_motion.csv"
    fit = fit_edges(np.loadtxt(path, skiprows=1, dtype=np.int64), nominal_hz=200.0)
    # The sample's README: 20.3 ppm and 4.8 us recovered by its maker; 20 ppm and 5 us put in.
    assert fit.rate_ppm == pytest.approx(20.3, abs=0.1)
    assert fit.rate_ppm == pytest.approx(20.0, abs=3 * fit.rate_sd_ppm)
    assert fit.residual_rms_ns == pytest.approx(4800, abs=100)
    assert fit.n_edges == 675


@pytest.mark.parametrize("nominal_hz", [200.0, None])
def test_missing_and_extra_edges_keep_every_number_right(nominal_hz):
    true = square_wave(2000, period_ns=4_999_800.0, jitter_ns=5000)
    kept = np.ones(2000, bool)
    kept[[1, 2, 3, 500, 1200, 1201]] = False
    kept[700:900] = False  # a second without edges
    extra = START_NS + np.array([2_000_000, 333_333_333, 7_777_777_777])
    edges = np.sort(np.concatenate([true[kept], extra]))
    fit = fit_edges(edges, nominal_hz=nominal_hz)
    assert fit.is_extra.sum() == 3
    assert np.isin(edges[fit.is_extra], extra).all()
    np.testing.assert_array_equal(fit.index[~fit.is_extra], np.flatnonzero(kept))
    np.testing.assert_array_equal(fit.missed_index, np.flatnonzero(~kept))
    assert fit.period_ns == pytest.approx(4_999_800.0, abs=4 * fit.period_sd_ns)
    assert any("206 of 2000" in words for words in fit.problems())


def test_late_interrupts_neither_move_the_line_nor_become_extra():
    edges = square_wave(3000, period_ns=5_000_000.0, jitter_ns=3000, seed=2)
    late = np.random.default_rng(3).choice(np.arange(10, 2990), 150, replace=False)
    edges[late] += 900_000  # 0.9 ms, one in twenty
    fit = fit_edges(edges, nominal_hz=200.0)
    assert not fit.is_extra.any()
    # Plain least squares would be off by 45 us in the mean; Huber's bias at 5 % is about 0.1 of the spread.
    assert abs(fit.t0_ns + fit.t0_fraction_ns - START_NS) < 1000
    assert fit.residual_max_ns == pytest.approx(900_000, rel=0.03)
    assert any("0.9" in words for words in fit.problems())


def test_bounce_right_after_an_edge_is_extra_and_a_bouncing_first_edge_is_said():
    edges = square_wave(400, period_ns=5_000_000.0)
    early = edges[0] - 2_000_000
    fit = fit_edges(np.sort(np.concatenate([[early], edges, edges[[50, 60]] + 40_000])), 200.0)
    assert fit.is_extra.sum() == 3
    assert fit.is_extra[0]
    assert abs(fit.t0_ns + fit.t0_fraction_ns - START_NS) < 1
    assert any("time zero is not a sample" in words for words in fit.problems())


def test_stated_deviations_hold_the_true_values():
    # 200 trains: a 95 % interval must hold the truth in 190 of 200, give or take 3 sigma = 9.
    inside_period = inside_t0 = 0
    for seed in range(200):
        edges = square_wave(300, period_ns=5_000_050.0, jitter_ns=5000, seed=seed)
        fit = fit_edges(edges, 200.0)
        inside_period += abs(fit.period_ns - 5_000_050.0) < 1.96 * fit.period_sd_ns
        inside_t0 += abs(fit.t0_ns + fit.t0_fraction_ns - START_NS) < 1.96 * fit.t0_sd_ns
    assert 178 <= inside_period <= 199
    assert 178 <= inside_t0 <= 199


def test_sample_number_and_time_are_inverse_and_keep_their_nanoseconds():
    fit = fit_edges(square_wave(3000, period_ns=5_000_100.25), nominal_hz=200.0)
    index = np.array([0.0, 1.5, 2999.0, -10.0])
    times = fit.time_of_index(index)
    assert times.dtype == np.int64
    np.testing.assert_allclose(times - START_NS, index * 5_000_100.25, atol=1.0)
    np.testing.assert_allclose(fit.sample_index_of(times), index, atol=3e-7)  # 1 ns of 5 ms


def test_every_other_edge_missed_is_seen_through_the_nominal_frequency():
    fit = fit_edges(square_wave(1000, period_ns=5_000_000.0)[::2], nominal_hz=200.0)
    assert fit.missed_index.size == 499
    assert any("really 200 Hz" in words for words in fit.problems())


def test_wrong_nominal_frequency_is_refused():
    with pytest.raises(EdgeFitError, match="no square wave of 100 Hz"):
        fit_edges(square_wave(1000, period_ns=5_000_000.0), nominal_hz=100.0)


def test_noise_is_refused():
    times = np.sort(np.random.default_rng(4).integers(0, 10**10, 500)) + np.arange(500)
    with pytest.raises(EdgeFitError):
        fit_edges(times)


@pytest.mark.parametrize(
    ("edges", "words"),
    [([1, 2, 3, 3, 4], "edge 3 does not"), ([0.0, 1.0, 2.0, 3.0, 4.0], "float64")],
)
def test_what_is_no_train_is_named(edges, words):
    with pytest.raises(ShapeError, match=words):
        fit_edges(np.array(edges))


def test_too_few_edges_are_said_to_be_too_few():
    with pytest.raises(EdgeFitError, match="4 edges; .* at least 5"):
        fit_edges(square_wave(4, period_ns=5e6))
