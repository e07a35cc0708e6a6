"""What `bricktrack process` says of folders that it cannot process, before anything is computed."""

import pytest
from run_folders import make_run

from bricktrack_common.errors import ConfigError, RunFormatError
from bricktrack_host.cli._run_jobs import run_job


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """No fleet file is at hand."""
    monkeypatch.delenv("BRICKTRACK_FLEET", raising=False)
    monkeypatch.chdir(tmp_path)


def test_a_folder_that_is_not_there_or_no_run_is_named_before_a_calibration_is_asked_for(tmp_path):
    with pytest.raises(RunFormatError, match="gone: no such run folder"):
        run_job(tmp_path / "gone", fleet_file=None)
    with pytest.raises(RunFormatError, match=r"no manifest\.json, so no whole run folder"):
        run_job(tmp_path, fleet_file=None)
    (tmp_path / "notes.txt").write_text("none")
    with pytest.raises(RunFormatError, match=r"notes\.txt: a file; expected a run folder"):
        run_job(tmp_path / "notes.txt", fleet_file=None)


def test_a_folder_of_runs_is_told_from_a_run(tmp_path):
    make_run(tmp_path / "runs", "b2_0001_shake", {"video.h264": 10})
    with pytest.raises(RunFormatError, match=r"runs: a folder of runs\. Name the runs in it, as .*runs/\*"):
        run_job(tmp_path / "runs", fleet_file=None)


def test_a_run_without_calibration_is_told_its_unit(tmp_path):
    make_run(tmp_path, "b2_0001_shake", {"video.h264": 10}, unit="b2")
    with pytest.raises(ConfigError, match="a fleet file that names them for unit 'b2'"):
        run_job(tmp_path / "b2_0001_shake", fleet_file=None)
