"""What goes wrong on purpose, on the simulated rig through the real recorder: the run survives and says what it was."""

import errno
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import av
import msgspec
import numpy as np
import pytest
from fault_runs import HZ, Unit, config_of, record

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.frame_times import FrameFlag
from bricktrack_common.imu_records import ImuFlag, read_imu
from bricktrack_common.run_folder import Run, read_run
from bricktrack_common.wire_messages import Disarmed, Refusal
from bricktrack_device.config import ImuTable, RecordingTable, TriggerTable
from bricktrack_device.sim import sim_pins
from bricktrack_device.sim.settings import SimFaults
from bricktrack_device.storage.disk import Disk

pytestmark = pytest.mark.slow

PERIOD_NS = 1e9 / HZ
LONG = RecordingTable(duration_s=1.5, pre_roll_s=0.2, post_roll_s=0.1)


def words_of(run: Run, part: str) -> list[str]:
    return [m for m in run.manifest.missing if m.startswith(part)]


# Camera


def test_dropped_frames_show_as_gaps_and_are_counted(tmp_path: Path) -> None:
    run = record(config_of(tmp_path, faults=SimFaults(drop_frame_every=7), imu=[]), blind=False)
    assert run.frames is not None and run.manifest.camera is not None
    period_ns = run.manifest.camera.frame_duration_us * 1000
    lost = np.rint(np.diff(run.frames.sensor_timestamp_ns) / period_ns).astype(int) - 1
    flagged = np.flatnonzero(run.frames.flags & FrameFlag.GAP_BEFORE) - 1
    assert np.flatnonzero(lost).tolist() == flagged.tolist()
    # 1.3 s and the way back to a keyframe are 39 to 51 frames, every seventh of which is gone.
    assert len(flagged) >= 4 and run.manifest.quality.frames_dropped >= lost.sum()
    assert run.manifest.state == "complete"


def test_a_camera_that_dies_in_mid_run_is_told_and_its_pictures_kept(tmp_path: Path) -> None:
    config = config_of(tmp_path, faults=SimFaults(camera_dies_after_s=1.6), imu=[], recording=LONG)
    run = record(config, blind=False)
    assert any("no picture for 1." in w for w in words_of(run, "camera:"))
    assert any("ends" in w for w in words_of(run, "video:"))
    assert run.frames is not None and run.frames.n_frames > 5 and run.edges_ns.size > 250
    with av.open(str(run.video)) as video:
        assert sum(1 for _ in video.decode(video=0)) == run.frames.n_frames


def test_lost_leds_are_recorded_as_they_are(tmp_path: Path) -> None:
    config = config_of(tmp_path, imu=[])
    config.sim.dropouts.append((0.3, 0.4))
    run = record(config, blind=False)
    assert run.manifest.state == "complete" and run.frames is not None
    with np.load(run.folder / "truth.npz") as truth:
        start_ns, end_ns = truth["dropouts_ns"][0]
    t = run.frames.sensor_timestamp_ns
    hidden = (t > start_ns + 100_000_000) & (t < end_ns - 100_000_000)
    free = t < start_ns - 200_000_000
    with av.open(str(run.video)) as video:
        brightest = np.array([f.to_ndarray(format="gray").max() for f in video.decode(video=0)])
    assert hidden.any() and free.any()
    # The LEDs nearly fill the sensor; the card before them reflects the room.
    assert brightest[hidden].max() < 0.8 * brightest[free].min()


# Inertial sensor


def test_bus_errors_are_gaps_with_their_errno(tmp_path: Path) -> None:
    run = record(config_of(tmp_path, faults=SimFaults(imu_nack_every=20, imu_nack_errno=errno.EREMOTEIO)))
    description, records, _ = read_imu(run.folder / "imu_brick.msgpack")
    failed = [r for r in records if r.data is None]
    # 130 slots and 13 status reads: every twentieth transaction fails, one in eleven of them a status.
    assert 4 <= len(failed) <= 8 and {r.errno for r in failed} == {errno.EREMOTEIO}
    samples = run.imus["brick"][1]
    first = records[0].slot
    for r in failed:
        assert (
            samples.flags[r.slot - first] & ImuFlag.GAP and np.isnan(samples.acc_mps2[r.slot - first]).all()
        )
    assert run.manifest.quality.imu_gaps >= len(failed)
    assert description.chip_id


