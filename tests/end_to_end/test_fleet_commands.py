"""The commands that set units up, over the real protocol: still, configure, delete, and many units at once."""

import contextlib
import json
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import msgpack
import numpy as np
import pytest
from fake_unit import FakeUnit
from light_fleet import LightFleet, write_fleet_file
from light_unit import LightUnit, make_keys
from run_folders import contents, make_run
from typer.testing import CliRunner

from bricktrack_common.checksums import sha256_file
from bricktrack_common.key_files import make_key_pair, write_secret_key
from bricktrack_common.run_manifest import MANIFEST_NAME, read_manifest
from bricktrack_common.wire_codec import encode_message
from bricktrack_common.wire_messages import Arm, DeleteRun, Refusal
from bricktrack_host.cli import app

LAYOUT_OF_SEVEN = Path(__file__).parents[1] / "data" / "path-traced" / "layout.toml"


@pytest.fixture
def card(tmp_path):
    make_run(tmp_path / "card", "fake_0001_a", {"video.h264": 1000})
    make_run(tmp_path / "card", "fake_0002_b", {"video.h264": 1000})
    return tmp_path / "card"


@pytest.fixture
def many(tmp_path):
    """Return four units, c-1 to c-3 and d-1, and the fleet file that names them."""
    names = ("c-1", "c-2", "c-3", "d-1")
    with contextlib.ExitStack() as opened:
        units = {}
        for name in names:
            make_run(tmp_path / name, f"{name}_0001", {"video.h264": 100_000}, unit=name)
            units[name] = opened.enter_context(FakeUnit(tmp_path / name, name=name))
        fleet = tmp_path / "fleet.toml"
        fleet.write_text(
            "".join(f'[[unit]]\nname = "{n}"\naddress = "{u.address}"\n' for n, u in units.items())
        )
        yield units, fleet


def invoke(*arguments, stdin=None):
    return CliRunner().invoke(app, [str(a) for a in arguments], input=stdin)


def picture_of_leds(n=3):
    luma = np.full((540, 960), 30, np.uint8)
    for i in range(n):
        cv2.circle(luma, (200 + 200 * i, 250), 25, 200, -1)
    return cv2.imencode(".png", luma)[1].tobytes()


def test_a_still_is_saved_as_it_came_and_with_its_leds_marked(card, tmp_path):
    with FakeUnit(card) as unit:
        unit.picture = picture_of_leds()
        seen = invoke("still", "-a", unit.address, "-o", tmp_path / "stills")
        told = json.loads(invoke("still", "-a", unit.address, "-o", tmp_path / "stills", "--json").stdout)
    assert seen.exit_code == 0, seen.stderr
    assert "3 LEDs" in seen.stdout
    assert "to the border: left 17" in seen.stdout  # 200 - 25 px and the rim
    assert (tmp_path / "stills" / "fake.png").read_bytes() == unit.picture
    assert cv2.imread(str(tmp_path / "stills" / "fake_leds.png")).shape == (540, 960, 3)
    one = told["units"][0]
    assert (one["n_leds"], one["simulated"]) == (3, True)
    assert [led["u_px"] for led in one["leds"]] == pytest.approx([200, 400, 600], abs=0.1)


def test_a_still_with_an_led_less_than_the_layout_has_exits_with_1(card, tmp_path):
    shutil.copy(LAYOUT_OF_SEVEN, tmp_path / "brick.toml")
    with FakeUnit(card) as unit:
        unit.picture = picture_of_leds()
        fleet = tmp_path / "fleet.toml"
        fleet.write_text(f'[[unit]]\nname = "fake"\naddress = "{unit.address}"\nlayout = "brick.toml"\n')
        result = invoke("still", "-f", fleet, "-o", tmp_path / "stills")
    assert result.exit_code == 1
    assert "3 of 7 LEDs" in result.stdout
    assert "the layout has 7 LEDs" in result.stderr


def test_a_picture_that_is_none_is_an_error_and_not_a_crash(card, tmp_path):
    with FakeUnit(card) as unit:
        unit.picture = b"nonsense"
        result = invoke("still", "-a", unit.address, "-o", tmp_path / "stills")
    assert result.exit_code == 1
    assert "expected a grey picture" in result.stderr


