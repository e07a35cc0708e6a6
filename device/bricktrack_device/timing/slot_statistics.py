"""What the records of a sampling loop say about its timing."""

import errno
from collections import Counter
from collections.abc import Sequence

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_device.timing.loops import Block

PERCENTILES = (50, 90, 99, 99.9, 100)


def lateness_us(blocks: Sequence[Block], period_ns: int) -> FloatArray:
    """Return by how much each read began after its slot's due time, us, shape (n,).

    The due time of record n of a block is ``t0 + slot * period``. For loops that only sleep, the slot is the
    number of the read, so their lateness is what they have drifted by.
    """
    parts = [
        np.array([r.t_before_ns - (b.t0_ns + r.slot * period_ns) for r in b.records], dtype=np.float64)
        for b in blocks
    ]
    return np.concatenate(parts) / 1e3 if parts else np.empty(0)


def interval_errors_us(blocks: Sequence[Block], period_ns: int) -> FloatArray:
    """Return by how much the time between successive reads differs from the period, us, in size."""
    parts = [np.abs(np.diff([r.t_before_ns for r in b.records]) - period_ns) for b in blocks]
    return np.concatenate(parts) / 1e3 if parts else np.empty(0)


def drift_ppm(blocks: Sequence[Block], period_ns: int) -> tuple[float, float]:
    """Return how fast the reads run away from the slots, in parts per million, and its standard error.

    A straight line fitted to lateness against time: one for the whole test where the slots of all blocks lie
    on one grid, as the sampler's do; otherwise one slope for all blocks, each with a level of its own. NaN
    with fewer than ten reads.
    """
    blocks = [b for b in blocks if len(b.records) >= 2]
    if sum(len(b.records) for b in blocks) < 10:
        return float("nan"), float("nan")
    start_ns = blocks[0].t0_ns
    on_one_grid = all((b.t0_ns - start_ns) % period_ns == 0 for b in blocks)
    times, lates = [], []
    for b in blocks:
        slots = np.array([r.slot for r in b.records], dtype=np.float64)
        due = slots * period_ns + (b.t0_ns - start_ns)
        late = np.array([r.t_before_ns - b.t0_ns for r in b.records], dtype=np.float64) - slots * period_ns
        times.append(due if on_one_grid else due - due.mean())
        lates.append(late if on_one_grid else late - late.mean())
    x, y = np.concatenate(times), np.concatenate(lates)
    x, y = x - x.mean(), y - y.mean()
    slope = float(x @ y / (x @ x))
    rest = y - slope * x
    freedom = max(1, len(y) - 1 - (1 if on_one_grid else len(blocks)))
    return slope * 1e6, float(np.sqrt(rest @ rest / freedom / (x @ x))) * 1e6


def accumulated_ms(blocks: Sequence[Block], period_ns: int) -> float:
    """Return by how much the loop fell behind in all blocks together, ms: from first to last read of each."""
    total = 0
    for b in blocks:
        if b.records:
            first, last = b.records[0], b.records[-1]
            total += last.t_before_ns - first.t_before_ns - (last.slot - first.slot) * period_ns
    return total / 1e6


def figures_of(blocks: Sequence[Block], period_ns: int) -> dict[str, float | int | dict[str, int]]:
    """Return the summary of one method's blocks; percentiles are named p50 to p100."""
    records = [r for b in blocks for r in b.records]
    n_slots = sum(b.n_slots for b in blocks)
    elapsed_s = sum(b.records[-1].t_before_ns - b.records[0].t_before_ns for b in blocks if b.records) / 1e9
    with_data = [r for r in records if r.data is not None]
    repeats = sum(
        a.data is not None and a.data == b.data
        for block in blocks
        for a, b in zip(block.records, block.records[1:], strict=False)
    )
    bus_us = np.array([r.t_after_ns - r.t_before_ns for r in with_data], dtype=np.float64) / 1e3
    late, intervals = lateness_us(blocks, period_ns), interval_errors_us(blocks, period_ns)
    drift, drift_error = drift_ppm(blocks, period_ns)
    read_s = elapsed_s + len(blocks) * period_ns * 1e-9
    figures: dict[str, float | int | dict[str, int]] = {
        "slots": n_slots,
        "reads": len(records),
        "slots_lost": sum(b.n_slots - len({r.slot for r in b.records if r.slot < b.n_slots}) for b in blocks),
        "failed_reads": len(records) - len(with_data),
        "failed_by_errno": dict(
            Counter(errno.errorcode.get(r.errno, str(r.errno)) for r in records if r.errno)
        ),
        "rate_hz": len(records) / read_s if records else float("nan"),
        "unique_rate_hz": (len(with_data) - repeats) / read_s if records else float("nan"),
        "repeats": repeats,
        "drift_ppm": drift,
        "drift_ppm_standard_error": drift_error,
        "accumulated_drift_ms": accumulated_ms(blocks, period_ns),
    }
    for name, values in (("lateness_us", late), ("interval_error_us", intervals), ("bus_time_us", bus_us)):
        for q in PERCENTILES:
            figures[f"{name}_p{q:g}"] = float(np.percentile(values, q)) if values.size else float("nan")
    return figures
