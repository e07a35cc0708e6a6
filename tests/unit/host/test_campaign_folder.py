"""The dataset's folder: adding is all or nothing, whatever ends it, and one command adds at a time."""

import shutil
import subprocess
import sys

import numpy as np
import pytest
from campaign_lab import files_of, make_campaign, rows_of

from bricktrack_common.errors import RunFormatError, StorageError
from bricktrack_host.datasets import campaign_dataset, campaign_folder
from bricktrack_host.datasets.campaign_dataset import add_units, open_dataset
from bricktrack_host.datasets.test_sources import sources_of_test


@pytest.fixture(scope="module")
def slipped(lab, tmp_path_factory):
    """The same test, with sample numbers of units that missed three edges."""
    return make_campaign(lab, tmp_path_factory.mktemp("data") / "campaign", slip_samples=3)


@pytest.fixture(scope="module")
def rows_made():
    """Rows by what they were made of: the tests of kills need not make them again and again."""
    return {}


@pytest.fixture
def quick_rows(rows_made, monkeypatch):
    made = campaign_dataset.unit_rows

    def unit_rows(source, source_id):
        if source_id not in rows_made:
            rows_made[source_id] = made(source, source_id)
        return rows_made[source_id]

    monkeypatch.setattr(campaign_dataset, "unit_rows", unit_rows)


class Killed(BaseException):
    """Ends a command at once, as SIGKILL does: nothing catches it, and adding has nothing to clean up."""


@pytest.mark.usefixtures("quick_rows")
@pytest.mark.parametrize("call", [1, 2])
@pytest.mark.parametrize("step", ["unit_rows", "rename_durably", "_finish", "_keep", "_sync_up"])
def test_a_kill_at_any_step_leaves_the_dataset_as_before_or_as_after(
    lab, campaign, slipped, tmp_path, monkeypatch, step, call
):
    root = tmp_path / "campaign"
    shutil.copytree(slipped, root)
    sources = sources_of_test(lab / "shake-12")
    before, after = (rows_of(folder).column("sample").to_numpy() for folder in (slipped, campaign))
    module = campaign_dataset if step == "unit_rows" else campaign_folder
    real, calls = getattr(module, step), []

    def dies(*words, **options):
        calls.append(1)
        if len(calls) == call:
            raise Killed
        return real(*words, **options)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(module, step, dies)
        add_units(root, sources, whole_tests=True)
    # Adding begins with a call of _finish; its first rename decides, its second keeps what was there before.
    is_decided = step in ("_keep", "_sync_up") or (step, call) in (("_finish", 2), ("rename_durably", 2))
    found = rows_of(root).column("sample").to_numpy()
    np.testing.assert_array_equal(found, after if is_decided else before)
    add_units(root, sources, whole_tests=True)

    def current(folder):
        return {name: data for name, data in files_of(folder).items() if name.startswith("motion")}

    assert current(root) == current(campaign)
    assert len(list((root / "earlier").rglob("*.parquet"))) == 2
    assert {p.name for p in root.iterdir()} == {"dataset.json", "motion", "earlier"}


@pytest.mark.usefixtures("quick_rows")
@pytest.mark.parametrize("step", ["write_durably", "rename_durably", "rmtree"])
def test_a_kill_while_a_dataset_is_made_or_tidied_up_does_not_lock_it(lab, tmp_path, monkeypatch, step):
    root = tmp_path / "campaign"
    sources = sources_of_test(lab / "shake-12")[:1]

    def dies(path, *_):
        if step == "write_durably":
            path.write_bytes(b"half a mark")
        elif step == "rmtree":
            (path / "retire.json").unlink()
        raise Killed

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(campaign_folder.shutil if step == "rmtree" else campaign_folder, step, dies)
        add_units(root, sources, whole_tests=True)
    done = add_units(root, sources, whole_tests=True)
    assert done.unchanged if step == "rmtree" else done.added
    assert {p.name for p in root.iterdir()} == {"dataset.json", "motion"}


def test_a_process_that_is_killed_frees_the_dataset(lab, campaign, tmp_path):
    root = tmp_path / "campaign"
    shutil.copytree(campaign, root)
    code = (
        "import os, sys; from pathlib import Path; from bricktrack_host.datasets import campaign_dataset as d;"
        "d.unit_rows = lambda *_: os.kill(os.getpid(), 9);"
        "from bricktrack_host.datasets.test_sources import sources_of_test;"
        "d.add_units(Path(sys.argv[1]), sources_of_test(Path(sys.argv[2]), name='b'), whole_tests=True)"
    )
    died = subprocess.run([sys.executable, "-c", code, str(root), str(lab / "shake-12")], check=False)
    assert died.returncode == -9
    assert (root / ".adding").exists()
    assert rows_of(root).num_rows == rows_of(campaign).num_rows
    add_units(root, sources_of_test(lab / "shake-12", name="b"), whole_tests=True)
    assert rows_of(root).num_rows == 2 * rows_of(campaign).num_rows


def test_a_folder_of_something_else_and_a_busy_dataset_are_refused(lab, tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(StorageError, match="left alone"):
        add_units(tmp_path, sources_of_test(lab / "shake-12"), whole_tests=True)
    with pytest.raises(RunFormatError, match="no dataset"):
        open_dataset(tmp_path)
    root = tmp_path / "campaign"
    with campaign_folder.locked(root), pytest.raises(StorageError, match="another command adds"):
        add_units(root, sources_of_test(lab / "shake-12"), whole_tests=True)


def test_a_file_where_the_dataset_is_to_be_is_named(tmp_path):
    (tmp_path / "campaign").touch()
    with pytest.raises(StorageError, match=r"campaign: Not a directory\..*choose another folder"):
        campaign_folder.locked(tmp_path / "campaign").__enter__()
