"""The how-to pages' commands are run as they stand, on simulated runs and units named as the pages name theirs."""

import contextlib
import shutil
from dataclasses import replace

import pyarrow.parquet as pq
import pytest
from fake_unit import FakeUnit
from page_commands import type_all
from path_traced import SAMPLE, import_motion
from run_folders import make_run
from small_lab import BRICK, FLEET, UNITS, invented_run
from typer.testing import CliRunner

from bricktrack_common.key_files import read_secret_key
from bricktrack_common.run_manifest import read_manifest
from bricktrack_host.assemblies.combined_test import combine_test
from bricktrack_host.cli.main import app
from bricktrack_host.results.result_store import read_result, write_results

RUN = "9f31c2_0007_shake"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A folder with the path-traced recording as a run of unit b2, and all that it is processed with."""
    folder = tmp_path_factory.mktemp("recorded")
    import_motion(folder / "runs")
    (folder / "runs" / "sample_motion").rename(folder / "runs" / f"b2_{RUN}")
    fitted = CliRunner().invoke(
        app,
        ["calibrate", "fit", "--rig", str(SAMPLE / "rig.toml"), "--target", "32x18", "--images-dir", str(SAMPLE),
         "--unit", "sample", "--no-report", "-o", str(folder / "b2.json")],
    )  # fmt: skip
    assert fitted.exit_code == 0, fitted.output
    shutil.copy(SAMPLE / "layout.toml", folder / "brick.toml")
    (folder / "fleet.toml").write_text(
        '[[unit]]\nname = "sample"\ncalibration = "b2.json"\nlayout = "brick.toml"\n'
    )
    return folder


@pytest.mark.slow
def test_a_run_is_processed_aligned_and_watched(recorded, monkeypatch):
    monkeypatch.chdir(recorded)
    # A cluster is started by other programs than ours, and has tests of its own.
    first, again = type_all("process.md", but=("--scheduler",)).values()
    assert "48 of 48 frames gave a pose" in first
    assert "processed already" in again
    # Poses and samples of another program's: none are at hand.
    aligned = type_all("align.md", but=("--poses",))
    assert all("IMU time less camera time" in said for said in aligned.values())
    assert (recorded / "clocks.png").stat().st_size > 10_000
    # The page's film of an impact is of a longer recording, and the viewer wants a screen.
    type_all("watch.md", but=("--frames", f"bricktrack view runs/b2_{RUN}"))
    assert (recorded / f"b2_{RUN}_overlay.mp4").stat().st_size > 100_000
    assert (recorded / "shake.rrd").stat().st_size > 100_000


def test_recordings_made_otherwise_are_imported(tmp_path, monkeypatch):
    for name, sample in {
        "shake.mp4": "motion.h264",
        "shake_pts.txt": "motion_pts_us.txt",
        "imu.csv": "imu_motion.csv",
        "edges.csv": "edges_motion.csv",
    }.items():
        shutil.copy(SAMPLE / sample, tmp_path / name)
    rig = (SAMPLE / "rig.toml").read_text()
    (tmp_path / "rig.toml").write_text(rig.replace("simulated = true", "simulated = false"))
    monkeypatch.chdir(tmp_path)
    type_all("import.md")
    manifest = read_manifest(tmp_path / "runs" / "b1_shake-07" / "manifest.json")
    assert manifest.quality.frames == 48
    assert not manifest.simulated


@pytest.fixture
def tested(tmp_path, monkeypatch):
    """The working folder: the invented runs of a test, and what an earlier processing said of it."""
    for unit in UNITS:
        invented_run(tmp_path / "runs" / f"{unit}_{RUN}-12", unit)
    (tmp_path / "fleet.toml").write_text(FLEET)
    n = pq.read_metadata(tmp_path / "runs" / f"b7-1_{RUN}-12" / "results" / "fused.parquet").num_rows
    (tmp_path / "shake-12.csv").write_text("Sample,F\n" + "".join(f"{i + 1},{i % 7}\n" for i in range(n)))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_test_is_combined_and_exported(tested):
    combined, *exported = type_all("combine.md").values()
    assert "2 on the same samples" in combined
    assert len(exported) == 3
    assert all("rows" in said for said in exported)


def test_a_campaign_is_put_into_a_dataset(tested):
    results = {unit: tested / "runs" / f"{unit}_{RUN}-12" / "results" for unit in UNITS}
    combine_test("shake-12", results, [BRICK], tested / "tests" / "shake-12" / "combined")
    added, listed = type_all("campaign.md").values()
    assert "shake-12" in added
    assert "brick-7" in listed


def test_another_processing_is_compared(tested):
    def combined_of(runs, folder):
        combine_test("shake-12", {u: runs / f"{u}_{RUN}-12" / "results" for u in UNITS}, [BRICK], folder)

    invented_run(tested / "runs" / f"b2_{RUN}", "b2")
    combined_of(tested / "runs", tested / "archive" / "shake-12" / "combined")
    combined_of(tested / "runs", tested / "tests" / "shake-12" / "combined")
    shutil.copytree(tested / "runs", tested / "runs-of-2026")
    for run in sorted((tested / "runs").iterdir()):
        before = read_result(run / "results")
        edges = before.fused["edge"]
        shifted = replace(edges, t_camera_brick_mm=edges.t_camera_brick_mm + 0.01)
        write_results(replace(before, fused=before.fused | {"edge": shifted}), run / "results")
        assert (run / "results_1").is_dir()
    combined_of(tested / "runs", tested / "tests" / "shake-12" / "combined")
    printed = type_all("compare.md")
    assert len(printed) == 5
    assert (tested / "changes.csv").exists()
    assert (tested / "what-changed.html").exists()


@pytest.fixture
def units(tmp_path, monkeypatch):
    """Three units that answer at the addresses of the fleet file in the working folder."""
    with contextlib.ExitStack() as opened:
        fleet = ['runs_folder = "runs"\n']
        found = {}
        for name in ("c-01", "c-02", "d-01"):
            make_run(tmp_path / "cards" / name, f"{name}_0001_test", {"video.h264": 100_000}, unit=name)
            unit = opened.enter_context(FakeUnit(tmp_path / "cards" / name, name=name))
            unit.picture = (SAMPLE / "calib_A_32x18.png").read_bytes()
            fleet.append(f'[[unit]]\nname = "{name}"\naddress = "{unit.address}"\n')
            found[name] = unit
        (tmp_path / "fleet.toml").write_text("".join(fleet))
        monkeypatch.chdir(tmp_path)
        yield found


def test_units_are_looked_at_armed_configured_and_pulled(units, tmp_path):
    type_all("pull.md", but=("--watch",))  # that one goes on until Ctrl-C
    assert {p.name for p in (tmp_path / "runs").iterdir()} == {f"{name}_0001_test" for name in units}
    said = type_all("check-a-unit.md", but=("bricktrackd",))
    assert all("c-01" in text for text in said.values())
    # Armed, these units never get a run to be waited for; and nobody is here to be asked before runs are deleted.
    said = type_all("fleet.md", but=("--watch", "--wait", "delete"))
    assert "camera.exposure_us" in said["bricktrack configure --unit c-01"]
    assert (tmp_path / "stills" / "c-01_leds.png").exists()


def test_the_hosts_keys_are_made(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    type_all("keys.md", but=("--ssh", "bricktrackd"))  # SSH has tests of its own
    assert read_secret_key(tmp_path / ".config" / "bricktrack" / "host.key_secret").public