def test_a_clipped_accelerometer_is_flagged_where_its_registers_are_at_the_limit(tmp_path: Path) -> None:
    # 0.2 m at 8 Hz would be 0.2 (2 pi 8)^2 = 505 m/s2, 51 g: no brick does that, but the chip must be clipped.
    config = config_of(tmp_path, recording=LONG)
    run = record(
        msgspec.structs.replace(
            config, sim=msgspec.structs.replace(config.sim, motion="sines", amplitude_mm=200.0)
        )
    )
    _, records, _ = read_imu(run.folder / "imu_brick.msgpack")
    flags = run.imus["brick"][1].flags
    # 100 counts are 1 m/s2 (data sheet, table 3-17): 16 g are 15,691 counts.
    first = records[0].slot
    largest = {
        r.slot - first: np.abs(np.frombuffer(r.data[:6], dtype="<i2").astype(int)).max()
        for r in records
        if r.data is not None
    }
    at_limit = {slot for slot, counts in largest.items() if counts >= 15_690}
    near_limit = {
        slot for slot, counts in largest.items() if counts >= 15_500
    }  # a sample may just not be clipped
    flagged = set(np.flatnonzero(flags & ImuFlag.ACC_CLIPPED).tolist())
    assert at_limit and at_limit <= flagged <= near_limit
    assert run.manifest.quality.imu_clipped == len(flagged)


def test_a_gentle_shake_is_not_called_clipped(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    run = record(msgspec.structs.replace(config, sim=msgspec.structs.replace(config.sim, motion="sines")))
    assert run.manifest.quality.imu_clipped == 0


def test_a_silent_reset_is_told_and_nothing_after_it_is_believed(tmp_path: Path) -> None:
    config = config_of(tmp_path, faults=SimFaults(imu_reset_s=0.5))
    with Unit(config) as unit:
        run_id = unit.arm().run_id
        unit.wait_for("recording")
        unit.wait_until(lambda: any("was reset" in i.problem for i in unit.recorder.status().imus))
        unit.wait_for("idle")
        run = read_run(unit.store.runs / run_id, verify_hashes=True)
    words = words_of(run, "imu brick:")
    assert any("the sensor was reset" in w for w in words)
    assert any("are all zero" in w or "had reset itself" in w for w in words)
    samples, t0 = run.imus["brick"][1], run.manifest.trigger.t0_ns
    assert t0 is not None
    after, before = samples.t_ns > t0 + 510_000_000, samples.t_ns < t0 + 490_000_000
    assert np.isnan(samples.acc_mps2[after]).all()
    assert (samples.flags[after] & (ImuFlag.BLANK | ImuFlag.MODE_CHANGED | ImuFlag.GAP) != 0).all()
    # Slots that a busy machine skipped are gaps, on both sides; what was read is right before, and nothing after.
    taken = samples.flags & ImuFlag.GAP == 0
    assert (taken & before).sum() > 10 and np.isfinite(samples.acc_mps2[taken & before]).all(
        axis=1
    ).mean() > 0.8
    n_after = (taken & after).sum()
    assert n_after > 10 and run.manifest.quality.imu_unusable >= n_after


def test_a_stuck_sensor_is_told_and_its_unique_rate_falls(tmp_path: Path) -> None:
    run = record(config_of(tmp_path, faults=SimFaults(imu_stuck_s=0.4)))
    assert any("no longer measured" in w for w in words_of(run, "imu brick:"))
    samples, t0 = run.imus["brick"][1], run.manifest.trigger.t0_ns
    assert t0 is not None
    after = samples.t_ns > t0 + 430_000_000
    present = samples.flags & ImuFlag.GAP == 0
    held = after & present
    assert held.sum() >= 15 and np.isnan(samples.gyro_radps[after]).all()
    assert (samples.flags[held] & ImuFlag.STUCK != 0).all()
    # 0.6 s of 1.3 s measured something new, but for the slots that a busy machine skipped.
    taken = present & (samples.t_ns < t0 + 400_000_000)
    fresh = present & (samples.flags & (ImuFlag.REPEAT | ImuFlag.STUCK) == 0)
    assert taken.sum() > 15 and fresh[taken].mean() > 0.9
    assert run.manifest.quality.imu_unique_hz["brick"] == pytest.approx(fresh.sum() / 1.3, abs=1.0)
    assert run.manifest.quality.imu_repeats >= held.sum()


def test_an_absent_sensor_is_told_when_arming_and_the_rest_is_recorded(tmp_path: Path) -> None:
    with Unit(config_of(tmp_path, faults=SimFaults(imu_absent=True))) as unit:
        armed = unit.arm()
        assert len(armed.missing) == 1
        assert "imu brick: IMU at I2C address 0x28: No I2C device at address: 0x28" in armed.missing[0]
        unit.wait_for("recording")
        unit.wait_for("idle")
        run = read_run(unit.store.runs / armed.run_id, verify_hashes=True)
    assert run.imus == {} and run.frames is not None and run.frames.n_frames > 30
    assert words_of(run, "imu brick:") == armed.missing


def test_two_sensors_on_two_buses_make_two_streams_and_keep_their_calibrations(tmp_path: Path) -> None:
    imus = [
        ImuTable(name="brick", bus="/dev/i2c-3", mode="amg", axis_map="P5"),
        ImuTable(name="base", bus="/dev/i2c-4", mode="ndof", save_calibration=True),
    ]
    config = config_of(
        tmp_path, imu=imus, recording=RecordingTable(duration_s=2.0, pre_roll_s=0.2, post_roll_s=0.1)
    )
    with Unit(config) as unit:
        first = unit.record()
        again = unit.record()
    raw, raw_samples = first.imus["brick"]
    fused, fused_samples = first.imus["base"]
    assert (raw.acc_range_g, raw.fusion, raw.axis_map) == (16.0, False, "P5")
    assert (fused.acc_range_g, fused.fusion, fused.axis_map) == (4.0, True, "P1")
    assert raw.chip_id != fused.chip_id
    assert np.isnan(raw_samples.q_wxyz).all()
    norm = np.linalg.norm(fused_samples.q_wxyz[fused_samples.flags & ImuFlag.GAP == 0], axis=1)
    assert norm.size > 40 and np.nanmax(np.abs(norm - 1)) < 1e-3 and np.isfinite(norm).mean() > 0.8
    # Both rest on the same brick before the shake: P5 only turns what the first one says. Data sheet, table
    # 3-4: AXIS_MAP_CONFIG 0x21 makes x the chip's y and y its x, AXIS_MAP_SIGN 0x01 turns z over.
    t0 = first.manifest.trigger.t0_ns
    assert t0 is not None
    rest = [np.nanmean(s.acc_mps2[s.t_ns < t0 + 100_000_000], axis=0) for s in (raw_samples, fused_samples)]
    turned = rest[1][[1, 0, 2]] * [1, 1, -1]
    assert rest[0] == pytest.approx(turned, abs=0.5)  # two chips, each with its bias
    assert first.manifest.quality.imu_unique_hz.keys() == {"brick", "base"}
    files = list((tmp_path / "calibration").iterdir())
    assert [f.stem for f in files] == [fused.chip_id]
    assert not fused.calibration_restored and again.imus["base"][0].calibration_restored
    assert not again.imus["brick"][0].calibration_restored


# Trigger


def test_interrupts_reported_late_keep_their_stamps_and_none_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sim_pins, "_LINE_DELAY_NS", 40_000_000)
    run = record(config_of(tmp_path, imu=[]))
    wave, t0, window = run.manifest.trigger.wave, run.manifest.trigger.t0_ns, run.manifest.window_ns
    assert wave is not None and t0 is not None and window is not None
    in_window = run.edges_ns[run.edges_ns <= window[1]]
    n = np.arange(len(in_window))
    # Stamps scatter by 5 us (standard deviation) and the wave is 20 ppm off; six deviations and 22 us.
    assert np.abs(in_window - t0 - n * PERIOD_NS).max() < 60_000
    assert len(in_window) in (220, 221) and (wave.n_missed, wave.n_extra, wave.n_late) == (0, 0, 0)
    assert words_of(run, "trigger:") == []


