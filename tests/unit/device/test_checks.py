from pathlib import Path

import pytest
from device_fakes import FakeBusOpener, FakeCamera, FakeRig

from bricktrack_common.run_manifest import CameraSection
from bricktrack_device import checks
from bricktrack_device.checks import CheckResult, run_checks
from bricktrack_device.config import DeviceConfig, ImuTable, ServerTable, StorageTable, TriggerTable
from bricktrack_device.file_server import FileServer
from bricktrack_device.interfaces import FrameMetadata, FrameSink


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "CAMERA_CHECK_S", 0.5)


def check(folder: Path, rig: FakeRig, **changes: object) -> dict[str, CheckResult]:
    tables: dict[str, object] = {
        "storage": StorageTable(folder=str(folder)),
        "server": ServerTable(port=0),
        "imu": [ImuTable(name="brick", bus="a")],
    }
    return {r.name: r for r in run_checks(DeviceConfig(**(tables | changes)), rig)}  # type: ignore[arg-type]


def test_a_good_unit_passes_every_check(tmp_path: Path) -> None:
    results = check(tmp_path, FakeRig())
    assert list(results) == ["clocks", "storage", "port", "trigger", "camera", "imu brick"]
    assert all(r.ok and r.detail and not r.remedy for r in results.values()), results
    assert "0xA0" in results["imu brick"].detail and "low" in results["trigger"].detail


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
    assert {name for name, r in results.items() if not r.ok} == {
        "storage", "port", "trigger", "camera", "imu brick",
    }  # fmt: skip
    assert all(r.remedy for r in results.values() if not r.ok)
    assert str(server.port) in results["port"].detail and "no cable" in results["camera"].detail


def test_a_camera_whose_exposure_wanders_fails(tmp_path: Path) -> None:
    class Wandering(FakeCamera):
        def start(self, sink: FrameSink) -> CameraSection:
            section = super().start(sink)
            sink.on_metadata(FrameMetadata(10**18, 2500, 1.0, self.period_us))
            return section

    result = check(tmp_path, FakeRig(camera=Wandering()))["camera"]
    assert not result.ok and "exposure wanders: 2500 us; expected 2000 us" in result.detail


def test_a_camera_at_another_rate_than_it_says_fails(tmp_path: Path) -> None:
    class Slow(FakeCamera):
        def start(self, sink: FrameSink) -> CameraSection:
            section = super().start(sink)
            self.period_us = 40_000
            return section

    result = check(tmp_path, FakeRig(camera=Slow()))["camera"]
    assert not result.ok and "expected 33327 us" in result.detail
