import numpy as np
from scipy.optimize import linear_sum_assignment

from bricktrack_host.tracking.identity.pattern import NOT_FOLLOWED, assign_predicted, follow_pattern

PATTERN = np.array(
    [[900.0, 300.0], [1150.0, 340.0], [1450.0, 440.0], [900.0, 450.0], [905.0, 560.0], [910.0, 790.0], [1480.0, 820.0]]
)  # fmt: skip


def test_the_pattern_is_found_again_after_a_jump_over_several_leds():
    jump = np.array([-180.0, 140.0])
    blobs = np.vstack([PATTERN + jump, [[1500.0, 90.0], [200.0, 500.0]]])
    assert assign_predicted(blobs, PATTERN, gate_px=50.0, shift_limit_px=340.0).tolist() == list(range(7))
    assert (assign_predicted(blobs[:0], PATTERN, gate_px=50.0, shift_limit_px=340.0) == -1).all()
    assert (assign_predicted(PATTERN + 900.0, PATTERN, gate_px=50.0, shift_limit_px=100.0) == -1).all()


def test_a_hidden_led_and_one_that_cannot_be_seen_stay_unassigned():
    seen = np.delete(PATTERN, 3, axis=0) + 20.0
    assigned = assign_predicted(seen, PATTERN, gate_px=50.0, shift_limit_px=340.0)
    assert assigned.tolist() == [0, 1, 2, -1, 3, 4, 5]
    turned_away = PATTERN.copy()
    turned_away[6] = np.nan
    assert assign_predicted(seen, turned_away, gate_px=50.0, shift_limit_px=340.0)[6] == -1


def test_where_leds_want_one_light_the_sum_of_distances_is_the_least():
    rng = np.random.default_rng(3)
    for _ in range(200):
        leds = rng.uniform(0, 60, (6, 2))
        lights = np.vstack(
            [leds[:4] + rng.normal(0, 12, (4, 2)), rng.uniform(0, 60, (rng.integers(0, 4), 2))]
        )
        found = assign_predicted(lights, leds, gate_px=1e3, shift_limit_px=1e-6 + 1e3)
        n = int((found >= 0).sum())
        assert n == min(len(leds), len(lights))
        assert len(set(found[found >= 0])) == n
        # The least sum for the displacement that was settled on, the median of what was assigned before.
        if n < 6:
            continue
        shift = np.median(lights[found] - leds, axis=0)
        distance = np.linalg.norm(lights[None] - leds[:, None] - shift, axis=-1)
        i, j = linear_sum_assignment(distance)
        # One more round from there may still swap two, by little.
        assert distance[np.arange(6), found].sum() < 1.25 * distance[i, j].sum() + 1e-9


def run_of(n=40, hidden=(), seed=1):
    """Shuffled lights of a pattern that swings and turns, two false ones in each frame, and their LEDs."""
    rng = np.random.default_rng(seed)
    lights, led, first = [], [], [0]
    for i in range(n):
        a = 0.05 * np.sin(0.7 * i)
        turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        at = (PATTERN - 1000.0) @ turn.T + 1000.0 + 60 * np.sin(0.9 * i) * np.array([1.0, 0.5])
        shown = [k for k in range(7) if (i, k) not in hidden]
        places = np.vstack([at[shown], rng.uniform([0, 0], [1900, 120], (2, 2))])
        order = rng.permutation(len(places))
        lights.append(places[order])
        led.append(np.append(shown, [-1, -1])[order])
        first.append(first[-1] + len(places))
    return np.vstack(lights), np.array(first), led


def follow(uv, first, led, *, anchor=12, believed=()):
    n = len(led)
    is_believed = np.isin(np.arange(n), believed)
    stamps = np.arange(n, dtype=np.int64) * 33_000_000
    at = first[anchor]
    order = np.argsort(led[anchor])[2:]
    return follow_pattern(
        uv, first, stamps, is_believed, anchor, uv[at + order], radius_px=34.0, max_coast_ns=500_000_000
    )


def test_a_pattern_is_followed_both_ways_through_hidden_leds():
    hidden = {(i, k) for i in range(20, 26) for k in (0, 6)}
    uv, first, led = run_of(hidden=hidden)
    found = follow(uv, first, led)
    assert (found[12] == NOT_FOLLOWED).all()
    for i in np.delete(np.arange(40), 12):
        expected = [list(led[i]).index(k) if k in led[i] else -1 for k in range(7)]
        assert found[i].tolist() == expected


def test_a_pattern_stops_at_a_believed_frame_and_after_half_a_second_of_darkness():
    hidden = {(i, k) for i in range(20, 38) for k in range(7)}
    uv, first, led = run_of(hidden=hidden)
    found = follow(uv, first, led, believed=(5,))
    assert (found[:6] == NOT_FOLLOWED).all() and (found[6:12] != NOT_FOLLOWED).all()
    assert (found[13:20] != NOT_FOLLOWED).all()
    assert (found[38:] == NOT_FOLLOWED).all()
