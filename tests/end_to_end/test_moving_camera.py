"""From a recording (simulated) whose camera is shaken and rocked to its fused motion, by the command line."""

import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest
from page_commands import type_all
from shaken_pair import import_twin, make_shaken_pair
from typer.testing import CliRunner

from bricktrack_common.errors import ConfigError, RunFormatError
from bricktrack_common.run_folder import read_run
from bricktrack_host.assemblies.combined_summary import read_test
from bricktrack_host.cli.main import app
from bricktrack_host.fusion.pose_by_pose.moving_camera import NOT_OBSERVABLE
from bricktrack_host.quality import PoseFlag
from bricktrack_host.results.daq_clock import fit_edges
from bricktrack_host.results.result_store import read_result
from bricktrack_host.results.true_motion import read_true_motion
from bricktrack_host.stages.camera_sensor import CameraSensor, choose_camera_sensor, read_camera_sensor
from bricktrack_host.transfer.fleet_config import load_fleet

pytestmark = pytest.mark.slow

_UNIT = '[[unit]]\nname = "b7-2"\ncalibration = "calibration.json"\nlayout = "kit/layout.toml"\n'
_OTHER = '[[unit]]\nname = "b7-1"\n'
_IMU = "[unit.camera_imu]\nto_camera_mm = [-18.0, 25.0, 7.0]\n"
_TWIN = _UNIT.replace("b7-2", "b7-3").replace("calibration.json", "twin.json")
_BRICK = """
[[assembly]]
name = "brick-7"
kind = "DCB"
base = "A"
[[assembly.component]]
name = "A"
[[assembly.component]]
name = "B"
[[assembly.view]]
unit = "b7-2"
camera_on = "A"
leds_on = "B"
position_brick_layout_mm = [10.0, 20.0, 30.0]
[[assembly.view]]
unit = "b7-3"
camera_on = "A"
leds_on = "B"
position_brick_layout_mm = [10.0, 20.0, 30.0]
"""
_FLEETS = {
    "own": f'{_UNIT}camera = "imu"\n{_IMU}imu = "camera"\n{_OTHER}',
    "other": f'{_UNIT}camera = "imu"\n{_IMU}imu = "brick"\nunit = "b7-1"\n{_OTHER}',
    "none": f'{_UNIT}camera = "imu"\n{_OTHER}',
    "table": f'{_UNIT}camera = "table"\n[unit.camera_table]\ncolumns = ["AX", "AY", "AZ"]\n'
    f'measured_in = "g"\n{_OTHER}',
    "twins": f'{_UNIT}camera = "imu"\n{_IMU}{_TWIN}camera = "imu"\n{_IMU}{_BRICK}',
}


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    pair = make_shaken_pair(tmp_path_factory.mktemp("pair"), shake_s=2.5)
    for name, text in _FLEETS.items():
        (pair.folder / f"{name}.toml").write_text(text)
    return pair


def unit_of(pair, fleet):
    return load_fleet(pair.folder / f"{fleet}.toml").unit[0]


def sensor(pair, fleet, **options):
    return choose_camera_sensor(pair.run, unit_of(pair, fleet), **options)


def samples(pair, chosen, problems=None):
    run = read_run(pair.run)
    return read_camera_sensor(
        run, chosen, fit_edges(run.edges_ns, 200.0), [] if problems is None else problems
    )