def test_configure_shows_changes_and_takes_back(card):
    with FakeUnit(card) as unit:
        shown = invoke("configure", "-a", unit.address)
        set_ = invoke("configure", "camera.exposure_us=1500", "recording.label=frame", "-a", unit.address)
        assert unit.settings == {"camera.exposure_us": 1500, "recording.label": "frame"}
        told = json.loads(invoke("configure", "-a", unit.address, "--json").stdout)
        back = invoke("configure", "--reset", "recording.label", "-a", unit.address)
    assert "2000" in shown.stdout
    assert "camera.exposure_us = 1500" in set_.stdout
    assert told["units"][0]["changed"] == ["camera.exposure_us", "recording.label"]
    assert back.exit_code == 0
    assert unit.changed == {"camera.exposure_us"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["camera.exposure_us"], "expected KEY=VALUE"),
        (["a=1", "a=2"], "given twice"),
        (["a=1", "--reset", "a"], "leave one out"),
        (["a={x = 1}"], "is no number, word"),
        (["camera.nonsense=1"], "cannot be configured"),
    ],
)
def test_what_cannot_be_configured_is_said(card, arguments, words):
    with FakeUnit(card) as unit:
        result = invoke("configure", *arguments, "-a", unit.address)
    assert result.exit_code == 1
    assert words in result.stderr
    assert unit.changed == set()


def test_delete_removes_what_a_host_has_and_nothing_else(card):
    with FakeUnit(card) as unit:
        unit.confirmed.add("fake_0001_a")
        result = invoke("delete", "--confirmed", "--yes", "-a", unit.address)
    assert result.exit_code == 0
    assert "1 of 1 runs deleted" in result.stdout
    assert [p.name for p in card.iterdir()] == ["fake_0002_b"]


def test_delete_of_a_run_that_no_host_has_needs_force(card):
    with FakeUnit(card) as unit:
        refused = invoke("delete", "*_b", "--yes", "-a", unit.address)
        assert (card / "fake_0002_b").exists()
        forced = invoke("delete", "*_b", "--yes", "--force", "-a", unit.address, "--json")
    assert refused.exit_code == 1
    assert "refused delete: no host has run fake_0002_b" in refused.stderr
    assert forced.exit_code == 0
    assert [d["run_id"] for d in json.loads(forced.stdout)["deleted"]] == ["fake_0002_b"]
    assert not (card / "fake_0002_b").exists()


def test_delete_asks_and_does_nothing_without_an_answer(card):
    with FakeUnit(card) as unit:
        unit.confirmed.add("fake_0001_a")
        result = invoke("delete", "--confirmed", "-a", unit.address, stdin="")
        nothing = invoke("delete", "-a", unit.address, "--yes")
    assert result.exit_code == 1
    assert "give --yes" in result.stderr
    assert "say which runs" in nothing.stderr
    assert (card / "fake_0001_a").exists()


def test_arm_takes_a_pattern_and_names_who_did_not_acknowledge(many):
    units, fleet = many

    def refuses(request, messages):
        if not isinstance(request, Arm):
            return messages
        request_id = msgpack.unpackb(messages[0][0])["request_id"]
        return [[encode_message(request_id, Refusal(code="not-ready", message="no camera"))]]

    units["c-2"].misbehave = refuses
    result = invoke("arm", "--fleet", fleet, "--unit", "c-*")
    told = json.loads(invoke("arm", "--fleet", fleet, "--unit", "c-*", "--json").stdout)
    assert result.exit_code == 1
    assert "2 of 3 units armed" in result.stdout
    assert "c-2: " in result.stderr and "no camera" in result.stderr
    assert "not armed: c-2" in result.stderr
    assert units["d-1"].state == "idle"
    assert [(u["name"], u["ok"]) for u in told["units"]] == [("c-1", True), ("c-2", False), ("c-3", True)]
    assert told["units"][1]["code"] == "not-ready"
    assert told["ok"] is False


def test_a_label_that_no_unit_takes_is_refused_before_any_is_asked(many):
    units, fleet = many
    for label in ("shake 7", "shake-0.3g", "x" * 33):
        result = invoke("arm", "--fleet", fleet, "--label", label)
        assert result.exit_code == 1
        assert "expected letters, digits" in " ".join(result.stderr.split())
    assert {unit.state for unit in units.values()} == {"idle"}


