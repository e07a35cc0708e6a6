"""The how-to pages of calibrating, timing, test days and the control page: their commands, as they stand."""

import shutil
import subprocess
import threading
import time
from functools import partial

import cv2
import pytest
from board_pictures import BoardPose, Faults, camera_of, picture_of_board
from fake_unit import FakeUnit
from light_fleet import LightFleet, write_fleet_file
from page_commands import ROOT, type_all
from small_lab import example

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_device.timing import imu_test
from bricktrack_host.assemblies.combined_summary import read_test
from bricktrack_host.calibration.calibration_file import load_calibration
from bricktrack_host.calibration.target.printed_target import load_target
from bricktrack_host.cli import test_day
from bricktrack_host.results.result_store import write_results
from bricktrack_host.transfer.unit_client import UnitClient


@pytest.mark.slow
def test_a_camera_is_calibrated_and_checked(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "card").mkdir()

    def show(unit, z_mm, seed):
        # Drawn at half the camera's size, in a quarter of the time, and enlarged.
        board = load_target(tmp_path / "target.toml")
        drawn = picture_of_board(
            board, camera_of(), BoardPose((0.0, 0.0, z_mm)), faults=Faults(seed=seed), samples=2
        )
        full = cv2.resize(drawn.grey, (1920, 1080), interpolation=cv2.INTER_CUBIC)
        unit.picture = cv2.imencode(".png", full)[1].tobytes()

    with FakeUnit(tmp_path / "card", name="b1") as unit:
        unit.camera_mode = IMX219_1080P.name
        write_fleet_file(tmp_path / "fleet.toml", {"b1": unit.port})
        said = type_all("calibrate.md", before={
            "101.117": partial(show, unit, 101.117, seed=1),
            "161.111": partial(show, unit, 161.111, seed=2),
            "check": partial(shutil.copytree, "pictures-b1", "pictures-b1-in-march"),
        })  # fmt: skip
    assert load_calibration(tmp_path / "b1.json").focus_note == "ring at 126 mm"
    assert "The calibration holds." in list(said.values())[-1]


def test_a_units_sampler_is_measured(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "unit.toml").write_text('backend = "sim"\n[[imu]]\nname = "brick"\nperiod_ms = 2\n')
    # A hundred slots of 2 ms a loop in place of ten thousand of 10 ms.
    measure = imu_test.run_imu_test
    monkeypatch.setattr(imu_test, "run_imu_test", lambda *a, **k: measure(*a, **k | {"n_slots": 100}))
    [said] = type_all("timing-tests.md", instead={"/etc/bricktrack/bricktrackd.toml": "unit.toml"}).values()
    assert "SIMULATED" in said
    for loop in ("grid", "naive", "adaptive"):
        assert loop in said


def test_a_test_day_goes_from_look_to_report(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blank = example.example_result()

    def process(runs, *, fleet, where):
        for run in runs:
            write_results(blank, run / "results")
        return 0

    monkeypatch.setattr(test_day, "process_folders", process)  # processing has tests of its own
    names = ["b7-1", "b8-1"]
    shaking = []

    def shake_once_all_are_armed(units):
        clients = [UnitClient(f"tcp://127.0.0.1:{port}") for port in units.ports.values()]
        try:
            while any(client.status().state != "armed" for client in clients):
                time.sleep(0.02)
        finally:
            for client in clients:
                client.close()
        units.trigger(10_000)

    def start_to_shake(units):
        shaking.append(threading.Thread(target=shake_once_all_are_armed, args=(units,), daemon=True))
        shaking[0].start()

    with LightFleet(tmp_path / "cards", names, n_processes=1) as units:
        write_fleet_file(tmp_path / "fleet.toml", units.ports)
        said = list(type_all("test-day.md", before={"arm": partial(start_to_shake, units)}).values())
    shaking[0].join()
    assert "2 of 2 units are ready" in said[0]
    assert "2 of 2 runs are here" in said[3]
    assert [unit.unit for unit in read_test(tmp_path / "tests" / "shake-12" / "combined").units] == names


def test_the_control_page_is_offered_as_told(tmp_path, monkeypatch):
    server = pytest.importorskip("bricktrack_host.dashboard.server")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lab").mkdir()
    for fleet in (tmp_path / "fleet.toml", tmp_path / "lab" / "fleet.toml"):
        write_fleet_file(fleet, {"b1": 41733})
    (tmp_path / "page.txt").write_text("ten letters and more\n")
    page = (ROOT / "docs" / "how-to" / "dashboard.md").read_text()
    if shutil.which("openssl") is None:
        pytest.skip("no openssl here")
    [made] = [line[2:] for line in page.splitlines() if line.startswith("$ openssl")]
    subprocess.run(made.split(), check=True, capture_output=True)
    served = []

    def serve(site, units, dialer, *, fleet, lab, every_s, on_ready):  # serving has tests of its own
        served.append((site.host, site.port, [unit.name for unit in units], lab))

    monkeypatch.setattr(server, "serve", serve)
    type_all("dashboard.md")
    assert served == [
        ("127.0.0.1", 8383, ["b1"], tmp_path),
        ("127.0.0.1", 9000, ["b1"], tmp_path / "lab"),
        ("0.0.0.0", 8383, ["b1"], tmp_path),
    ]