def process(pair, fleet, *options):
    output = pair.folder / f"results-{fleet}"
    arguments = ["process", str(pair.run), "--fleet", str(pair.folder / f"{fleet}.toml"), "-o", str(output)]
    done = CliRunner().invoke(app, [*arguments, *options], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return read_result(output), done.output


def rms_mm(pair, track):
    _, t_mm = read_true_motion(pair.truth).at(track.t_ns)
    off = np.linalg.norm(track.t_camera_brick_mm - t_mm, axis=1)
    inside = track.flags & (PoseFlag.DROPOUT | PoseFlag.EXTRAPOLATED)
    return tuple(
        float(np.sqrt(np.nanmean(off[where] ** 2))) for where in (inside == 0, inside == PoseFlag.DROPOUT)
    )


def test_with_an_imu_beside_the_camera_the_motion_is_fused_and_without_it_is_not(pair):
    fused, said = process(pair, "own")
    assert not fused.fused["edge"].flags[0] & PoseFlag.OPTICAL_ONLY
    assert fused.alignment["camera_sensor"] == "imu"
    assert fused.provenance.settings["camera_sensor_imu"] == "camera"
    page = (pair.folder / "results-own" / "report.html").read_text(encoding="utf-8")
    assert "camera sensor" in page
    assert "Angular rates of gyroscope and optics" not in page  # they differ by the camera's own rocking
    alone, words = process(pair, "none")
    assert NOT_OBSERVABLE in words.replace("\n", " ") and "not observable" not in said
    assert (alone.fused["edge"].flags & PoseFlag.OPTICAL_ONLY != 0).all()
    outside, inside = rms_mm(pair, fused.fused["edge"])
    # The camera's own motion moves the brick by some 3 mm in a dropout of 0.3 s, were it not known.
    assert outside < 0.06
    assert inside < 0.4
    assert inside < 0.2 * rms_mm(pair, alone.fused["edge"])[1]


def test_the_sensor_of_another_unit_comes_by_the_edges_that_both_saw(pair):
    own = samples(pair, sensor(pair, "own"))
    other = samples(pair, sensor(pair, "other"))
    # The jitter of 600 edges leaves far less than a microsecond; the stamps are rounded to one.
    assert np.abs(other.imu.t_ns - own.imu.t_ns).max() < 2000
    np.testing.assert_array_equal(other.imu.acc_mps2, own.imu.acc_mps2)


def test_the_tables_samples_come_by_their_number(pair):
    chosen = sensor(pair, "table", table=pair.table, sample_column="Sample", first_sample=1)
    found = samples(pair, chosen)
    edges = read_run(pair.run).edges_ns
    assert np.abs(found.imu.t_ns - edges).max() < 2000
    assert found.kind == "table" and not found.imu.gyro_radps.any()
    rms = np.sqrt(np.mean(found.imu.acc_mps2**2, axis=0)) / 9.80665
    assert (rms > 0.15).all() and (rms < 0.45).all()  # 0.3 g over the shake, and rest around it


def test_the_how_to_pages_command_joins_the_tables_csv(pair, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "runs" / "b7-2_9f31c2_0007_shake-12"
    shutil.copytree(pair.run, run)
    shutil.copy(pair.table, tmp_path / "shake-12.csv")
    fleet = _FLEETS["table"].replace("calibration.json", str(pair.calibration))
    (tmp_path / "fleet.toml").write_text(fleet.replace("kit/layout.toml", str(pair.layout)))
    type_all("moving-camera.md")
    result = read_result(run / "results")
    assert result.provenance.settings["camera"] == "table"
    assert result.alignment["camera_sensor"] == "table"


def test_what_is_missing_is_named_with_its_remedy(pair, tmp_path):
    with pytest.raises(ConfigError, match="no IMU 'lid'.*has: brick, camera"):
        samples(pair, CameraSensor(kind="imu", imu="lid", rotation=((1, 0, 0), (0, 1, 0), (0, 0, 1))))
    with pytest.raises(ConfigError, match="does not move with the table"):
        sensor(pair, "own", table=pair.table)
    with pytest.raises(ConfigError, match="--fleet|fleet file"):
        sensor(pair, "own", camera_run=pair.other_run)
    with pytest.raises(ConfigError, match="not a run of unit 'b7-1'"):
        sensor(pair, "other", camera_run=pair.run)
    wrong = tmp_path / "table.csv"
    wrong.write_text("Sample,AX,AY,AW\n" + "".join(f"{i},0,0,0\n" for i in range(100)))
    with pytest.raises(RunFormatError, match="no column AZ; there are sample, AX, AY, AW"):
        samples(pair, sensor(pair, "table", table=wrong, sample_column="Sample"))
    problems = []
    chosen = sensor(pair, "table", table=pair.table)
    assert read_camera_sensor(read_run(pair.run), chosen, None, problems) is None
    assert "no time here" in problems[0]


@pytest.fixture(scope="module")
def combined(pair):
    """Two units that saw one shake, of which one missed the wave's first two edges, processed and combined."""
    import_twin(pair, missed_edges=2)
    calibration = pair.calibration.read_text().replace('"b7-2"', '"b7-3"')
    (pair.folder / "twin.json").write_text(calibration)
    fleet = ["--fleet", str(pair.folder / "twins.toml")]
    runs = [str(pair.folder / "runs" / f"{unit}_shake-12") for unit in ("b7-2", "b7-3")]
    for run in runs:
        done = CliRunner().invoke(app, ["process", run, *fleet], catch_exceptions=False)
        assert done.exit_code == 0, done.output
    done = CliRunner().invoke(app, ["combine", *runs, "--name", "shake-12", *fleet], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return pair.folder / "tests" / "shake-12", done.output


def test_edges_missed_by_one_unit_are_found_and_its_samples_put_right(combined):
    folder, said = combined
    units = {entry.unit: entry for entry in read_test(folder).units}
    assert {unit: (entry.edges, entry.slip_samples) for unit, entry in units.items()} == {
        "b7-2": ("agrees", 0), "b7-3": ("corrected", 2),
    }  # fmt: skip
    assert "edge 0 is the wave's edge +2" in said.replace("\n", " ")
    [loop] = read_test(folder).assemblies[0].loops
    assert loop["rms_mm"] < 0.03  # 10 ms of slip at some 100 mm/s would be 1 mm


def test_the_laboratorys_table_gets_the_motion_of_each_sample(pair, combined):
    folder, _ = combined
    output = folder / "merged.parquet"
    arguments = ["export", str(folder), "--daq", str(pair.table), "--sample-column", "Sample"]
    arguments += ["--first-sample", "1", "--format", "parquet", "--output", str(output)]
    done = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    merged = pq.read_table(output).to_pydict()
    channels = np.genfromtxt(pair.table, delimiter=",", names=True)
    np.testing.assert_array_equal(np.array(merged["sample"]) + 1, channels["Sample"])
    np.testing.assert_allclose(merged["AX"], channels["AX"])
    # The row of sample n holds the motion at edge n: 5 ms earlier or later it would be another by 0.1 mm and more.
    edges = read_run(pair.run).edges_ns
    truth = read_true_motion(pair.truth)
    R, t_mm = truth.at(edges)
    R_rest, t_rest = truth.at(edges[:1])
    shift = (t_mm - t_rest) @ R_rest[0]
    found = np.stack([np.array(merged[f"d{a}_mm"], dtype=float) for a in "xyz"], axis=1)
    arm = -np.array([10.0, 20.0, 30.0])  # of the brick's origin, seen from the layout's
    expected = shift + np.einsum("ji,njk,k->ni", R_rest[0], R, arm) - arm
    off = np.linalg.norm(found - expected, axis=1)
    assert np.nanmedian(off) < 0.02
    late = np.linalg.norm(found[1:] - expected[:-1], axis=1)
    assert np.nanmedian(late) > 3 * np.nanmedian(off)
