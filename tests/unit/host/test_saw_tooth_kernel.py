import numpy as np

from bricktrack_host.fusion.clocks.saw_tooth_kernel import grid_cost, optics_cost


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


def test_lags_whole_columns_apart_cost_the_same():
    rng = np.random.default_rng(6)
    table = rng.uniform(0.0, 9.0, (40, 73))
    since_mid_s = np.linspace(-8.0, 8.0, 40)
    phases_s = np.arange(0.0, 0.01, 0.001)
    lags_s = np.arange(-0.013, 0.0031, 0.001)
    for rate in (-0.0117, 0.0, 0.0021):
        same = (table, since_mid_s, -0.018, 0.0005, 0.01 * (1 + rate), rate, phases_s)
        expected = optics_cost(*same, np.tile(lags_s, (10, 1)))
        np.testing.assert_allclose(grid_cost(*same, lags_s[0], 2, len(lags_s)), expected, rtol=1e-11)