def test_missed_and_late_edges_are_counted(tmp_path: Path) -> None:
    faults = SimFaults(missed_edges=[1, 60, 61], late_edges=[(100, 1000.0)])
    run = record(config_of(tmp_path, faults=faults, imu=[]))
    wave, t0 = run.manifest.trigger.wave, run.manifest.trigger.t0_ns
    assert wave is not None and t0 is not None
    assert (wave.n_missed, wave.n_late, wave.n_extra) == (3, 1, 0)
    with np.load(run.folder / "truth.npz") as truth:
        assert "t_ns" in truth
    assert run.edges_ns[1] - t0 == pytest.approx(2 * PERIOD_NS, abs=60_000)  # the second edge was missed
    assert "3 missed, 1 late" in words_of(run, "trigger:")[0]


def pulse(unit: Unit) -> int:
    """Put a spike of 20 us on the line now and return its stamp."""
    pin = unit.rig.pin_factory().pin("GPIO17")
    now = monotonic_ns()
    pin.drive_at(True, now * 1e-9)
    pin.drive_at(False, (now + 20_000) * 1e-9)
    return now


def test_a_glitch_before_the_wave_is_not_t0_and_the_pre_roll_stays(tmp_path: Path) -> None:
    config = config_of(tmp_path, imu=[])
    with Unit(config) as unit:
        run_id = unit.arm().run_id
        time.sleep(0.05)
        glitch_ns = pulse(unit)
        assert unit.recorder.state == "armed"
        unit.wait_for("recording")
        unit.wait_for("idle")
        run = read_run(unit.store.runs / run_id, verify_hashes=True)
    wave, t0, window = run.manifest.trigger.wave, run.manifest.trigger.t0_ns, run.manifest.window_ns
    assert wave is not None and t0 is not None and window is not None and run.frames is not None
    assert [round(t / 1000) for t in wave.rejected_ns] == [round(glitch_ns / 1000)]
    assert t0 - glitch_ns > 100_000_000 and wave.n_missed == 0
    assert run.frames.sensor_timestamp_ns[0] <= window[0] == t0 - 200_000_000
    assert "1 rising edges before t = 0 did not count" in words_of(run, "trigger:")[0]


