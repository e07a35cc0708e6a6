import numpy as np

from bricktrack_host.fusion.clocks.saw_tooth_kernel import least_optics_costs, optics_cost, slip_costs


def test_a_saw_tooth_costs_what_its_ages_cost_in_every_stretch_of_time():
    rng = np.random.default_rng(5)
    table = rng.uniform(0.0, 9.0, (40, 25))
    first_lag_s, lag_step_s, period_s, rate = -0.006, 0.0005, 0.01, 0.0021
    since_mid_s = np.linspace(-8.0, 8.0, 40)
    phases_s = np.array([0.0, 0.0031, 0.0099])
    # The last of each reach beyond the table, whose ends hold.
    lags_s = np.array([[-0.004, 0.0, 0.0013], [-0.005, -0.0049, 0.02], [-0.03, -0.02, 0.0]])
    cost = optics_cost(table, since_mid_s, first_lag_s, lag_step_s, period_s, rate, phases_s, lags_s)
    grid_s = first_lag_s + lag_step_s * np.arange(25)
    for i, phase_s in enumerate(phases_s):
        age_s = np.mod(phase_s - since_mid_s * rate, period_s)
        for j, lag_s in enumerate(lags_s[i]):
            expected = sum(np.interp(age_s[m] + lag_s, grid_s, table[m]) for m in range(40))
            # Sums of 40 terms of up to 9, in another order of operations.
            np.testing.assert_allclose(cost[i, j], expected, rtol=1e-11)


def test_the_least_cost_over_lags_whole_columns_apart_is_found():
    rng = np.random.default_rng(6)
    table = rng.uniform(0.0, 9.0, (40, 73))
    since_mid_s = np.linspace(-8.0, 8.0, 40)
    phases_s = np.arange(0.0, 0.01, 0.001)
    rates = np.array([-0.0117, 0.0, 0.0021])
    for stride in (1, 2, 3):
        # Those of each phase begin elsewhere.
        lags_s = np.arange(-0.013, 0.0021, 0.0005 * stride) + 0.0001 * np.arange(10)[:, None]
        found = least_optics_costs(
            table,
            since_mid_s,
            -0.018,
            0.0005,
            0.01,
            rates,
            phases_s,
            lags_s[:, 0].copy(),
            stride,
            lags_s.shape[1],
        )
        for least, lag, rate in zip(*found, rates, strict=True):
            same = (table, since_mid_s, -0.018, 0.0005, 0.01 * (1 + rate), rate, phases_s)
            expected = optics_cost(*same, lags_s)
            np.testing.assert_allclose(least, expected.min(axis=1), rtol=1e-11)
            np.testing.assert_array_equal(lag, expected.argmin(axis=1))


def test_slips_cost_what_lies_near_them():
    at_s = 0.01 * np.arange(2000)
    repeat_price = np.full(2000, 30.0)
    repeat_price[1000] = 0.0  # one repeat
    skip_price = np.zeros(2000)
    skip_price[600] = -100.0  # one kink
    ends_s = np.array([at_s[0], at_s[-1]]) - 10.0
    reads = (repeat_price, skip_price, at_s, ends_s, 10.0, 0.01)
    # Off by 1/1500, a clock slips every 15 s: here once, at 10 s and 1500 times the phase. Ages that are unsure
    # by 2 ms are those of slips 300 samples off, so three samples away cost (3 / 301)^2.
    rates, phases_s = np.array([1 / 1500, 0.0, -1 / 1500]), np.array([0.0, 0.03 / 1500])
    cost, kinks = slip_costs(*reads, rates, phases_s, 0.002, 150, 20.0)
    np.testing.assert_allclose(cost[0], [0.0, (3 / 301) ** 2], atol=1e-9)
    # Without a rate there are no slips, and a fast one's are 400 samples from the kink, out of reach.
    assert (cost[1:] == 0.0).all()
    assert (kinks == 0).all()
    cost, kinks = slip_costs(*reads, rates[2:], np.array([4.0 / 1500]), 0.002, 150, 20.0)
    np.testing.assert_allclose(cost, -100.0, atol=1e-4)
    assert kinks[0, 0] in 601 * 7919 ** np.arange(4)  # the kink's number, weighed by the slip's
