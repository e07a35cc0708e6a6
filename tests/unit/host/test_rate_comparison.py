"""Gyroscope and optics beside each other stand at the instants of the samples, not of their reads."""

from dataclasses import replace

import numpy as np
import pytest
from example_report import example_result

from bricktrack_host.reporting.rate_comparison import compare_rates
from bricktrack_host.results.run_summary import imu_camera_time_ns

READ_LATE_NS = 15_000_000  # so late that it shows beside the noise of single poses


@pytest.fixture(scope="module")
def result():
    return example_result()


def test_late_reads_leave_no_difference_between_the_rates(result):
    late = replace(result, imu=replace(result.imu, t_ns=result.imu.t_ns + READ_LATE_NS))
    as_taken, as_read = compare_rates(late), compare_rates(replace(late, imu_camera_t_ns=None))
    assert np.array_equal(as_taken.gyro_s, compare_rates(result).gyro_s)
    assert np.nanstd(as_read.difference_dps) > 1.5 * np.nanstd(as_taken.difference_dps)


def test_of_older_results_the_samples_stand_by_the_clocks_offset(result):
    older = replace(result, imu_camera_t_ns=None, alignment={"offset_ms": -2500.25})
    np.testing.assert_array_equal(imu_camera_time_ns(older), result.imu.t_ns + 2_500_250_000)
    np.testing.assert_array_equal(imu_camera_time_ns(replace(older, alignment={})), result.imu.t_ns)