def test_spikes_in_the_wave_are_counted_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spikes_ns = []
    changes = sim_pins.SquareWave._changes

    def with_spikes(self: sim_pins.SquareWave) -> Iterator[tuple[bool, int]]:
        for n, (high, t_ns) in enumerate(changes(self)):
            yield high, t_ns
            if n in (81, 161, 241):  # a falling edge: 1 ms later comes a spike of 20 us
                spikes_ns.append(t_ns + 1_000_000)
                yield True, t_ns + 1_000_000
                yield False, t_ns + 1_020_000

    monkeypatch.setattr(sim_pins.SquareWave, "_changes", with_spikes)
    run = record(config_of(tmp_path, imu=[]))
    wave = run.manifest.trigger.wave
    assert wave is not None and (wave.n_extra, wave.n_missed, wave.n_late) == (3, 0, 0)
    assert len(spikes_ns) == 3 and all(np.abs(run.edges_ns - s).min() < 1000 for s in spikes_ns)
    assert "3 extra, out of step" in words_of(run, "trigger:")[0]


def test_a_wave_of_another_frequency_is_recorded_and_told(tmp_path: Path) -> None:
    run = record(config_of(tmp_path, imu=[], trigger=TriggerTable(nominal_hz=330.0)))
    wave = run.manifest.trigger.wave
    assert wave is not None and wave.hz == pytest.approx(HZ, rel=1e-3) and wave.n_missed == 0
    assert "the wave has 200 Hz where trigger.nominal_hz is 330" in words_of(run, "trigger:")[0]
    assert run.edges_ns.size >= 220


def test_a_wave_that_stops_in_mid_run_is_told_with_its_last_edge(tmp_path: Path) -> None:
    with Unit(config_of(tmp_path, imu=[])) as unit:
        run_id = unit.arm().run_id
        unit.wait_for("recording")
        time.sleep(0.3)
        unit.rig._wave.stop()
        unit.wait_for("idle")
        run = read_run(unit.store.runs / run_id, verify_hashes=True)
    wave, window = run.manifest.trigger.wave, run.manifest.window_ns
    assert wave is not None and window is not None and wave.last_edge_ns == run.edges_ns[-1]
    assert wave.n_after_last == pytest.approx((window[1] - run.edges_ns[-1]) / PERIOD_NS, abs=1)
    assert (
        "the wave stopped" in words_of(run, "trigger:")[0]
        and "the line is low" in words_of(run, "trigger:")[0]
    )


def test_a_kilohertz_wave_is_logged_without_a_loss(tmp_path: Path) -> None:
    run = record(config_of(tmp_path, imu=[], hz=1000.0))
    wave, window, t0 = run.manifest.trigger.wave, run.manifest.window_ns, run.manifest.trigger.t0_ns
    assert wave is not None and window is not None and t0 is not None
    in_window = run.edges_ns[run.edges_ns <= window[1]]
    # 1.1 s at 1 kHz by a clock 20 ppm off.
    assert len(in_window) in (1100, 1101) and (wave.n_missed, wave.n_extra) == (0, 0)


# Card


class FillableDisk(Disk):
    """A card that is full while `is_full`."""

    is_full = False

    def write_file(self, path: Path, fill: Callable[[BinaryIO], object]) -> None:
        if self.is_full and path.name == "video.h264":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        super().write_file(path, fill)

    def free_bytes(self, folder: Path) -> int:
        return 0 if self.is_full else 10**12


def test_a_card_that_fills_up_costs_no_run(tmp_path: Path) -> None:
    disk = FillableDisk()
    with Unit(config_of(tmp_path, imu=[]), disk=disk) as unit:
        run_id = unit.arm().run_id
        unit.wait_for("recording")
        disk.is_full = True
        unit.wait_for("fault")
        assert (
            "No space left" in unit.recorder.status().reason
            and "kept in memory" in unit.recorder.status().reason
        )
        reply = unit.ask("arm", "", None)
        assert isinstance(reply, Refusal) and "fault" in reply.message
        disk.is_full = False
        assert isinstance(unit.ask("disarm"), Disarmed)
        run = read_run(unit.store.runs / run_id, verify_hashes=True)
    assert run.manifest.state == "complete" and run.frames is not None and run.edges_ns.size >= 220