def test_disarm_all_is_acknowledged_by_each(many):
    units, fleet = many
    for unit in units.values():
        unit.state = "armed"
    told = json.loads(invoke("disarm", "--fleet", fleet, "--json").stdout)
    assert told["ok"] is True
    assert {unit.state for unit in units.values()} == {"idle"}


def test_status_puts_units_that_need_a_hand_first_where_not_all_fit(many):
    units, fleet = many
    units["d-1"].state = "fault"
    units["d-1"].last_error = "the card is full"
    result = invoke("status", "--fleet", fleet)
    assert result.exit_code == 1
    assert "4 units: 3 idle, 1 fault" in result.stdout
    assert "the card is full" in " ".join(result.stdout.split())


def test_a_unit_with_keys_is_reached_by_the_fleet_file_and_by_nobody_else(tmp_path):
    """The real daemon (simulated sensors) with a key, asked by a host that it knows, and by others."""
    source = make_run(tmp_path / "card" / "runs", "light_0001", {"video.h264": 700_000}, unit="light")
    unit_keys, own_keys = make_keys(tmp_path / "keys")
    write_secret_key(tmp_path / "known.key_secret", own_keys, what="a host")
    write_secret_key(tmp_path / "stranger.key_secret", make_key_pair(), what="a stranger")

    def fleet(secret, server_key):
        path = tmp_path / f"{secret}.toml"
        path.write_text(
            f'[host]\nsecret_key = "{secret}.key_secret"\n[[unit]]\nname = "light"\n'
            f"address = \"{unit.address}\"\nserver_key = '{server_key}'\n"
        )
        return path

    with LightUnit(tmp_path / "card", keys=tmp_path / "keys") as unit:
        pulled = invoke("pull", "--fleet", fleet("known", unit_keys.public), "-o", tmp_path / "runs")
        stranger = invoke("status", "--fleet", fleet("stranger", unit_keys.public), "--timeout", 1)
        impostor = invoke("status", "--fleet", fleet("known", make_key_pair().public), "--timeout", 1)
        without = invoke("status", "-a", unit.address, "--timeout", 1)
    assert pulled.exit_code == 0, pulled.stderr
    assert contents(tmp_path / "runs" / "light_0001") == contents(source)
    for refused in (stranger, impostor, without):
        assert refused.exit_code == 1
        assert "no answer" in refused.stdout


def test_server_keys_without_a_key_of_this_host_are_an_error_of_the_fleet_file(tmp_path):
    path = tmp_path / "fleet.toml"
    path.write_text(f"[[unit]]\nname = 'light'\nserver_key = '{make_key_pair().public}'\n")
    result = invoke("status", "--fleet", path)
    assert result.exit_code == 1
    assert "'bricktrack keys create'" in result.stderr


def test_a_run_that_never_came_is_not_explained_by_another_runs_trouble(card):
    """The unit armed itself again meanwhile, and waits for the line to go low: that says nothing of this run."""
    with FakeUnit(card) as unit:

        def arm_again():
            while unit.state != "armed":
                time.sleep(0.01)
            unit.run_id, unit.reason = "fake_0009_other", "the line is high"

        thread = threading.Thread(target=arm_again)
        thread.start()
        result = invoke("arm", "-a", unit.address, "--label", "x", "--wait")
        thread.join()
    assert result.exit_code == 1
    assert "fake_0001_x was not recorded: the unit is armed for fake_0009_other now" in result.stderr
    assert "the line is high" not in result.stderr


@pytest.fixture
def watcher():
    """Start commands that go on until they are interrupted."""
    started = []

    def start(*arguments):
        command = [sys.executable, "-m", "bricktrack_host.cli", *map(str, arguments)]
        started.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


def test_pull_watch_brings_each_new_run_as_it_appears(card, tmp_path, watcher):
    later = make_run(tmp_path / "later", "fake_0003_c", {"video.h264": 5000})
    with FakeUnit(card) as unit:
        host = watcher(
            "pull", "--watch", "--every", 0.2, "--json", "-a", unit.address, "-o", tmp_path / "runs"
        )
        first = json.loads(host.stdout.readline())
        later.rename(card / "fake_0003_c")
        second = json.loads(host.stdout.readline())
        host.send_signal(signal.SIGINT)
        assert host.wait(20) in (0, 130)  # between two pulls, or in the middle of one
    assert [r["run_id"] for r in first["runs"]] == ["fake_0001_a", "fake_0002_b"]
    assert [r["run_id"] for r in second["runs"]] == ["fake_0003_c"]
    assert contents(tmp_path / "runs" / "fake_0003_c") == contents(card / "fake_0003_c")


