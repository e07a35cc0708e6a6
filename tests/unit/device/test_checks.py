from pathlib import Path

import numpy as np
import pytest
from device_fakes import FakeBusOpener, FakeCamera, FakeRig

from bricktrack_common.run_manifest import CameraSection
from bricktrack_device.checks import run_checks
from bricktrack_device.config import DeviceConfig, ImuTable, ServerTable, StorageTable, TriggerTable
from bricktrack_device.health import camera, storage, trigger_line
from bricktrack_device.health.findings import CheckResult
from bricktrack_device.interfaces import FrameMetadata, FrameSink, Still
from bricktrack_device.network.file_server import FileServer


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera, "CAMERA_CHECK_S", 0.4)
    monkeypatch.setattr(storage, "SPEED_TEST_BYTES", 1 << 20)
    monkeypatch.setattr(
        trigger_line.check_trigger, "__kwdefaults__", {"listen_s": 0.05, "sleep": lambda s: None}
    )


def check(folder: Path, rig: FakeRig, **changes: object) -> dict[str, CheckResult]:
    tables: dict[str, object] = {
        "storage": StorageTable(folder=str(folder), margin_mb=1),
        "server": ServerTable(port=0),
        "imu": [ImuTable(name="brick", bus="a")],
    }
    return {r.name: r for r in run_checks(DeviceConfig(**(tables | changes)), rig)}  # type: ignore[arg-type]


def seven_leds() -> Still:
    luma = np.full((1080, 1920), 30, dtype=np.uint8)
    v, u = np.mgrid[0:1080, 0:1920]
    for k in range(7):
        luma[np.hypot(u - 300 - 200 * k, v - 400 - 40 * k) < 35] = 200
    grey = np.full((540, 960), 128, dtype=np.uint8)
    return Still(luma, grey, grey)


def test_a_good_unit_passes_every_check(tmp_path: Path) -> None:
    good = FakeCamera()
    good.picture = seven_leds()
    results = check(tmp_path, FakeRig(camera=good))
    # Temperature, supply and rights are this machine's own; the rest must be well.
    machine = {"temperature", "throttling", "real-time rights", "storage speed"}
    assert set(results) - machine == {
        "clocks", "storage", "port", "keys", "permissions", "trigger", "trigger line", "camera", "sensor mode",
        "exposure", "leds", "imu brick", "bus of imu brick", "versions",
    }  # fmt: skip
    assert machine < set(results)
    assert all(
        r.level == "ok" and r.detail and not r.remedy for n, r in results.items() if n not in machine
    ), results
    assert "0xA0" in results["imu brick"].detail and "self-test passed" in results["imu brick"].detail
    assert results["trigger"].detail == "GPIO17 reads low through MockFactory"
    assert "7 round bright spots" in results["leds"].detail
    assert "numpy" in results["versions"].detail


def test_each_failure_is_told_with_a_remedy_and_stops_no_other(tmp_path: Path) -> None:
    server = FileServer("127.0.0.1", 0, None)  # type: ignore[arg-type]
    try:
        results = check(
            tmp_path,
            FakeRig(camera=FakeCamera(fail="no cable"), buses={"a": FakeBusOpener(present=False)}),
            server=ServerTable(port=server.port),
            storage=StorageTable(folder=str(tmp_path), margin_mb=10**9),
            trigger=TriggerTable(pin="GPIO99"),
        )
    finally:
        server.stop()
    failed = {name for name, r in results.items() if not r.ok and name != "temperature"}
    assert failed == {"storage", "port", "trigger", "camera", "imu brick"}
    assert all(r.remedy for r in results.values() if r.level != "ok")


def test_a_camera_whose_exposure_wanders_fails(tmp_path: Path) -> None:
    class Wandering(FakeCamera):
        def start(self, sink: FrameSink) -> CameraSection:
            section = super().start(sink)
            sink.on_metadata(FrameMetadata(1, 2500, 1.0, self.period_us))
            return section

    result = check(tmp_path, FakeRig(camera=Wandering()))["camera"]
    assert not result.ok and "exposure wanders: 2500 µs; expected 2000 µs" in result.detail


def test_a_camera_at_another_rate_than_it_says_fails(tmp_path: Path) -> None:
    class Slow(FakeCamera):
        def start(self, sink: FrameSink) -> CameraSection:
            section = super().start(sink)
            self.period_us = 40_000
            return section

    result = check(tmp_path, FakeRig(camera=Slow()))["camera"]
    assert not result.ok and "expected 33327 µs" in result.detail


def test_a_sensor_that_failed_its_self_test_is_named(tmp_path: Path) -> None:
    opener = FakeBusOpener()

    def open_bad() -> object:
        bus = opener()
        bus.pages[0][0x36] = 0x0B  # type: ignore[attr-defined]  # gyroscope's bit missing, data sheet 4.3.59
        return bus

    rig = FakeRig(buses={"a": open_bad})  # type: ignore[dict-item]
    result = check(tmp_path, rig)["imu brick"]
    assert result.level == "fail" and "not passed: gyroscope (ST_RESULT 0x0B)" in result.detail
