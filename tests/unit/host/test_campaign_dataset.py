"""The dataset of a campaign: rows are those of the runs, adding is all or nothing, old files stay readable."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset
import pyarrow.parquet as pq
import pytest
from campaign_lab import combine, files_of, make_campaign, rows_of
from small_lab import UNITS
from typer.testing import CliRunner

from bricktrack_common.errors import ConfigError, RunFormatError
from bricktrack_host.assemblies.combined_summary import read_components
from bricktrack_host.cli.main import app
from bricktrack_host.datasets.campaign_dataset import add_units, list_units, open_dataset
from bricktrack_host.datasets.motion_schema import COLUMNS, MOTION_VERSION, columns_of, motion_schema
from bricktrack_host.datasets.test_sources import source_of_run, sources_of_test
from bricktrack_host.results.result_store import read_result, write_results

DOCS = Path(__file__).parents[3] / "docs"


def test_rows_seen_from_the_camera_are_those_of_the_run(lab, campaign):
    rows = rows_of(campaign).filter((pc.field("unit") == "b7-2") & (pc.field("seen_from") == "camera"))
    run = pq.read_table(lab / "b7-2" / "results" / "fused.parquet")
    assert rows.num_rows == run.num_rows
    for name in ("t_ns", "dx_mm", "drvec_z_rad", "sd_dy_mm", "dv_z_mmps", "omega_x_radps", "flags"):
        np.testing.assert_array_equal(rows.column(name).to_numpy(), run.column(name).to_numpy(), err_msg=name)
    for axis in "xyz":  # from rest, as the rotation itself
        np.testing.assert_array_equal(rows.column(f"sd_rot_{axis}_deg"), run.column(f"sd_drot_{axis}_deg"))
    assert rows.column("sd_rot_x_deg") != run.column("sd_rot_x_deg")
    at_edge = np.array(rows.column("kind").to_pylist()) == "edge"
    number = [x for x in run.column("edge_index").to_pylist() if x is not None]
    assert rows.column("sample").to_numpy()[at_edge].tolist() == number
    hz = read_result(lab / "b7-2" / "results").manifest.trigger.nominal_hz
    np.testing.assert_allclose(rows.column("lab_s").to_numpy()[at_edge], np.array(number) / hz, rtol=1e-12)


def test_rows_seen_from_the_base_stand_with_the_last_unit_of_the_chain(lab, campaign):
    rows = rows_of(campaign).filter(pc.field("seen_from") == "base")
    for component, unit in (("B", "b7-1"), ("C", "b7-2")):
        own = rows.filter(pc.field("component") == component)
        table = read_components(lab / "shake-12", "brick-7").filter(pc.field("component") == component)
        assert set(own.column("unit").to_pylist()) == {unit}
        for name in ("dx_mm", "drvec_y_rad", "sd_dz_mm", "sd_rot_x_deg", "lab_s"):
            np.testing.assert_array_equal(own.column(name).to_numpy(), table.column(name).to_numpy())
        np.testing.assert_array_equal(own.column("sample").to_numpy(), table.column("sample").to_numpy())
        assert np.isnan(own.column("omega_x_radps").to_numpy()).all()
        assert own.column("t_ns").null_count == own.num_rows


def test_only_what_was_measured_is_called_so(campaign):
    rows = rows_of(campaign)
    measured = rows.column("measured").to_numpy()
    flags = rows.column("flags").to_numpy()
    known = np.isfinite(rows.column("dx_mm").to_numpy())
    # 1: no pose, 2048: extrapolated, of docs and quality.py.
    np.testing.assert_array_equal(measured, known & (flags & (1 | 2048) == 0))
    assert 0 < measured.sum() < len(measured)


def test_the_slip_of_a_unit_is_in_its_sample_numbers(lab, tmp_path):
    rows = rows_of(make_campaign(lab, tmp_path / "campaign", slip_samples=3)).filter(
        (pc.field("seen_from") == "camera") & (pc.field("kind") == "edge")
    )
    assert rows.column("sample")[0].as_py() == 3.0
    assert set(rows.column("sample_agreement").to_pylist()) == {"corrected"}


def test_every_column_has_its_unit_and_stands_on_the_docs_page(campaign):
    text = (DOCS / "dataset-format.md").read_text()
    path = next((campaign / "motion").rglob("*.parquet"))
    schema = pq.read_schema(path)
    assert schema.names == [c.name for c in COLUMNS]
    for field in schema:
        letters = re.sub(r"(?<=d)[xyz](?=_mm)|(?<=_)[xyz](?=_)", "{xyz}", field.name)
        assert f"| `{letters}` | {field.metadata[b'unit'].decode()} |".replace("|  |", "| |") in text
        assert set(field.metadata) == {b"unit", b"meaning"}
    facts = schema.metadata
    assert json.loads(facts[b"bricktrack.provenance"])["calibration_sha256"] == "1" * 64
    assert facts[b"bricktrack.version"] == str(MOTION_VERSION).encode()
    assert json.loads(facts[b"bricktrack.chains"]) in ({"B": ["A", "b7-1"]}, {"C": ["A", "b7-1", "b7-2"]})


def test_adding_again_changes_nothing(lab, campaign):
    before = files_of(campaign)
    done = add_units(campaign, sources_of_test(lab / "shake-12"), whole_tests=True)
    assert (done.added, done.replaced, done.retired) == ([], [], [])
    assert done.unchanged == ["shake-12/brick-7/b7-1", "shake-12/brick-7/b7-2"]
    assert files_of(campaign) == before


def reprocessed(folder):
    """Process one run again, with other numbers, and combine the test again."""
    result = read_result(folder / "b7-2" / "results")
    flags = result.fused["edge"].flags.copy()
    flags[5] = 1
    fused = result.fused | {"edge": replace(result.fused["edge"], flags=flags)}
    write_results(replace(result, fused=fused), folder / "b7-2" / "results")


def test_rows_of_another_processing_take_the_place_of_the_earlier_which_stay(lab, tmp_path):
    shutil.copytree(lab, tmp_path, dirs_exist_ok=True)
    root = tmp_path / "campaign"
    add_units(root, sources_of_test(tmp_path / "shake-12"), whole_tests=True)
    first = rows_of(root).filter(pc.field("unit") == "b7-2")
    reprocessed(tmp_path)
    combine(tmp_path)
    done = add_units(root, sources_of_test(tmp_path / "shake-12"), whole_tests=True)
    assert done.replaced == ["shake-12/brick-7/b7-2"]
    assert done.unchanged == ["shake-12/brick-7/b7-1"]
    now = rows_of(root).filter(pc.field("unit") == "b7-2")
    earlier = rows_of(root, earlier=True)
    assert earlier.num_rows == first.num_rows == now.num_rows
    np.testing.assert_array_equal(earlier.column("flags").to_numpy(), first.column("flags").to_numpy())
    assert (now.column("flags").to_numpy() != first.column("flags").to_numpy()).any()
    assert set(now.column("results_id").to_pylist()).isdisjoint(earlier.column("results_id").to_pylist())
    assert [e.earlier for e in list_units(root)] == [0, 1]

    # A unit that left its test is retired, not deleted; the kept file is not kept twice.
    done = add_units(root, sources_of_test(tmp_path / "shake-12")[:1], whole_tests=True)
    assert done.retired == ["shake-12/brick-7/b7-2"]
    assert set(rows_of(root).column("unit").to_pylist()) == {"b7-1"}
    assert len(list((root / "earlier").rglob("*.parquet"))) == 2


def test_a_test_that_is_older_than_its_runs_is_refused(lab, tmp_path):
    shutil.copytree(lab, tmp_path, dirs_exist_ok=True)
    result = read_result(tmp_path / "b7-2" / "results")
    other = msgspec.structs.replace(result.provenance, calibration_sha256="9" * 64)
    write_results(replace(result, provenance=other), tmp_path / "b7-2" / "results")
    with pytest.raises(RunFormatError, match="b7-2 was processed again since .* Combine the test again"):
        sources_of_test(tmp_path / "shake-12")


def test_a_damaged_run_adds_nothing(lab, tmp_path):
    root = tmp_path / "campaign"
    sources = sources_of_test(lab / "shake-12")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunFormatError):
        add_units(root, [sources[0], replace(sources[1], results=tmp_path / "empty")], whole_tests=True)
    assert list_units(root) == []
    assert open_dataset(root).count_rows() == 0


def test_runs_by_themselves_are_added_under_a_name_and_never_over_others(lab, tmp_path):
    root = tmp_path / "campaign"
    run = source_of_run(lab / "b7-1", name="12")  # looks like a number, and is a word
    add_units(root, [run], whole_tests=False)
    rows = rows_of(root)
    assert set(rows.column("test").to_pylist()) == {"12"}
    assert rows.column("assembly").null_count == rows.num_rows
    assert set(rows.column("sample_agreement").to_pylist()) == {"alone"}
    with pytest.raises(ConfigError, match="two runs"):
        add_units(root, [run, run], whole_tests=False)
    with pytest.raises(ConfigError, match="letters, digits"):
        add_units(root, [replace(run, test="a/b")], whole_tests=False)
    add_units(root, sources_of_test(lab / "shake-12"), whole_tests=True)
    with pytest.raises(ConfigError, match="there already, with its assembly"):
        add_units(root, [replace(run, test="shake-12")], whole_tests=False)
    shutil.copytree(lab / "b7-1", tmp_path / "b7-1")
    result = read_result(tmp_path / "b7-1" / "results")
    other = msgspec.structs.replace(result.manifest, run_id="b7-1_0002_shake")
    write_results(replace(result, manifest=other), tmp_path / "b7-1" / "results")
    with pytest.raises(ConfigError, match="the dataset has run b7-1_0001_shake there, not b7-1_0002_shake"):
        add_units(root, [source_of_run(tmp_path / "b7-1", name="12")], whole_tests=False)


# Versions of the schema.


def test_columns_are_only_ever_added():
    for version in range(1, MOTION_VERSION):
        assert set(columns_of(version)) < set(columns_of(version + 1))
    assert {c.since for c in COLUMNS} == set(range(1, MOTION_VERSION + 1))
    # What version 1 was, for good: a change of one of these is a change of files that exist.
    words = {c.name: (str(c.type), c.unit) for c in columns_of(1)}
    assert words["sample"] == ("double", "1")
    assert words["t_ns"] == ("int64", "ns")
    assert words["sd_rot_z_deg"] == ("double", "deg")
    assert len(words) == 35


def test_a_dataset_of_version_1_stays_readable():
    """A file of thirteen rows (simulated), as version 1 wrote it: it is never made again."""
    root = DOCS.parent / "tests" / "data" / "campaign-v1"
    [entry] = list_units(root)
    assert (entry.test, entry.assembly, entry.unit) == ("shake-12", "brick-7", "b7-2")
    assert (entry.version, entry.rows, entry.components, entry.simulated) == (1, 13, ["C"], True)
    rows = rows_of(root).to_pylist()
    assert [row["sample"] for row in rows if row["kind"] == "edge"] == [*range(1248, 1254), 1248, 1250, 2999]
    assert rows[0]["dx_mm"] == 1.817352258557508
    assert (rows[10]["component"], rows[10]["dx_mm"]) == ("C", 5.521495384433408)
    assert (rows[12]["measured"], rows[12]["flag_words"]) == (False, "extrapolated")


def test_a_file_of_an_older_version_reads_with_nulls_in_what_it_lacks(campaign, tmp_path):
    root = tmp_path / "campaign"
    shutil.copytree(campaign, root)
    path = root / "motion" / "test=shake-12" / "assembly=brick-7" / "unit=b7-1" / "motion.parquet"
    pq.write_table(pq.read_table(path).drop_columns(["lab_s", "flag_words"]), path)
    rows = rows_of(root)
    old = rows.filter(pc.field("unit") == "b7-1")
    assert old.column("lab_s").null_count == old.num_rows
    new = rows.filter(pc.field("unit") == "b7-2")
    assert new.column("lab_s").null_count == 0
    assert rows.schema.field("lab_s").type == pa.float64()


def test_a_newer_version_is_refused_by_name(campaign, lab, tmp_path):
    root = tmp_path / "campaign"
    shutil.copytree(campaign, root)
    (root / "dataset.json").write_text(json.dumps({"schema": "bricktrack.motion", "version": 99}))
    for use in (
        open_dataset,
        list_units,
        lambda r: add_units(r, sources_of_test(lab / "shake-12"), whole_tests=True),
    ):
        with pytest.raises(
            RunFormatError, match=r"version 99; this bricktrack reads up to version 1\. Upgrade"
        ):
            use(root)


def test_other_programs_read_the_folder_without_being_told_more(campaign):
    duckdb = pytest.importorskip("duckdb")
    polars = pytest.importorskip("polars")
    n = rows_of(campaign).num_rows
    pattern = f"{campaign}/motion/**/*.parquet"
    counted = duckdb.sql(
        f"SELECT count(*), min(unit), max(unit), min(test) FROM read_parquet('{pattern}')"
    ).fetchall()
    assert counted == [(n, "b7-1", "b7-2", "shake-12")]
    frame = polars.scan_parquet(campaign / "motion", hive_partitioning=True).collect()
    assert (frame.height, set(frame["assembly"])) == (n, {"brick-7"})
    plain = pa.dataset.dataset(campaign / "motion", partitioning="hive")
    assert plain.count_rows() == n
    assert set(plain.schema.names) == {*motion_schema().names, "test", "assembly", "unit"}


# The commands.


def invoke(*words):
    return CliRunner().invoke(app, [str(w) for w in words], env={"COLUMNS": "200"})


def test_a_campaign_is_made_and_listed_by_commands(lab, tmp_path):
    root = tmp_path / "campaign"
    done = invoke("dataset", "add", root, lab / "shake-12")
    assert done.exit_code == 0, done.output
    assert "2 added: shake-12/brick-7/b7-1, shake-12/brick-7/b7-2" in done.output
    assert "2 there already" in invoke("dataset", "add", root, lab / "shake-12").output
    done = invoke("dataset", "add", root, lab / "b7-1", "--test", "alone")
    assert "1 added: alone/-/b7-1" in done.output
    listed = invoke("dataset", "list", root)
    assert "2 tests, 3 units" in listed.output
    assert "; 3 of the runs simulated" in listed.output
    entries = json.loads(invoke("dataset", "list", root, "--json").output)
    assert [e["components"] for e in entries] == [[], ["B"], ["C"]]
    assert entries[0]["assembly"] is None
    refused = invoke("dataset", "list", tmp_path)
    assert refused.exit_code == 1
    assert "no dataset" in refused.output


# The page with queries.


def test_the_queries_of_the_how_to_run_and_agree_with_the_tables(lab, tmp_path, monkeypatch, capsys):
    duckdb = pytest.importorskip("duckdb")
    pytest.importorskip("polars")
    monkeypatch.chdir(tmp_path)
    root = Path("campaign")
    for name in ("shake-12", "shake-13"):
        add_units(root, sources_of_test(lab / "shake-12", name=name), whole_tests=True)
    page = (DOCS / "how-to" / "campaign.md").read_text()
    answers = []
    for block in re.findall(r"```sql\n(.*?)```", page, flags=re.S):
        for statement in block.split(";"):
            if statement.strip():
                answer = duckdb.sql(statement)
                answers.append([] if answer is None else answer.fetchall())
    _, largest, rms, change, flags, origin = answers
    c = read_components(lab / "shake-12", "brick-7").filter(pc.field("component") == "C")
    length = np.linalg.norm(np.stack([c.column(f"d{x}_mm").to_numpy() for x in "xyz"], axis=1), axis=1)
    length[c.column("flags").to_numpy() & (1 | 2048) != 0] = np.nan
    assert len(largest) == 4
    for row in largest[:2]:  # C moves most, in both tests alike
        assert row[:2] == ("brick-7", "C")
        assert row[3] == pytest.approx(np.nanmax(length), rel=1e-12)
        assert row[4] == c.column("sample").to_numpy()[np.nanargmax(length)]
    assert [row[:2] for row in rms] == [(t, u) for t in ("shake-12", "shake-13") for u in UNITS]
    run = pq.read_table(lab / "b7-1" / "results" / "fused.parquet", filters=[("kind", "=", "edge")])
    rows = np.array(run.column("edge_index").to_pylist())
    x = run.column("dx_mm").to_numpy()[(rows >= 400) & (rows <= 800)]  # 200 Hz
    assert rms[0][2] == pytest.approx(np.sqrt(np.mean(x**2)), rel=1e-12)
    assert rms[0][3] == 100.0
    assert [row[:2] for row in change] == [("B", 0.0), ("C", 0.0)]
    assert change[1][2] == np.isfinite(length).sum()
    assert any("impact" in words for words, _ in flags)
    assert {row[1] for row in origin} == {"1" * 64}
    scope = {}
    for block in re.findall(r"```python\n(.*?)```", page, flags=re.S):
        exec(block, scope)
    assert scope["largest"]["largest_mm"][0] == pytest.approx(np.nanmax(length), rel=1e-12)
    assert scope["table"].num_rows == 2 * run.num_rows - 2 * np.count_nonzero(
        run.column("flags").to_numpy() & 2049
    )
    assert "rows; mm" in capsys.readouterr().out
