"""`bricktrackd imu-test`: how well the inertial sampler keeps its grid, beside the loops it replaces."""

import multiprocessing
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import HardwareError
from bricktrack_device.config import DeviceConfig, ImuTable
from bricktrack_device.inertial.imu_reader import ImuReader
from bricktrack_device.interfaces import Rig
from bricktrack_device.timing.loops import (
    METHODS,
    Block,
    LoopsFailed,
    LoopsJob,
    LoopsReady,
    Method,
    loops_main,
    plan_blocks,
)
from bricktrack_device.timing.result_file import Result, make_result
from bricktrack_device.timing.slot_statistics import PERCENTILES, figures_of, lateness_us
from bricktrack_device.timing.text_histogram import text_histogram

BLOCK_SLOTS = 250
PAPER_WORST_READ_MS = 8.53
_SET_UP_S = 15.0
_SLACK_S = 10.0

Progress = Callable[[float], None]
"""Hears the share that is done, 0 to 1."""


@dataclass(frozen=True, slots=True)
class Measured:
    """What one run of the test gave: blocks by method, and what the scheduler granted."""

    blocks: dict[Method, list[Block]]
    scheduling: str


def choose_imu(config: DeviceConfig, name: str | None) -> ImuTable:
    """Return the sensor of that name, or the first one.

    Raises
    ------
    HardwareError
        If there is none.
    """
    for imu in config.imu:
        if name is None or imu.name == name:
            return imu
    names = ", ".join(imu.name for imu in config.imu) or "none"
    raise HardwareError(f"no inertial sensor {name!r} is configured; there are: {names}. See [[imu]]")


def measure_sampler(
    config: DeviceConfig, rig: Rig, imu: ImuTable, n_slots: int, progress: Progress = lambda share: None
) -> Measured:
    """Let the daemon's own sampler run for ``n_slots`` slots, in its process, and return what it wrote."""
    period_ns = imu.period_ms * 1_000_000
    span_s = n_slots * period_ns * 1e-9 + _SLACK_S
    reader = ImuReader(imu, rig.bus_opener(imu.bus), config.sampler, span_s=span_s)
    reader.start()
    try:
        t0_ns: int | None = None
        while t0_ns is None or monotonic_ns() < t0_ns + (n_slots + 1) * period_ns:
            reader.poll()
            if reader.problem:
                raise HardwareError(f"imu {imu.name}: {reader.problem}")
            description = reader.description()
            if t0_ns is None and description is not None:
                t0_ns = description.t0_ns
            if t0_ns is not None:
                progress(min(1.0, max(0.0, (monotonic_ns() - t0_ns) / (n_slots * period_ns))))
            time.sleep(0.05)
        records = reader.records(t0_ns, t0_ns + n_slots * period_ns - 1)
        scheduling = reader.scheduling
    finally:
        reader.stop()
    return Measured({"grid": [Block("grid", t0_ns, n_slots, records)]}, scheduling)


def measure_loops(
    config: DeviceConfig,
    rig: Rig,
    imu: ImuTable,
    n_slots: int,
    progress: Progress = lambda share: None,
    *,
    methods: tuple[Method, ...] = METHODS,
    block_slots: int = BLOCK_SLOTS,
) -> Measured:
    """Let all methods take ``n_slots`` each on the same bus, in turn, in one process of its own."""
    plan = plan_blocks(n_slots, methods, block_slots=block_slots)
    job = LoopsJob(rig.bus_opener(imu.bus), imu, config.sampler, plan)
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=loops_main, args=(job, theirs), name="imu-test", daemon=True)
    process.start()
    theirs.close()
    blocks: dict[Method, list[Block]] = {method: [] for method in methods}
    scheduling = ""
    longest_s = block_slots * imu.period_ms / 1000
    try:
        for done in range(-1, len(plan)):
            # Sleeping loops are slower than their period; ten times it is a hang.
            if not ours.poll(_SET_UP_S if done < 0 else _SLACK_S + 10 * longest_s):
                raise HardwareError(f"imu {imu.name}: no read came back in time; the bus may be stuck")
            try:
                message = ours.recv()
            except EOFError as e:
                raise HardwareError(f"imu {imu.name}: the process that reads died") from e
            if isinstance(message, LoopsFailed):
                raise HardwareError(f"imu {imu.name}: {message.words}")
            if isinstance(message, LoopsReady):
                scheduling = message.scheduling
                continue
            blocks[message.method].append(message)
            progress((done + 1) / len(plan))
        process.join(2)
    finally:
        if process.is_alive():
            process.kill()
            process.join(2)
        ours.close()
    return Measured(blocks, scheduling)


