import os
from pathlib import Path

import numpy as np
import pytest
from device_fakes import FakeRig

from bricktrack_device.backends import open_rig
from bricktrack_device.capture import black_box
from bricktrack_device.config import DeviceConfig, RecordingTable, SamplerTable, StorageTable
from bricktrack_device.hardware.yuv import split_i420
from bricktrack_device.health import machine, storage
from bricktrack_device.health.blobs import channel_levels, find_blobs
from bricktrack_device.health.camera import check_camera, judge_still
from bricktrack_device.health.findings import CheckResult, worst
from bricktrack_device.health.inertial import check_adapter
from bricktrack_device.health.report import as_report
from bricktrack_device.health.trigger_line import judge_wave
from bricktrack_device.health.watch import HealthWatch
from bricktrack_device.interfaces import Still
from bricktrack_device.sim.settings import SimSettings

CONFIG = DeviceConfig()


def still_of(luma: np.ndarray, *, red: float = 0.0) -> Still:
    half = tuple(n // 2 for n in luma.shape)
    lit = luma.reshape(half[0], 2, half[1], 2).max(axis=(1, 3)) > 60
    v = np.where(lit, 128 + red, 128).astype(np.uint8)
    return Still(luma, np.full(half, 128, dtype=np.uint8), v)


def discs(*places: tuple[int, int, int], level: int = 200, background: int = 20) -> np.ndarray:
    luma = np.full((1080, 1920), background, dtype=np.uint8)
    v, u = np.mgrid[0:1080, 0:1920]
    for u0, v0, radius in places:
        luma[np.hypot(u - u0, v - v0) < radius] = level
    return luma


class TestBlobs:
    def test_discs_are_counted_where_they_are_and_as_large_as_they_are(self) -> None:
        blobs = find_blobs(channel_levels(still_of(discs((300, 200, 35), (900, 800, 35), (1500, 500, 30)))))
        assert [round(b.u_px / 10) for b in blobs] == [30, 90, 150]
        assert [round(b.v_px / 10) for b in blobs] == [20, 80, 50]
        # Half resolution: one of its pixels is two of the picture's.
        assert [b.diameter_px for b in blobs] == pytest.approx([70, 70, 60], abs=2)
        assert all(b.saturated == 0 for b in blobs)

    def test_rings_bars_and_specks_are_no_leds(self) -> None:
        luma = discs((300, 200, 35), (900, 800, 35))
        v, u = np.mgrid[0:1080, 0:1920]
        luma[abs(np.hypot(u - 1500, v - 300) - 80) < 10] = 220
        luma[900:960, 300:500] = 220
        luma[100:104, 1000:1004] = 235
        assert len(find_blobs(channel_levels(still_of(luma)))) == 2

    def test_two_parts_that_meet_far_down_are_one(self) -> None:
        luma = np.full((200, 200), 20, dtype=np.uint8)
        luma[40:160, 60:80] = luma[40:160, 130:150] = luma[140:160, 60:150] = 220  # a U: not round
        assert find_blobs(channel_levels(still_of(luma))) == []

    def test_an_even_picture_has_none(self) -> None:
        assert find_blobs(channel_levels(still_of(discs(background=120)))) == []

    def test_a_red_led_is_as_bright_as_its_channel(self) -> None:
        # BT.709 limited: full red is Y = 16 + 219 * 0.2126 = 63, Cr = 240.
        still = still_of(discs((500, 500, 35), level=63), red=112)
        (blob,) = find_blobs(channel_levels(still))
        assert blob.peak > 250 and blob.saturated > 0.9

    @pytest.mark.parametrize(
        ("level", "background", "words"),
        [(235, 20, "saturated"), (80, 20, "too dark"), (235, 120, "room is too bright")],
    )
    def test_a_badly_exposed_still_is_told(self, level: int, background: int, words: str) -> None:
        exposure, leds = judge_still(
            still_of(discs((500, 500, 35), level=level, background=background)), expected_leds=1
        )
        assert exposure.level == "warn" and words in exposure.detail and exposure.remedy
        assert leds.level == "ok"

    def test_missing_leds_are_a_warning_with_both_counts(self) -> None:
        _, leds = judge_still(still_of(discs((500, 500, 35), (900, 500, 35))), expected_leds=7)
        assert leds.level == "warn" and "2 round" in leds.detail and "expected 7" in leds.detail


class TestMachine:
    def test_throttling_bits_are_spelled_out(self) -> None:
        # From the firmware's documentation: 0x50005 is the common "bad supply" word.
        (found,) = machine.check_throttling(0x50005)
        assert found.level == "fail" and "voltage is too low now" in found.detail
        assert "throttled now" in found.detail and "since boot" in found.detail and "supply" in found.remedy
        (past,) = machine.check_throttling(0x80000)
        assert (
            past.level == "warn" and "temperature limit was active" in past.detail and "Cool" in past.remedy
        )
        assert machine.check_throttling(0)[0].level == "ok"
        assert machine.check_throttling(None)[0].detail == "not available here"

    def test_throttling_is_read_from_the_kernels_file(self, tmp_path: Path) -> None:
        path = tmp_path / "get_throttled"
        path.write_text("50005\n")
        assert machine.read_throttled(path) == 0x50005
        assert machine.read_throttled(tmp_path / "none") is None

    def test_vcgencmd_is_asked_where_there_is_no_file(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        program = tmp_path / "vcgencmd"
        program.write_text("#!/bin/sh\necho throttled=0x20002\n")
        program.chmod(0o755)
        monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
        assert machine.read_throttled(tmp_path / "none", may_start_process=True) == 0x20002
        assert machine.read_throttled(tmp_path / "none") is None

    @pytest.mark.parametrize(("milli", "level"), [(50_000, "ok"), (78_000, "warn"), (83_500, "fail")])
    def test_heat_is_judged(self, tmp_path: Path, milli: int, level: str) -> None:
        path = tmp_path / "temp"
        path.write_text(f"{milli}\n")
        (found,) = machine.check_temperature(path)
        assert found.level == level and f"{milli / 1000:.1f} °C" in found.detail

    def test_closed_device_nodes_fail_and_missing_groups_warn(self, tmp_path: Path) -> None:
        node = tmp_path / "gpiochip0"
        node.touch()
        nodes = [f"{tmp_path}/gpiochip*"]
        (closed,) = machine.check_permissions(
            [], nodes=nodes, is_root=False, access=lambda path, mode: False, groups=lambda: ["video"]
        )
        assert closed.level == "fail" and str(node) in closed.detail and "gpio,i2c USER" in closed.remedy
        (missing,) = machine.check_permissions(
            [], nodes=nodes, is_root=False, groups=lambda: ["video", "gpio"]
        )
        assert missing.level == "warn" and "i2c" in missing.detail
        (fine,) = machine.check_permissions([], nodes=nodes, is_root=False, groups=lambda: machine.GROUPS)
        assert fine.level == "ok" and "1 device nodes" in fine.detail

    def test_refused_rights_are_a_warning_that_says_why(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(*_: object) -> None:
            raise PermissionError(1, "Operation not permitted")

        monkeypatch.setattr(os, "sched_setscheduler", refuse)
        (found,) = machine.check_realtime(SamplerTable(lock_memory=False))
        assert found.level == "warn" and "SCHED_FIFO 50 refused (Operation not permitted)" in found.detail
        assert "LimitRTPRIO" in found.remedy

    def test_trying_leaves_this_process_as_it_was(self) -> None:
        before = os.sched_getscheduler(0)
        machine.check_realtime(SamplerTable())
        assert os.sched_getscheduler(0) == before
        locked = next(
            line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmLck")
        )
        assert locked.split()[1] == "0"


class TestStorage:
    def test_speed_is_bytes_over_synced_time_and_nothing_stays(self, tmp_path: Path) -> None:
        ticks = iter([0, 500_000_000])
        speed = storage.write_speed_bps(tmp_path, n_bytes=3_000_000, clock=lambda: next(ticks))
        assert speed == 6_000_000 and list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize(("speed_bps", "level"), [(20e6, "ok"), (1.2e6, "warn"), (0.3e6, "fail")])
    def test_a_slow_card_is_judged_by_how_long_a_run_takes(self, speed_bps: float, level: str) -> None:
        # 16 s at 12 Mbit/s are 24 MB: 1.2, 20 and 80 s.
        (found,) = storage.check_speed(CONFIG, speed_bps)
        assert found.level == level and (found.remedy == "") == (level == "ok")

    def test_little_room_is_a_failure(self, tmp_path: Path) -> None:
        config = DeviceConfig(
            storage=StorageTable(folder=str(tmp_path), margin_mb=10**8), recording=RecordingTable()
        )
        assert storage.check_space(config)[0].level == "fail"

    def test_no_room_in_memory_for_a_copy_of_a_run_is_a_warning(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
        assert storage.check_black_box(CONFIG) == []  # none is kept
        table = StorageTable(black_box=str(tmp_path / "not" / "yet"))
        config = DeviceConfig(storage=table)
        (found,) = storage.check_black_box(config)
        assert found.level == "ok" and str(tmp_path) in found.detail
        monkeypatch.setattr(black_box, "memory_available_bytes", lambda: 30_000_000)
        (found,) = storage.check_black_box(config)  # 16 s at 12 Mbit/s are 24 MB
        assert found.level == "warn" and "30 MB" in found.detail and "48 MB" in found.detail


class TestTriggerLine:
    def test_a_wave_is_told_by_its_rate(self) -> None:
        edges = [k * 5_000_000 for k in range(200)]
        found = judge_wave(edges, listen_s=1.0, level="low", nominal_hz=200.0)
        assert found.level == "ok" and "200 rising edges" in found.detail and "200.000 Hz" in found.detail
        other = judge_wave(edges, listen_s=1.0, level="low", nominal_hz=50.0)
        assert other.level == "warn" and "expected 50 Hz" in other.detail

    def test_a_wave_with_extra_edges_a_glitch_and_a_stuck_line_are_warnings(self) -> None:
        edges = sorted([k * 5_000_000 for k in range(100)] + [7_000_001, 52_000_000])
        assert "2 intervals" not in judge_wave(edges, listen_s=0.5, level="low", nominal_hz=None).detail
        assert judge_wave(edges, listen_s=0.5, level="low", nominal_hz=None).level == "warn"
        assert judge_wave([5], listen_s=1, level="low", nominal_hz=None).level == "warn"
        assert judge_wave([], listen_s=1, level="high", nominal_hz=None).level == "warn"
        assert judge_wave([], listen_s=1, level="low", nominal_hz=50).level == "ok"


def test_the_adapter_is_told_from_the_rigs_account() -> None:
    imu = CONFIG.imu[0]
    good = {"i2c./dev/i2c-3": "i2c@3 (i2c-gpio)"}
    assert check_adapter(imu, good, simulated=False)[0].level == "ok"
    bad = {"i2c./dev/i2c-3": "bcm2835 (i2c@7e804000) (i2c-bcm2835)"}
    assert check_adapter(imu, bad, simulated=False)[0].level == "warn"
    assert check_adapter(imu, {}, simulated=False)[0].level == "fail"


def test_planes_of_a_padded_still_are_cut_apart() -> None:
    # 8 x 4 px in rows of 12 bytes: luma counts pixels, u is 100 + i, v is 200 + i, padding 255.
    width, height, stride = 8, 4, 12
    array = np.full((6, stride), 255, dtype=np.uint8)
    array[:4, :8] = np.arange(32).reshape(4, 8)
    chroma = array[4:].reshape(2, 2, 6)
    chroma[0, :, :4] = 100 + np.arange(8).reshape(2, 4)
    chroma[1, :, :4] = 200 + np.arange(8).reshape(2, 4)
    still = split_i420(array, (width, height))
    assert still.luma.tolist() == np.arange(32).reshape(4, 8).tolist()
    assert still.chroma_u.ravel().tolist() == list(range(100, 108))
    assert still.chroma_v.ravel().tolist() == list(range(200, 208))


class TestWatch:
    def test_it_looks_again_only_when_due_and_never_while_the_unit_works(self, tmp_path: Path) -> None:
        now = [100.0]
        config = DeviceConfig(storage=StorageTable(folder=str(tmp_path), margin_mb=1))
        watch = HealthWatch(config, FakeRig(), period_s=30, clock=lambda: now[0])
        assert watch.items == [] and watch.age_s is None
        for state in ("armed", "recording", "saving"):
            assert not watch.refresh_if_due(state)
        assert watch.refresh_if_due("idle") and watch.age_s == 0
        now[0] += 29
        assert not watch.refresh_if_due("idle")
        now[0] += 2
        assert not watch.refresh_if_due("recording") and watch.age_s == 31
        assert watch.refresh_if_due("fault") and watch.age_s == 0
        names = {item.name for item in watch.items}
        assert {"clocks", "storage", "temperature", "throttling", "real-time rights"} <= names

    def test_a_full_card_shows_with_its_remedy(self, tmp_path: Path) -> None:
        config = DeviceConfig(storage=StorageTable(folder=str(tmp_path), margin_mb=10**8))
        watch = HealthWatch(config, FakeRig())
        watch.refresh_if_due("idle")
        (item,) = [i for i in watch.items if i.name == "storage"]
        assert item.level == "fail" and "MB free" in item.words and item.remedy


def test_a_warning_does_not_fail_the_whole_check() -> None:
    lines = [CheckResult(name="a", level="ok", detail="x"), CheckResult(name="b", level="warn", detail="y")]
    report = as_report("unit", lines, simulated=True)
    assert report.ok and report.level == "warn" and worst([]) == "ok"
    assert not as_report("u", [CheckResult(name="c", level="fail", detail="z")], simulated=True).ok


@pytest.mark.parametrize(
    ("led_level", "level", "words"), [(0.7, "ok", "0 % of their pixels"), (4.0, "warn", "saturated")]
)
def test_saturated_leds_of_a_simulated_unit_are_told_by_its_check(
    led_level: float, level: str, words: str
) -> None:
    config = DeviceConfig(backend="sim", sim=SimSettings(led_level=led_level))
    rig = open_rig(config)
    try:
        found = {r.name: r for r in check_camera(config, rig, stream_s=0.5)}
    finally:
        rig.close()
    assert found["exposure"].level == level and words in found["exposure"].detail


def test_a_bug_in_a_check_is_a_finding_and_does_not_end_the_daemon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def break_down(path: Path | None = None) -> None:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(machine, "check_temperature", break_down)
    config = DeviceConfig(storage=StorageTable(folder=str(tmp_path)))
    watch = HealthWatch(config, FakeRig())
    assert watch.refresh_if_due("idle")
    (item,) = watch.items
    assert item.level == "warn" and "ZeroDivisionError: a bug" in item.words
