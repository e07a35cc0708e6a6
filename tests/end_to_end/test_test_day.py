"""A test day by its commands on light units: what each says and leaves, also where something went wrong."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
from example_report import example_result
from light_fleet import LightFleet, write_fleet_file
from typer.testing import CliRunner

from bricktrack_common.run_manifest import MANIFEST_NAME, read_manifest
from bricktrack_host.assemblies.combined_summary import read_test
from bricktrack_host.cli import test_day
from bricktrack_host.cli._console import err, out
from bricktrack_host.cli.main import app
from bricktrack_host.results.result_store import write_results
from bricktrack_host.transfer.unit_client import UnitClient

ROOT = Path(__file__).parents[2]
NAMES = ["b7-1", "b7-2", "b8-1"]


def invoke(*words):
    done = CliRunner().invoke(app, ["test", *(str(w) for w in words)])
    return done.exit_code, " ".join(done.output.split())


@pytest.fixture
def lab(tmp_path, monkeypatch):
    """Three light units, a fleet file that names them, and processing that writes invented results at once."""

    def process(runs, *, fleet, where):
        blank = example_result()
        for run in runs:
            manifest = read_manifest(run / MANIFEST_NAME)
            named = msgspec.structs.replace(blank.manifest, unit=manifest.unit, run_id=manifest.run_id)
            write_results(replace(blank, manifest=named), run / "results")
        return 0

    monkeypatch.setattr(test_day, "process_folders", process)
    for console in (out, err):
        monkeypatch.setattr(console, "width", 200)
    monkeypatch.chdir(tmp_path)
    with LightFleet(tmp_path / "cards", NAMES, n_processes=1) as units:
        write_fleet_file(tmp_path / "fleet.toml", units.ports)
        yield units


def start(*words, cwd):
    command = [sys.executable, "-m", "bricktrack_host.cli", "test", *words]
    return subprocess.Popen(command, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def test_a_shake_from_the_look_before_it_to_the_report(lab, tmp_path):
    code, words = invoke("new", "shake-12")
    assert (code, "3 of 3 units are ready" in words) == (0, True), words
    arming = start("arm", "shake-12", cwd=tmp_path)
    assert "b7-1: armed, run b7-1" in arming.stdout.readline()
    while "3 of 3 units" not in arming.stdout.readline():
        pass
    lab.trigger(20_000)
    rest, _ = arming.communicate(timeout=30)
    assert arming.returncode == 0, rest
    assert "all runs are saved; next: bricktrack test collect shake-12" in rest

    code, words = invoke("collect", "shake-12")
    assert code == 0, words
    assert "3 of 3 runs are here, 3 to process" in words
    code, words = invoke("collect", "shake-12")
    assert "3 of 3 runs are here, 0 to process" in words
    code, words = invoke("report", "shake-12")
    assert code == 0, words
    summary = read_test(tmp_path / "tests" / "shake-12" / "combined")
    assert sorted(unit.unit for unit in summary.units) == NAMES

    code, words = invoke("arm", "shake-12")
    assert code == 0, "what is recorded is not recorded again unasked"
    assert "nothing was armed: shake-12 is recorded" in words
    assert all(re.search(rf"{name}: \S*_0001_shake-12 complete", words) for name in NAMES)


def test_a_test_is_begun_again_but_not_another_of_its_name(lab, tmp_path):
    assert invoke("new", "s1")[0] == 0
    assert invoke("new", "s1")[0] == 0, "begun again, as after a kill"
    code, words = invoke("new", "s1", "--duration", "9")
    assert code == 1
    assert (
        "there is a test s1 already, of b7-1, b7-2, b8-1 for the units' own time; this one would be" in words
    )


def test_who_is_not_ready_is_said_with_the_remedy(lab, tmp_path):
    assert invoke("new", "other")[0] == 0
    assert invoke("arm", "other", "--no-wait")[0] == 0
    code, words = invoke("new", "mine", "--unit", "b7-*")
    assert code == 1
    assert "0 of 2 units are ready" in words
    assert "armed for b7-1" in words
    assert "'bricktrack disarm'" in words


def test_a_unit_that_is_gone_stops_nobody(lab, tmp_path):
    assert invoke("new", "s2")[0] == 0
    assert invoke("arm", "s2", "--no-wait")[0] == 0
    lab.trigger(10_000)
    fleet = tmp_path / "fleet.toml"
    fleet.write_text(fleet.read_text().replace(f":{lab.ports['b8-1']}", ":9"))
    code, words = invoke("collect", "s2", "--timeout", "1")
    assert code == 1
    assert "2 of 3 runs are here, 2 to process" in words
    assert "b8-1: " in words
    code, words = invoke("report", "s2")
    assert code == 1
    assert "without b8-1: not here, or not processed" in words
    assert len(read_test(tmp_path / "tests" / "s2" / "combined").units) == 2


def test_who_does_not_arm_is_named_and_the_rest_record(lab, tmp_path, monkeypatch):
    arm = UnitClient.arm
    monkeypatch.setattr(UnitClient, "arm", lambda *words, **options: arm(*words, **options, patience_s=1.0))
    (tmp_path / "cards" / "b7-2" / "full").touch()
    (tmp_path / "cards" / "b8-1" / "mute").touch()
    assert invoke("new", "s3")[0] == 0
    code, words = invoke("arm", "s3")
    assert code == 1
    assert "1 of 3 units armed" in words
    assert re.search("b7-2: .* refused arm: 0.3 GB free; a run needs 1.2 GB", words)
    assert "not armed: b7-2, b8-1" in words
    assert "the 1 that are armed record at the first edge. 'bricktrack test arm s3' arms the rest" in words

    code, words = invoke("arm", "s3", "--no-wait")
    assert code == 1
    assert "b8-1: armed, run b8-1" in words, "it had armed, and its word was lost"
    assert "_0001_s3" in words and "_0002_s3" not in words
    assert "not armed: b7-2" in words
    (tmp_path / "cards" / "b7-2" / "full").unlink()
    code, words = invoke("arm", "s3", "--no-wait")
    assert (code, "they record at the first edge" in words) == (0, True), words
    code, words = invoke("collect", "s3")
    assert code == 1
    assert "b7-1, b7-2, b8-1: armed for s3; no run yet" in words


def test_nobody_is_armed_for_a_shake_that_others_recorded_already(lab, tmp_path):
    (tmp_path / "cards" / "b7-2" / "full").touch()
    assert invoke("new", "s4")[0] == 0
    assert invoke("arm", "s4", "--no-wait")[0] == 1
    lab.trigger(10_000)
    (tmp_path / "cards" / "b7-2" / "full").unlink()
    code, words = invoke("arm", "s4")
    assert code == 1
    assert (
        "b7-1, b8-1 recorded s4 already, and b7-2 did not: armed now, they would record another shake"
        in words
    )
    code, words = invoke("collect", "s4")
    assert (code, "b7-2: no run of s4. Was it armed?" in words) == (1, True)

    assert invoke("arm", "s4", "--again", "--no-wait")[0] == 0
    code, words = invoke("collect", "s4")
    assert (code, "0 of 3 runs are here" in words) == (1, True), "no run of the shake before"
    lab.trigger(10_000)
    assert invoke("collect", "s4")[0] == 0
    code, words = invoke("report", "s4")
    assert code == 0
    used = {u.unit: u.run_id for u in read_test(tmp_path / "tests" / "s4" / "combined").units}
    assert [used[name].rsplit("_", 2)[1] for name in NAMES] == ["0002", "0001", "0002"]
    code, words = invoke("new", "s4")
    assert (code, "the test s4 is recorded already: 3 of its runs are here" in words) == (1, True)


def test_recording_once_more_resumes_after_a_kill(lab, tmp_path):
    assert invoke("new", "s5")[0] == 0
    assert invoke("arm", "s5", "--no-wait")[0] == 0
    lab.trigger(10_000)
    arming = start("arm", "s5", "--again", cwd=tmp_path)
    while "3 of 3 units" not in arming.stdout.readline():
        pass
    arming.kill()
    arming.communicate()
    lab.trigger(10_000)
    code, words = invoke("arm", "s5", "--again")
    assert code == 0
    assert "nothing was armed: s5 is recorded" in words, "by the round that was cut short"
    assert all(f"{name}: has run" in words for name in NAMES)
    assert "_0002_s5 complete" in words
    assert invoke("arm", "s5", "--again", "--no-wait")[0] == 0
    lab.trigger(10_000)
    cards = [sorted((tmp_path / "cards" / name / "runs").iterdir()) for name in NAMES]
    assert [len(runs) for runs in cards] == [3, 3, 3]


def test_a_name_that_cannot_be_a_label_is_refused(lab):
    for name in ("a_b", "../x", "shake-0.3g", "", "x" * 40):
        code, words = invoke("new", name)
        assert code != 0
        assert "test's name" in words