def summarise(unit: str, rig: Rig, imu: ImuTable, n_slots: int, measured: Measured) -> Result:
    """Return the result of a test: figures by method, and the lateness of every read."""
    period_ns = imu.period_ms * 1_000_000
    figures: dict[str, Any] = {
        method: figures_of(blocks, period_ns) for method, blocks in measured.blocks.items()
    }
    values = {
        f"{method}_lateness_us": np.round(lateness_us(blocks, period_ns), 1).tolist()
        for method, blocks in measured.blocks.items()
    }
    for method, blocks in measured.blocks.items():
        values[f"{method}_bus_time_us"] = [
            (r.t_after_ns - r.t_before_ns) / 1000 for b in blocks for r in b.records if r.data is not None
        ]
    return make_result(
        "imu-test",
        unit,
        rig,
        settings={
            "imu": imu.name,
            "bus": imu.bus,
            "period_ms": imu.period_ms,
            "slots": n_slots,
            "scheduling": measured.scheduling,
        },
        figures=figures,
        values=values,
    )


def print_report(result: Result, console: Console | None = None) -> None:
    """Print a test for people."""
    console = console or Console()
    where = "SIMULATED sensor and bus" if result.simulated else str(result.hardware.get("model", ""))
    console.print(
        f"imu-test of {result.unit}, {result.settings['imu']} on {result.settings['bus']}: {where}",
        f"scheduling: {result.settings['scheduling']}",
        sep="\n",
        markup=True,
        highlight=False,
    )
    console.print(_table(result))
    for words in conclusions(result):
        console.print(words, markup=False, highlight=False)
    grid = result.figures["grid"]
    console.print("\nlateness of the sampler's reads after their slots:", highlight=False)
    top = max(2 * grid["lateness_us_p99"], 1.0)
    for line in text_histogram(result.values["grid_lateness_us"], unit="µs", limits=(0.0, top)):
        console.print(line, markup=False, highlight=False)


def _table(result: Result) -> Table:
    methods = list(result.figures)
    table = Table(box=None, header_style="bold")
    table.add_column("")
    for method in methods:
        table.add_column(method, justify="right")
    ratios = [m for m in methods if m != "grid"]
    for method in ratios:
        table.add_column(f"{method} / grid", justify="right")

    def row(label: str, key: str, form: str, *, compare: bool = False) -> None:
        found = [result.figures[m][key] for m in methods]
        cells = [format(value, form) for value in found]
        base = result.figures["grid"][key]
        for m in ratios:
            cells.append(f"{result.figures[m][key] / base:.3g}" if compare and base else "")
        table.add_row(label, *cells)

    row("slots", "slots", "d")
    row("slots without a read", "slots_lost", "d")
    row("failed reads", "failed_reads", "d")
    row("rate, Hz", "rate_hz", ".3f")
    row("unique samples, Hz", "unique_rate_hz", ".3f")
    row("drift, ppm", "drift_ppm", ".2f")
    row("  its standard error", "drift_ppm_standard_error", ".2f")
    row("fell behind by, ms", "accumulated_drift_ms", ".2f")
    for q in PERCENTILES:
        row(f"lateness p{q:g}, µs", f"lateness_us_p{q:g}", ".0f")
    for q in PERCENTILES:
        row(f"|interval - period| p{q:g}, µs", f"interval_error_us_p{q:g}", ".0f", compare=True)
    for q in (50, 99, 100):
        row(f"bus time p{q:g}, µs", f"bus_time_us_p{q:g}", ".0f")
    return table


def conclusions(result: Result) -> Sequence[str]:
    """Return in words what the grid's figures mean."""
    grid = result.figures["grid"]
    drift, error = grid["drift_ppm"], grid["drift_ppm_standard_error"]
    words = [
        f"Due times are t0 + n * {result.settings['period_ms']} ms of CLOCK_MONOTONIC and cannot drift; "
        f"measured: {drift:.3f} ppm, standard error {error:.3f}; behind by "
        f"{grid['accumulated_drift_ms']:.3f} ms in the end."
    ]
    lost, failed = grid["slots_lost"], grid["failed_reads"]
    if lost or failed:
        by_errno = ", ".join(f"{n} {name}" for name, n in grid["failed_by_errno"].items())
        words.append(
            f"{lost} slots without a read, {failed} failed reads{f': {by_errno}' if by_errno else ''}."
        )
    else:
        words.append("No slot was lost and no read failed.")
    words.append(
        f"Worst read {grid['bus_time_us_p100'] / 1000:.2f} ms on the bus "
        f"(the source paper's: {PAPER_WORST_READ_MS} ms)."
    )
    return words


def run_imu_test(
    config: DeviceConfig,
    rig: Rig,
    *,
    name: str | None,
    n_slots: int,
    compare: bool,
    progress: Progress = lambda share: None,
) -> Result:
    """Run the whole test and return its result."""
    imu = choose_imu(config, name)
    measure = measure_loops if compare else measure_sampler
    return summarise(config.unit.name, rig, imu, n_slots, measure(config, rig, imu, n_slots, progress))
