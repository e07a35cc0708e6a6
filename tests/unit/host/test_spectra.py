import numpy as np
import pytest
from scipy.signal import welch

from bricktrack_host.results.spectra import amplitude_spectrum, power_density


@pytest.mark.parametrize(("n", "n_segment"), [(1800, 512), (300, 300), (1801, 511)])
def test_the_power_density_is_that_of_scipy(n, n_segment):
    values = np.random.default_rng(6).normal(size=(n, 3)) + 3.0
    f_hz, density = power_density(values, 0.01, n_segment=n_segment)
    expected_hz, expected = welch(values, 100.0, nperseg=n_segment, detrend="constant", axis=0)
    np.testing.assert_allclose(f_hz, expected_hz)
    np.testing.assert_allclose(density, expected, rtol=1e-9, atol=1e-15)


def test_the_squared_density_sums_to_the_variance_of_each_column():
    values = np.random.default_rng(7).normal(size=(20_000, 2)) * [0.5, 3.0]
    spectrum = amplitude_spectrum(np.arange(20_000) / 100, values)
    power = np.sum(spectrum.density**2, axis=0) * spectrum.f_hz[0]
    # 77 half-overlapping segments of 512: the variance is known to a hundredth or two.
    np.testing.assert_allclose(power, [0.25, 9.0], rtol=0.05)
