"""A missed first edge on one unit of a test is found, or said to be unknowable; never guessed."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from example_report import example_result
from scipy.spatial.transform import Rotation

from bricktrack_common.clocks import ClockTriplet
from bricktrack_common.run_manifest import ClocksSection, WaveSection
from bricktrack_host.results.daq_clock import fit_edges
from bricktrack_host.results.edge_comparison import compare_edges
from bricktrack_host.tracks import ImuTrack

HZ = 50.0
N_EDGES = 600


@pytest.fixture(scope="module")
def blank():
    return example_result()


def unit(
    blank, seed, *, missed=0, date_off_s=None, sees_end=False, table=None, noise_mps2=0.3, hz=HZ, motion=True
):
    """Return a unit's result: its own clock and axes, and ``missed`` edges at the start that it did not see.

    ``table`` is the table's acceleration, a function of the laboratory's time.
    """
    rng = np.random.default_rng(seed)
    start_ns, rate = int(rng.integers(10**12, 10**13)), 1 + rng.uniform(-5e-5, 5e-5)

    def clock_ns(lab_s):
        return start_ns + np.rint(np.asarray(lab_s) * rate * 1e9).astype(np.int64)

    edges = clock_ns(np.arange(missed, N_EDGES) / hz) + rng.integers(0, 40_000, N_EDGES - missed)
    lab_s = np.arange(-0.5, N_EDGES / hz + 0.5, 0.01) + rng.uniform(0, 0.01)
    turn = Rotation.random(random_state=seed).as_matrix()
    force = (table(lab_s) if motion else 0.0) + np.array([0, 0, 9.81])
    imu = ImuTrack(
        t_ns=clock_ns(lab_s),
        acc_mps2=force @ turn.T + rng.normal(0, noise_mps2, (len(lab_s), 3)),
        gyro_radps=np.zeros((len(lab_s), 3)),
        flags=np.zeros(len(lab_s), dtype=np.int64),
        acc_range_mps2=156.9,
    )
    imu.acc_mps2[300:310] = np.nan
    clocks = ClocksSection()
    if date_off_s is not None:
        at = int(edges[0]) + 1_000_000
        lab = missed / hz + 0.001
        date = 1_790_000_000_000_000_000 + int((lab + date_off_s) * 1e9)
        clocks = ClocksSection(trigger=ClockTriplet(monotonic_ns=at, boottime_ns=at, realtime_ns=date))
    wave = WaveSection(n_after_last=5 if sees_end else 0)
    trigger = msgspec.structs.replace(blank.manifest.trigger, nominal_hz=hz, wave=wave, t0_ns=int(edges[0]))
    manifest = msgspec.structs.replace(blank.manifest, trigger=trigger, clocks=clocks)
    return replace(blank, manifest=manifest, edge_fit=fit_edges(edges, hz), imu=imu)


@pytest.fixture(scope="module")
def table():
    """Band-limited shaking in three directions, 2 to 15 Hz, as the sum of sines."""
    rng = np.random.default_rng(4)
    f, phase = rng.uniform(2, 15, 40), rng.uniform(0, 2 * np.pi, (40, 1, 3))
    a = rng.normal(0, 0.4, (40, 1, 3))

    def acceleration(t_s):
        return np.sum(
            a * np.sin(2 * np.pi * f[:, None, None] * np.asarray(t_s)[None, :, None] + phase), axis=0
        )

    return acceleration


def test_units_that_all_saw_the_first_edge_agree(blank, table):
    units = {f"u{i}": unit(blank, i, table=table) for i in range(3)}
    comparison = compare_edges(units)
    assert [u.state for u in comparison.units] == ["agrees"] * 3
    assert comparison.problems() == []


@pytest.mark.parametrize("witness", ["end", "date", "motion"])
def test_each_witness_alone_finds_a_missed_first_edge(blank, table, witness):
    known = {"date_off_s": 0.0 if witness == "date" else None, "sees_end": witness == "end", "table": table}
    known["motion"] = witness == "motion"
    units = {f"u{i}": unit(blank, i, missed=int(i == 1), **known) for i in range(3)}
    comparison = compare_edges(units)
    assert comparison.slips == {"u0": 0, "u1": 1, "u2": 0}
    [slipped] = [u for u in comparison.units if u.unit == "u1"]
    assert slipped.state == "corrected"
    assert [t.witness for t in slipped.testimonies] == [witness]
    assert "u1: its edge 0 is the wave's edge +1" in comparison.problems()[0]


def test_the_unit_that_slipped_is_named_even_if_it_stands_first(blank, table):
    units = {f"u{i}": unit(blank, i, missed=2 * int(i == 0), table=table) for i in range(4)}
    comparison = compare_edges(units)
    assert comparison.reference != "u0"
    assert comparison.slips == {"u0": 2, "u1": 0, "u2": 0, "u3": 0}


def test_witnesses_that_contradict_correct_nothing(blank, table):
    units = {
        "u0": unit(blank, 0, table=table, date_off_s=0.0),
        "u1": unit(blank, 1, table=table, date_off_s=0.04),  # two periods by the date, none by the motion
    }
    comparison = compare_edges(units)
    assert comparison.units[1].state == "contradictory"
    assert comparison.slips["u1"] == 0
    assert "contradict" in comparison.problems()[0]


def test_without_a_witness_it_is_said_that_nothing_is_known(blank, table):
    units = {f"u{i}": unit(blank, i, missed=i, table=table, motion=False) for i in range(2)}
    comparison = compare_edges(units)
    assert comparison.units[1].state == "unknown"
    assert "nothing tells" in comparison.problems()[0]


def test_clocks_that_were_never_set_are_no_witness(blank, table):
    units = {
        "u0": unit(blank, 0, table=table, date_off_s=0.0),
        "u1": unit(blank, 1, table=table, date_off_s=-4e8, missed=1),
    }
    assert compare_edges(units).slips["u1"] == 1


def test_a_wave_too_fast_for_a_witness_does_not_hear_it(blank, table):
    # 1 kHz: the date's 2 ms are two periods, and the motion's shift is known to some milliseconds at best.
    units = {
        f"u{i}": unit(blank, i, table=table, date_off_s=0.0, noise_mps2=3.0, hz=1000.0) for i in range(2)
    }
    assert compare_edges(units).units[1].state == "unknown"


def test_one_unit_alone_is_not_compared(blank, table):
    assert compare_edges({"u0": unit(blank, 0, table=table)}) is None