def test_status_watch_tells_again_and_again_and_ends_well(card, watcher):
    with FakeUnit(card) as unit:
        host = watcher("status", "--watch", "--every", 0.2, "--json", "-a", unit.address)
        before = json.loads(host.stdout.readline())
        unit.state = "armed"
        states = [json.loads(host.stdout.readline())["units"][0]["status"]["state"] for _ in range(3)]
        host.send_signal(signal.SIGINT)
        assert host.wait(20) == 0
    assert before["units"][0]["status"]["state"] == "idle"
    assert states[-1] == "armed"


def test_another_software_is_told_and_another_protocol_is_an_error(many):
    units, fleet = many
    units["c-1"].software = "bricktrack 9.9.0"

    def from_the_future(request, messages):
        return [[msgpack.packb(msgpack.unpackb(m[0]) | {"protocol": 99}), *m[1:]] for m in messages]

    units["c-2"].misbehave = from_the_future
    result = CliRunner(env={"COLUMNS": "200"}).invoke(
        app, ["status", "--fleet", str(fleet), "--timeout", "1"]
    )
    assert result.exit_code == 1
    assert "has bricktrack 9.9.0" in " ".join(result.stdout.split())
    assert "c-2: " in result.stderr
    assert "protocol version 99; this bricktrack speaks version" in result.stderr
    assert "4 units: 3 idle, 1 no answer" in result.stdout


def test_a_unit_that_is_asked_too_often_is_given_time(card):
    with FakeUnit(card) as unit:
        unit.confirmed |= {"fake_0001_a", "fake_0002_b"}
        refused = []

        def limit(request, messages):
            if isinstance(request, DeleteRun) and not refused:
                refused.append(request)
                request_id = msgpack.unpackb(messages[0][0])["request_id"]
                make_run(card, request.run_id, {"video.h264": 1000})  # it was not deleted after all
                return [[encode_message(request_id, Refusal(code="too-many", message="ask less often"))]]
            return messages

        unit.misbehave = limit
        result = invoke("delete", "--confirmed", "--yes", "-a", unit.address)
    assert result.exit_code == 0, result.stderr
    assert list(card.iterdir()) == []


def test_a_fleet_is_armed_triggered_and_pulled_and_a_second_host_is_refused_meanwhile(tmp_path):
    """Light units (simulated) with the real server and run store; scripts/bench_fleet.py does it with 400."""
    names = [f"u-{i:02d}" for i in range(30)]
    with LightFleet(tmp_path / "cards", names, n_processes=2) as fleet:
        file = write_fleet_file(tmp_path / "fleet.toml", {n: fleet.ports[n] for n in names})
        armed = invoke("arm", "--fleet", file, "--label", "x")
        second = invoke("arm", "--fleet", file, "--unit", "u-03", "--json")
        busy = invoke("pull", "--fleet", file, "-o", tmp_path / "runs")
        fleet.trigger(300_000)
        pulled = json.loads(invoke("pull", "--fleet", file, "-o", tmp_path / "runs", "--json").stdout)
        deleted = invoke("delete", "--confirmed", "--yes", "--fleet", file)
    assert armed.exit_code == 0, armed.stderr
    assert "30 of 30 units armed" in armed.stdout
    assert json.loads(second.stdout)["units"][0]["code"] == "wrong-state"
    assert busy.exit_code == 0  # nothing to fetch yet: nothing to complain of
    assert (len(pulled["runs"]), pulled["errors"]) == (30, [])
    assert "30 of 30 runs deleted" in deleted.stdout
    assert list((tmp_path / "cards").glob("*/runs/*")) == []
    verified = [unit_and_hashes(Path(run["folder"])) for run in pulled["runs"]]
    assert sorted(unit for unit, _ in verified) == names
    assert all(good for _, good in verified)


def unit_and_hashes(folder):
    """Return a run's unit, and whether its files have the hashes that its manifest says."""
    manifest = read_manifest(folder / MANIFEST_NAME)
    return manifest.unit, all(sha256_file(folder / f.name) == f.sha256 for f in manifest.files)
