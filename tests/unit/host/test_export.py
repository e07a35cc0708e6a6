"""Results for other programs: MATLAB, spreadsheets, and the laboratory's own channels beside them."""

import csv

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from small_lab import FLEET, UNITS, invented_run
from typer.testing import CliRunner

from bricktrack_common.errors import RunFormatError
from bricktrack_host.assemblies.combined_summary import read_components, read_test
from bricktrack_host.assemblies.combined_test import combine_test
from bricktrack_host.cli.main import app
from bricktrack_host.results.daq_table import join_samples, read_daq_csv
from bricktrack_host.results.export import read_run_table, write_table
from bricktrack_host.results.result_store import read_result


def invoke(*words):
    return CliRunner().invoke(app, [str(w) for w in words], env={"COLUMNS": "200"})


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A fleet file and the processed runs of its two units (invented, simulated)."""
    folder = tmp_path_factory.mktemp("lab")
    (folder / "fleet.toml").write_text(FLEET)
    for unit in UNITS:
        invented_run(folder / f"{unit}_0001_shake", unit)
    return folder


def test_matlab_gets_numbers_units_and_words(lab, tmp_path):
    table = read_run_table(lab / "b7-1_0001_shake" / "results", "samples")
    write_table(table, tmp_path / "out.mat", "mat")
    back = scipy.io.loadmat(tmp_path / "out.mat", simplify_cells=True)
    np.testing.assert_array_equal(back["data"]["dx_mm"], table.column("dx_mm").to_numpy())
    np.testing.assert_array_equal(back["data"]["edge_index"], table.column("edge_index").to_numpy())
    assert back["data"]["covariance"].shape == (table.num_rows, 21)
    assert back["units"]["dx_mm"] == "mm"
    assert "brick axes at rest" in back["meanings"]["dx_mm"]
    words = table.column("flag_words").to_pylist()
    row = next(i for i, text in enumerate(words) if text)
    assert back["data"]["flag_words"][row] == words[row]
    assert back["about"]["run_id"] == "b7-1_0001_shake"
    assert not list(tmp_path.glob(".*")), "nothing half-written stays"


def test_every_row_of_the_samples_is_an_edge_in_order(lab):
    table = read_run_table(lab / "b7-1_0001_shake" / "results", "samples")
    index = table.column("edge_index").to_numpy()
    assert (np.diff(index) == 1).all()
    assert table.column("edge_index").null_count == 0


def test_the_laboratorys_rows_get_the_motion_of_the_same_sample(lab, tmp_path):
    motion = read_run_table(lab / "b7-1_0001_shake" / "results", "samples")
    daq = tmp_path / "daq.csv"
    # The laboratory calls the first rising edge 1000 and logged it out of order, one sample before the run, too.
    daq.write_text("Sample,Force [kN]\n1012,1.5\n999,2.5\n1000,3.5\n")
    joined = join_samples(
        motion, read_daq_csv(daq, sample_column="Sample", first_sample=1000), number="edge_index"
    )
    rows = joined.to_pydict()
    assert rows["sample"] == [12, -1, 0]
    assert rows["Force [kN]"] == [1.5, 2.5, 3.5]
    at = dict(zip(*(motion.column(c).to_pylist() for c in ("edge_index", "dx_mm")), strict=True))
    assert rows["dx_mm"] == [at[12], None, at[0]]
    write_table(joined, tmp_path / "out.mat", "mat")
    back = scipy.io.loadmat(tmp_path / "out.mat", simplify_cells=True)["data"]
    assert back["Force__kN_"].tolist() == [1.5, 2.5, 3.5]
    assert np.isnan(back["dx_mm"][1]), "where the run has no sample there is no number"


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        ("a,b\n1,2\n", {"sample_column": "Sample"}, "no column 'Sample'; there are a, b"),
        ("s,b\n1,2\n1,3\n", {"sample_column": "s"}, "sample 1 stands 2 times"),
        ("s,b\n1.5,2\n2,3\n", {"sample_column": "s"}, "1.5 is no sample number"),
        ("s,b\nx,2\n", {"sample_column": "s"}, "whole numbers"),
        ("s,b\n,2\n3,3\n", {"sample_column": "s"}, "whole numbers"),
        ("a,a\n1,2\n", {}, "'a' stands twice"),
        ("sample,b\n1,2\n", {}, "a channel is called 'sample'"),
        ("a,b\n1\n", {}, "not a readable CSV"),
        ("a;b\n1,5;2\n", {}, "parted by semicolons"),
        ("a;b\n1.5;2\n", {}, "parted by semicolons"),
    ],
)
def test_a_wrong_daq_file_is_refused_with_words(tmp_path, text, options, words):
    (tmp_path / "daq.csv").write_text(text)
    with pytest.raises(RunFormatError, match=words):
        read_daq_csv(tmp_path / "daq.csv", **options)


def test_channels_that_share_no_sample_are_refused(lab, tmp_path):
    motion = read_run_table(lab / "b7-1_0001_shake" / "results", "samples")
    (tmp_path / "daq.csv").write_text("Sample,F\n900000,1\n")
    with pytest.raises(RunFormatError, match="no sample of the motion"):
        join_samples(motion, read_daq_csv(tmp_path / "daq.csv", sample_column="Sample"), number="edge_index")
    clash = pa.table({"sample": [0], "dx_mm": [1.0]})
    with pytest.raises(RunFormatError, match="'dx_mm' has the name"):
        join_samples(motion, clash, number="edge_index")


def test_a_test_is_combined_and_exported_by_commands(lab, tmp_path):
    runs = sorted(lab.glob("b7-*"))
    done = invoke("combine", *runs, "--name", "shake-12", "--fleet", lab / "fleet.toml")
    assert done.exit_code == 0, done.output
    assert "shake-12 (simulated): 2 units, 2 on the same samples, 1 assembly" in done.output
    assert "b7-1 then b7-2" in done.output
    folder = lab / "tests" / "shake-12"
    summary = read_test(folder)
    assert summary.assemblies[0].chains == {"B": ["b7-1"], "C": ["b7-1", "b7-2"]}
    table = read_components(folder, "brick-7")
    # B is what its unit saw: its point is the brick's origin, 10, 20, 30 mm off the LED that the run reports.
    b = table.filter(pa.compute.field("component") == "B").to_pydict()
    run = pq.read_table(runs[0] / "results" / "fused.parquet", filters=[("kind", "=", "edge")]).to_pydict()
    np.testing.assert_allclose(b["drvec_x_rad"], run["drvec_x_rad"], atol=1e-12)
    from scipy.spatial.transform import Rotation

    R = Rotation.from_rotvec(np.stack([run[f"drvec_{c}_rad"] for c in "xyz"], axis=1))
    led = np.array([10.0, 20.0, 30.0])
    expected = np.stack([run[f"d{c}_mm"] for c in "xyz"], axis=1) + led - R.apply(led)
    np.testing.assert_allclose(np.stack([b[f"d{c}_mm"] for c in "xyz"], axis=1), expected, atol=1e-9)
    hz = summary.nominal_hz
    assert b["lab_s"][10] == pytest.approx(b["sample"][10] / hz)

    out = tmp_path / "c.csv"
    done = invoke("export", folder, "--component", "C", "--format", "csv", "-o", out)
    assert done.exit_code == 0, done.output
    with out.open() as file:
        rows = list(csv.DictReader(file))
    assert {row["component"] for row in rows} == {"C"}
    assert len(rows) == len(b["sample"])


def test_combining_again_gives_the_same_bytes(lab, tmp_path):
    results = {run.name[:4]: run / "results" for run in sorted(lab.glob("b7-*"))}
    from bricktrack_host.transfer.fleet_config import load_fleet

    assemblies = load_fleet(lab / "fleet.toml").assembly
    for name in ("one", "two"):
        combine_test("t", results, assemblies, tmp_path / name)
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes()


def test_commands_name_what_is_wrong(lab, tmp_path):
    runs = sorted(lab.glob("b7-*"))
    twice = invoke("combine", runs[0], runs[0], "--name", "x", "--fleet", lab / "fleet.toml")
    assert twice.exit_code != 0
    assert "has another run here" in " ".join(twice.output.split())
    (lab / "tests" / "planned").mkdir(parents=True)
    (lab / "tests" / "planned" / "plan.json").touch()
    planned = invoke("combine", *runs, "--name", "planned", "--fleet", lab / "fleet.toml")
    assert planned.exit_code == 1
    assert "'bricktrack test report planned' combines its runs" in " ".join(planned.output.split())
    outside = invoke("combine", *runs, "--name", "../elsewhere", "--fleet", lab / "fleet.toml")
    assert outside.exit_code == 1
    assert "--name '../elsewhere': expected letters" in " ".join(outside.output.split())
    nothing = invoke("export", tmp_path)
    assert nothing.exit_code != 0
    assert "no such table" in " ".join(nothing.output.split())
    component = invoke("export", runs[0], "--component", "B")
    assert "are for tests" in " ".join(component.output.split())


def test_what_is_no_results_folder_is_told_from_what_is_not_there(tmp_path):
    with pytest.raises(RunFormatError, match=r"nowhere: no such folder\. Process"):
        read_result(tmp_path / "nowhere")
    with pytest.raises(RunFormatError, match=r"no summary\.json"):
        read_result(tmp_path)
    (tmp_path / "b2_0001_shake").mkdir()
    manifest = tmp_path / "b2_0001_shake" / "manifest.json"
    manifest.touch()
    with pytest.raises(RunFormatError, match=r"a folder of runs\. Name one"):
        read_result(tmp_path)
    with pytest.raises(RunFormatError, match=r"manifest\.json: a file; expected a processed run"):
        read_result(manifest)
