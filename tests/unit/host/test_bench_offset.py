"""The bound of the offset that the benchmark shows, on a simulated shake."""

from dataclasses import replace

import numpy as np
from bench_offset import offset_bound_ms
from brick_shakes import EPOCH_NS, LEVER_ARM_MM, simulate_shake

from bricktrack_host.fusion.clocks.time_alignment import align_times
from bricktrack_host.fusion.estimate import fuse


def test_the_bound_grows_with_the_cameras_noise_and_no_estimate_claims_less():
    run = simulate_shake(1, duration_s=5.0, offset_s=0.01)
    bound_ms = offset_bound_ms(run.optical, run.imu, offset_s=0.01)
    doubled = replace(run.optical, covariance=4 * run.optical.covariance)
    # Twice the noise, twice the bound, but for what is known beforehand of gains and lag.
    assert 1.6 * bound_ms < offset_bound_ms(doubled, run.imu, offset_s=0.01) < 2.05 * bound_ms
    result = fuse(
        run.optical, run.imu, lever_arm_mm=LEVER_ARM_MM, output_t_ns=run.optical.t_ns[::20],
        alignment=align_times(run.optical, run.imu),
    )  # fmt: skip
    assert result.offset_sd_ns * 1e-6 > 0.9 * bound_ms
    assert abs(result.offset_ns * 1e-6 - 10.0) < 4 * result.offset_sd_ns * 1e-6
    # Were nothing else unknown: 0.1 deg and 0.1 mm a frame over how fast each turned and moved.
    i = np.searchsorted(run.t_s, (run.optical.t_ns - EPOCH_NS) * 1e-9 - 1e-6)
    told = (run.omega_radps[i] / np.radians(0.1)) ** 2 + (run.v_mmps[i] / 0.1) ** 2
    least_ms = 1e3 / np.sqrt(told.sum())
    assert least_ms < bound_ms < 8 * least_ms
