"""Thinned lines, bands and dots keep their picture."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bricktrack_host.reporting.thinning import thinned, thinned_band, thinned_dots


def drawn(t_s, y):
    """Return the pixels of a thin line, one pixel column for each of 300 columns of time."""
    fig = Figure(figsize=(3, 2), dpi=100)
    ax = fig.add_axes((0, 0, 1, 1))
    ax.plot(t_s, y, lw=0.6, color="k", snap=False)
    ax.set(xlim=(0, 10), ylim=(-4, 4))
    ax.set_axis_off()
    canvas = FigureCanvasAgg(fig)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., 0].astype(float)


def test_a_thinned_line_draws_the_picture_of_the_whole():
    rng = np.random.default_rng(3)
    t_s = np.linspace(0, 10, 40_000)
    y = np.sin(40 * t_s) + 0.3 * rng.standard_normal(len(t_s))
    y[12_345] = 3.7  # one sample alone must not go
    index = thinned(t_s, y, n_columns=300)
    assert len(index) <= 1200
    assert 12_345 in index
    whole = drawn(t_s, y)

    def lost(chosen):
        """Return the share of inked pixels of the whole line without ink beside them, and the other way."""
        ours = drawn(t_s[chosen], y[chosen])
        return missing(whole, ours), missing(ours, whole)

    # A stroke is about a pixel wide and bleeds into the column beside its own: compared to one pixel.
    assert lost(index)[0] < 0.002
    assert lost(index)[1] == 0
    every = np.arange(0, len(t_s), len(t_s) // 1200)
    assert lost(every)[0] > 0.1


def missing(ink, elsewhere):
    dark, there = ink < 100, elsewhere < 240
    near = there.copy()
    near[:, 1:] |= there[:, :-1]
    near[:, :-1] |= there[:, 1:]
    return (dark & ~near).sum() / dark.sum()


def test_gaps_stay_gaps_and_short_lines_stay_whole():
    t_s = np.linspace(0, 10, 5000)
    y = np.sin(t_s)
    y[1000:1010] = np.nan
    index = thinned(t_s, y, n_columns=100)
    assert set(range(1000, 1010)) <= set(index.tolist())
    assert np.array_equal(thinned(t_s[:300], y[:300], n_columns=100), np.arange(300))
    assert np.array_equal(thinned(np.zeros(900), np.arange(900.0), n_columns=100), np.arange(900))


def test_a_thinned_band_covers_all_of_it():
    t_s = np.linspace(0, 10, 20_000)
    half = 1 + 0.5 * np.sin(300 * t_s)
    half[7777] = 9.0
    t, low, high = thinned_band(t_s, -half, half)
    assert len(t) <= 2400
    assert (low.min(), high.max()) == (-9.0, 9.0)
    assert (np.interp(t_s, t, high) >= half - 0.25).all()  # slopes between columns
    assert (np.interp(t_s, t, low) <= 0.25 - half).all()


def test_of_dots_on_top_of_each_other_one_is_left_and_few_dots_all_stay():
    rng = np.random.default_rng(5)
    places = np.stack([rng.integers(-30, 4000, 60_000), rng.normal(0, 20, 60_000).astype(int)], axis=1)
    places[31_234] = (2000, 900)  # a dot alone must not go
    left = thinned_dots(places, 5)
    assert len(left) < 15_000
    assert [2000, 900] in left.tolist()
    assert {tuple(cell) for cell in (left // 5).tolist()} == {tuple(cell) for cell in (places // 5).tolist()}
    assert np.array_equal(thinned_dots(places[:900], 5), places[:900])
