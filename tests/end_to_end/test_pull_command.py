"""The command line as a person and as a script meet it."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from fake_unit import FakeUnit
from run_folders import contents, make_run
from small_videos import HEIGHT, WIDTH, write_video
from typer.testing import CliRunner

from bricktrack_common.errors import VideoError
from bricktrack_common.run_folder import read_run
from bricktrack_common.wire_messages import HealthItem, Read
from bricktrack_host.cli import app
from bricktrack_host.cli.main import make_pull_command

BRICKTRACK = [sys.executable, "-m", "bricktrack_host.cli"]


@pytest.fixture
def card(tmp_path):
    make_run(tmp_path / "card", "fake_0001_a", {"video.h264": 700_000})
    make_run(tmp_path / "card", "fake_0002_b", {"video.h264": 10})
    return tmp_path / "card"


def invoke(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_status_tells_people_and_scripts_the_same(card):
    with FakeUnit(card) as unit:
        seen = invoke("status", "--address", unit.address)
        told = json.loads(invoke("status", "--address", unit.address, "--json").stdout)
    assert seen.exit_code == 0
    assert "fake" in seen.stdout
    assert "idle" in seen.stdout
    assert told["units"][0]["answers"] is True
    assert told["units"][0]["status"]["state"] == "idle"
    assert told["units"][0]["status"]["runs"] == 2


def test_status_shows_the_worst_of_a_units_health_and_all_of_it_to_scripts(card):
    with FakeUnit(card) as unit:
        unit.health = [
            HealthItem(name="clocks", level="ok", words="1 us"),
            HealthItem(name="temperature", level="warn", words="78.0 °C", remedy="Give the unit air"),
        ]
        seen = invoke("status", "--address", unit.address)
        told = json.loads(invoke("status", "--address", unit.address, "--json").stdout)
        unit.health.append(HealthItem(name="storage", level="fail", words="full", remedy="Pull runs"))
        worse = invoke("status", "--address", unit.address)
    assert seen.exit_code == 0
    assert "warn: temperature" in " ".join(seen.stdout.split())
    assert "Give the unit air" in seen.stderr
    assert [h["level"] for h in told["units"][0]["status"]["health"]] == ["ok", "warn"]
    assert "fail: storage" in " ".join(worse.stdout.split())


def test_status_of_a_silent_unit_exits_with_1_and_still_shows_the_others(card, tmp_path):
    fleet = tmp_path / "fleet.toml"
    with FakeUnit(card) as unit:
        fleet.write_text(
            f'[[unit]]\nname = "fake"\naddress = "{unit.address}"\n'
            '[[unit]]\nname = "gone"\naddress = "tcp://127.0.0.1:9"\n'
        )
        result = invoke("status", "--fleet", fleet, "--timeout", 0.3)
        told = json.loads(invoke("status", "--fleet", fleet, "--timeout", 0.3, "--json").stdout)
    assert result.exit_code == 1
    assert "idle" in result.stdout
    assert "no answer" in result.stdout
    assert "no connection in time" in result.stderr
    assert [u["answers"] for u in told["units"]] == [True, False]


def test_arm_says_what_is_missing_and_disarm_brings_it_back(card):
    with FakeUnit(card) as unit:
        armed = invoke("arm", "--address", unit.address, "--label", "x")
        assert armed.exit_code == 0
        assert "armed, run fake_0001_x" in armed.stdout
        assert "without imu base" in armed.stderr
        assert unit.state == "armed"
        assert invoke("disarm", "--address", unit.address).exit_code == 0
        assert unit.state == "idle"


def test_arm_with_wait_returns_when_the_run_is_saved(card):
    with FakeUnit(card) as unit:

        def record():
            while unit.state != "armed":
                time.sleep(0.01)
            make_run(card, "fake_0001_x", {"video.h264": 100})

        thread = threading.Thread(target=record)
        thread.start()
        result = invoke("arm", "--address", unit.address, "--label", "x", "--wait")
        thread.join()
    assert result.exit_code == 0
    assert "fake_0001_x complete" in result.stdout


def test_arm_with_wait_tells_when_the_run_never_came(card):
    with FakeUnit(card) as unit:
        arm = threading.Timer(0.5, lambda: setattr(unit, "state", "idle"))
        arm.start()
        result = invoke("arm", "--address", unit.address, "--label", "x", "--wait")
    assert result.exit_code == 1
    assert "fake_0001_x was not recorded" in result.stderr


def test_pull_brings_all_runs_and_then_has_nothing_to_do(card, tmp_path):
    runs = tmp_path / "runs"
    with FakeUnit(card) as unit:
        first = invoke("pull", "--address", unit.address, "-o", runs)
        again = invoke("pull", "--address", unit.address, "-o", runs)
    assert (first.exit_code, again.exit_code) == (0, 0)
    assert first.stdout.count("pulled") == 2
    assert again.stdout.count("already here") == 2
    for name in ("fake_0001_a", "fake_0002_b"):
        assert contents(runs / name) == contents(card / name)


def test_pull_of_an_unknown_run_exits_with_1(card, tmp_path):
    with FakeUnit(card) as unit:
        result = invoke("pull", "--address", unit.address, "-o", tmp_path / "runs", "--run", "fake_0009")
    assert result.exit_code == 1
    assert "no unit has the run fake_0009" in result.stderr


def test_pull_hands_each_run_that_came_to_the_processing(card, tmp_path):
    import typer

    seen = []

    def process(unit, pulled):
        seen.append(pulled.run_id)
        if pulled.run_id == "fake_0001_a":
            raise VideoError("no picture")

    one = typer.Typer()
    one.command()(make_pull_command(process))
    with FakeUnit(card) as unit:
        arguments = ["--address", unit.address, "-o", str(tmp_path / "runs"), "--process"]
        result = CliRunner().invoke(one, arguments)
    assert seen == ["fake_0001_a", "fake_0002_b"]
    assert result.exit_code == 1
    assert "fake_0001_a: no picture" in result.stderr


def test_ctrl_c_ends_in_one_line_and_130_and_can_be_resumed(card, tmp_path):
    runs = tmp_path / "runs"
    under_way = threading.Event()

    def stall(request, messages):
        if isinstance(request, Read) and request.offset >= 500_000:
            under_way.set()
            return []
        return messages

    with FakeUnit(card, misbehave=stall) as unit:
        host = subprocess.Popen(
            [*BRICKTRACK, "pull", "--address", unit.address, "-o", str(runs), "--timeout", "30"],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert under_way.wait(20)
        host.send_signal(signal.SIGINT)
        _, stderr = host.communicate(timeout=20)
        assert host.returncode == 130
        assert "goes on from there" in " ".join(stderr.split())
        assert "Traceback" not in stderr
        unit.misbehave = lambda request, messages: messages
        n_reads = len(unit.reads())
        assert invoke("pull", "--address", unit.address, "-o", runs).exit_code == 0
        assert (
            min(r.offset for r in unit.reads()[n_reads:] if r.run_id == "fake_0001_a" and r.file_index == 1)
            > 0
        )
    assert contents(runs / "fake_0001_a") == contents(card / "fake_0001_a")


def test_an_error_is_one_red_line_without_a_traceback(tmp_path):
    done = subprocess.run(
        [*BRICKTRACK, "status"], cwd=tmp_path, capture_output=True, text=True, timeout=60,
        env={k: v for k, v in os.environ.items() if k != "BRICKTRACK_FLEET"},
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.startswith("Error: no fleet file fleet.toml")
    assert done.stderr.count("\n") == 1


def test_a_bug_keeps_its_traceback(tmp_path):
    code = "import bricktrack_host.cli.status as f; f.choose_units = None; from bricktrack_host.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, "status"], cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 1
    assert done.stderr.startswith("Traceback")


def test_usage_errors_exit_with_2():
    assert invoke("pull", "--nonsense").exit_code == 2


@pytest.mark.parametrize(
    "command",
    ["find", "status", "still", "configure", "arm", "disarm", "pull", "delete", "import", "calibrate"],
)
def test_every_command_has_help_with_an_example(command):
    result = invoke(command, "--help")
    assert result.exit_code == 0
    assert command == "calibrate" or f"bricktrack {command}" in result.stdout


def import_arguments(folder: Path, *more: str) -> list[str]:
    write_video(folder / "v.h264", 5)
    (folder / "t.txt").write_text("0\n33327\n66654\n99981\n133308\n")
    return [
        "import", "--video", str(folder / "v.h264"), "--timestamps", str(folder / "t.txt"), "--unit", "b1",
        "--label", "x", "-o", str(folder / "runs"), *more,
    ]  # fmt: skip


EXPLICIT = (
    "--exposure-us", "4000", "--line-time-us", "18.9", "--first-sensor-timestamp-ns", "5000", "--width",
    str(WIDTH), "--height", str(HEIGHT),
)  # fmt: skip


def test_import_with_explicit_options_makes_a_run(tmp_path):
    (tmp_path / "imu.csv").write_text(
        "t_ns,ax_mps2,ay_mps2,az_mps2,gx_dps,gy_dps,gz_dps\n"
        + "".join(f"{i * 10_000_000},{i}.01,0,-9.81,0,0.0625,0\n" for i in range(5))
    )
    (tmp_path / "edges.csv").write_text("t_ns\n100\n200\n")
    result = invoke(
        *import_arguments(
            tmp_path, *EXPLICIT, "--real", "--imu", str(tmp_path / "imu.csv"),
            "--imu", f"base={tmp_path / 'imu.csv'}", "--edges", str(tmp_path / "edges.csv"),
        )
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    assert "real run of 5 frames (0 dropped), 10 inertial samples, 2 edges" in result.stdout
    run = read_run(tmp_path / "runs" / "b1_x", verify_hashes=True)
    assert run.frames.sensor_timestamp_ns.tolist() == [5000 + 33_327_000 * i for i in range(5)]
    assert sorted(run.imus) == ["base", "brick"]
    assert run.edges_ns.tolist() == [100, 200]
    assert not run.manifest.simulated
    assert run.problems == []


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (EXPLICIT, "say --real or --simulated"),
        ((*EXPLICIT[:4], "--real"), "give --rig, or --first-sensor-timestamp-ns, --width, --height"),
        ((*EXPLICIT, "--real", "--label", "../up"), "run id 'b1_../up'"),
    ],
)
def test_import_asks_for_what_it_must_not_guess(tmp_path, more, words):
    result = invoke(*import_arguments(tmp_path, *more))
    assert result.exit_code == 1
    assert words in result.stderr
    assert not (tmp_path / "runs").exists()


def test_a_rig_file_and_the_same_by_option_do_not_mix(tmp_path):
    rig = tmp_path / "rig.toml"
    rig.write_text(
        f"simulated = true\n[sensor]\nwidth = {WIDTH}\nheight = {HEIGHT}\nexposure_us = 4000\nline_time_us = 18.9\n"
        "[motion]\nfirst_sensor_timestamp_ns = 7\n"
    )
    result = invoke(*import_arguments(tmp_path, "--rig", str(rig), "--width", str(WIDTH)))
    assert result.exit_code == 1
    assert "--width: the rig file" in result.stderr
    result = invoke(*import_arguments(tmp_path, "--rig", str(rig), "--real"))
    assert result.exit_code == 1
    assert "says the opposite" in result.stderr
    assert invoke(*import_arguments(tmp_path, "--rig", str(rig))).exit_code == 0
    assert read_run(tmp_path / "runs" / "b1_x").manifest.simulated


def test_ctrl_c_does_not_wait_for_a_unit_that_does_not_answer(card):
    asked = threading.Event()

    def silent(request, messages):
        asked.set()
        return []

    with FakeUnit(card, misbehave=silent) as unit:
        host = subprocess.Popen(
            [*BRICKTRACK, "arm", "--address", unit.address, "--timeout", "60"],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert asked.wait(20)
        began = time.monotonic()
        host.send_signal(signal.SIGINT)
        _, stderr = host.communicate(timeout=20)
    assert host.returncode == 130
    assert stderr == "Interrupted.\n"
    assert time.monotonic() - began < 10
