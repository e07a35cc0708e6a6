"""Results on disk: the same run gives the same bytes, nothing is half written, and everything comes back."""

import csv
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import example_report as example
import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from bricktrack_common.errors import RunFormatError, StorageError, TrackingError
from bricktrack_common.poses import Pose
from bricktrack_host.quality import PoseFlag
from bricktrack_host.results.ray_errors import RayErrors
from bricktrack_host.results.rest_pose import rest_of_fused, tare
from bricktrack_host.results.result_store import earlier_results, read_result, results_id, write_results
from bricktrack_host.tracks import FusedTrack, OpticalTrack

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def result():
    made = example.example_result()
    rng = np.random.default_rng(4)
    about = Pose(made.rest.R_camera_rest, made.rest.t_camera_rest_mm)
    errors = RayErrors(about, rng.normal(0, 1e-6, (6, 3)), rng.normal(0, 1e-8, (6, 6, 3)))
    rest = replace(made.rest, ray_errors=errors)
    aside_mm, covariance = np.array([0.02, -0.01, 0.05]), np.diag([1e-9] * 3 + [1e-5] * 3)
    own = replace(rest, t_camera_rest_mm=rest.t_camera_rest_mm + aside_mm, covariance=covariance)
    fused = {
        kind: replace(track, with_rest=np.tile(0.4 * covariance, (len(track.t_ns), 1, 1)))
        for kind, track in made.fused.items()
    }
    return replace(made, rest=rest, fused_rest=own, fused=fused)


@pytest.fixture(scope="module")
def folder(result, tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "results"
    write_results(result, path)
    return path


def test_processing_again_gives_the_same_bytes_whatever_the_time_it_took(result, folder, tmp_path):
    again = replace(result, timings_s={"decode": 1234.5})
    write_results(again, tmp_path / "results")
    names = {p.name for p in folder.iterdir()}
    assert names == {p.name for p in (tmp_path / "results").iterdir()}
    for name in names - {"timings.json"}:
        assert (folder / name).read_bytes() == (tmp_path / "results" / name).read_bytes(), name
    assert json.loads((tmp_path / "results" / "timings.json").read_text()) == {"decode": 1234.5}


def test_only_what_repeats_is_packed_with_a_dictionary(folder):
    group = pq.read_metadata(folder / "fused.parquet").row_group(0)
    columns = (group.column(i) for i in range(group.num_columns))
    dictionaries = {c.path_in_schema for c in columns if "RLE_DICTIONARY" in c.encodings}
    assert {"kind", "flag_words"} <= dictionaries
    assert not [name for name in dictionaries if name.endswith(("_mm", "_rad", "_deg", "_mmps", "element"))]


def test_everything_comes_back(result, folder):
    back = read_result(folder)
    for track, other in [
        (result.optical, back.optical),
        *((result.fused[k], back.fused[k]) for k in result.fused),
    ]:
        np.testing.assert_array_equal(track.t_ns, other.t_ns)
        np.testing.assert_array_equal(track.t_camera_brick_mm, other.t_camera_brick_mm)
        np.testing.assert_array_equal(track.covariance, other.covariance)
        np.testing.assert_array_equal(track.flags, other.flags)
        # Rotations pass through a quaternion: rounding of float64 only.
        np.testing.assert_allclose(track.R_camera_brick, other.R_camera_brick, atol=1e-14)
    for name in (
        "sensor_timestamp_ns",
        "exposure_ns",
        "uv_px",
        "cov_px2",
        "area_px2",
        "led_flags",
        "frame_flags",
    ):
        np.testing.assert_array_equal(getattr(result.observations, name), getattr(back.observations, name))
    np.testing.assert_array_equal(result.optical.residual_px, back.optical.residual_px)
    np.testing.assert_array_equal(result.optical.led_t_ns, back.optical.led_t_ns)
    np.testing.assert_array_equal(result.edge_index, back.edge_index)
    np.testing.assert_array_equal(result.imu.gyro_radps, back.imu.gyro_radps)
    np.testing.assert_array_equal(result.imu_camera_t_ns, back.imu_camera_t_ns)
    for rest, other in ((result.rest, back.rest), (result.fused_rest, back.fused_rest)):
        for name in ("R_camera_rest", "t_camera_rest_mm", "covariance", "spread_mm"):
            np.testing.assert_array_equal(getattr(rest, name), getattr(other, name))
    for kind, seen in result.from_rest.items():
        # The optical one is worked out again, by rotations that have passed through a quaternion.
        np.testing.assert_allclose(seen.covariance, back.from_rest[kind].covariance, rtol=1e-9, atol=1e-18)
    for name in ("factor", "slopes"):
        np.testing.assert_array_equal(
            getattr(result.rest.ray_errors, name), getattr(back.rest.ray_errors, name)
        )
    assert back.edge_fit.period_ns == result.edge_fit.period_ns
    assert back.manifest == result.manifest
    assert back.provenance == result.provenance
    assert back.problems == result.problems
    assert back.timings_s == result.timings_s


def test_columns_agree_with_scipy_about_the_same_pose(result, folder):
    table = pq.read_table(folder / "fused.parquet").to_pydict()
    i = next(i for i, k in enumerate(table["kind"]) if k == "edge" and table["edge_index"][i] == 700)
    track = result.fused["edge"]
    row = int(np.flatnonzero(result.edge_index == 700)[0])
    rotation = Rotation.from_matrix(track.R_camera_brick[row])
    q = np.array([table[f"q_{c}"][i] for c in "xyzw"])
    assert abs(np.dot(q, rotation.as_quat())) == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose([table[f"rvec_{c}_rad"][i] for c in "xyz"], rotation.as_rotvec(), atol=1e-12)
    np.testing.assert_allclose(
        [table[f"angle_{c}_deg"][i] for c in "xyz"], rotation.as_euler("XYZ", degrees=True), atol=1e-10
    )
    rest = Rotation.from_matrix(result.fused_rest.R_camera_rest)
    moved = rest.inv().apply(track.t_camera_brick_mm[row] - result.fused_rest.t_camera_rest_mm)
    np.testing.assert_allclose([table[f"d{c}_mm"][i] for c in "xyz"], moved, atol=1e-12)
    turned = (rest.inv() * rotation).as_euler("XYZ", degrees=True)
    np.testing.assert_allclose([table[f"dangle_{c}_deg"][i] for c in "xyz"], turned, atol=1e-10)
    velocity = rest.inv().apply(track.v_camera_mmps[row])
    np.testing.assert_allclose([table[f"dv_{c}_mmps"][i] for c in "xyz"], velocity, atol=1e-10)
    sd = np.sqrt(np.diag(track.covariance[row]))
    np.testing.assert_allclose([table[f"sd_{c}_mm"][i] for c in "xyz"], sd[3:])
    np.testing.assert_allclose([table[f"sd_rot_{c}_deg"][i] for c in "xyz"], np.rad2deg(sd[:3]))
    assert table["t_s"][i] == pytest.approx((track.t_ns[row] - result.t0_ns) / 1e9, abs=1e-12)
    # The edge's own instant is its sample number, to a nanosecond of 5 ms.
    assert table["daq_sample"][i] == pytest.approx(700, abs=3e-7)


def test_fused_rows_are_in_order_of_time_and_quaternions_do_not_jump(folder):
    table = pq.read_table(folder / "fused.parquet").to_pydict()
    assert np.all(np.diff(table["t_ns"]) >= 0)
    q = np.stack([table[f"q_{c}"] for c in "wxyz"], axis=1)
    assert np.einsum("ij,ij->i", q[1:], q[:-1]).min() > 0.9


def test_every_column_says_its_unit_and_meaning_and_tables_carry_their_origin(folder, result):
    for path in folder.glob("*.parquet"):
        schema = pq.read_schema(path)
        for field in schema:
            assert field.metadata[b"meaning"], (path.name, field.name)
            assert b"unit" in field.metadata
        meta = schema.metadata
        assert b"intrinsic XYZ" in meta[b"bricktrack.angles"]
        assert b"w, x, y, z" in meta[b"bricktrack.quaternion"]
        assert meta[b"bricktrack.simulated"] == b"true"
        provenance = json.loads(meta[b"bricktrack.provenance"])
        assert provenance["calibration_sha256"] == result.provenance.calibration_sha256
        assert provenance["settings"] == result.provenance.settings


def test_every_column_stands_in_the_documentation(folder):
    page = (ROOT / "docs" / "results-format.md").read_text(encoding="utf-8")
    missing = []
    for path in folder.glob("*.parquet"):
        for name in pq.read_schema(path).names:
            parts = [name, *(name.replace(f"_{c}_", "_{xyz}_") for c in "xyz")]
            parts += [name.replace(f"{c}_mm", "{xyz}_mm") for c in "xyz"]
            parts += [name.replace(f"q_{c}", "q_{wxyz}") for c in "wxyz"]
            if not any(f"`{part}`" in page for part in parts):
                missing.append(f"{path.name}: {name}")
    assert not missing


def test_csv_holds_the_same_numbers_to_the_last_bit(folder):
    table = pq.read_table(folder / "optical.parquet").to_pydict()
    with (folder / "optical.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [int(r["t_ns"]) for r in rows] == table["t_ns"]
    np.testing.assert_array_equal([float(r["x_mm"]) for r in rows], table["x_mm"])
    assert {r["flag_words"] for r in rows} == {"", "led_missing", "no_pose|led_missing"}
    lost = [r for r in rows if int(r["flags"]) & int(PoseFlag.NO_POSE)]
    assert lost
    assert all(r["dx_mm"].lower() == "nan" for r in lost)


def test_a_run_without_fusion_rest_trigger_or_edges_is_written_and_read(result, tmp_path):
    trigger = type(result.manifest.trigger)(pin="GPIO17", t0_ns=None)
    bare = replace(
        result,
        manifest=type(result.manifest)(
            **{f: getattr(result.manifest, f) for f in result.manifest.__struct_fields__} | {"trigger": trigger}
        ),
        fused={}, edge_index=np.empty(0, np.int64), edge_fit=None, imu=None, rest=None,
        fused_rest=None,
    )  # fmt: skip
    write_results(bare, tmp_path / "results")
    back = read_result(tmp_path / "results")
    assert back.fused == {}
    assert back.imu is None and back.imu_camera_t_ns is None
    assert back.rest is None
    assert back.edge_fit is None
    table = pq.read_table(tmp_path / "results" / "optical.parquet").to_pydict()
    assert np.isnan(table["dx_mm"]).all()
    assert np.isnan(table["t_s"]).all()
    assert np.isfinite(table["x_mm"]).any()


def test_results_of_version_2_count_all_from_one_rest_pose(result, folder, tmp_path):
    write_results(result, tmp_path / "results")
    summary = tmp_path / "results" / "summary.json"
    head = json.loads(summary.read_text())
    del head["fused_rest_pose"], head["rest_pose"]["covariance"]
    summary.write_text(json.dumps(head | {"version": 2}))
    for name in ("optical", "fused"):
        path = tmp_path / "results" / f"{name}.parquet"
        pq.write_table(pq.read_table(path).drop_columns(["dcovariance"]), path)
    back = read_result(tmp_path / "results")
    rest, track = result.rest, result.fused["edge"]
    assert back.fused_rest is None
    of_mean = np.square([*rest.spread_rad, *rest.spread_mm]) / rest.n_frames
    np.testing.assert_allclose(np.diagonal(back.rest.covariance), of_mean)
    seen = replace(rest, covariance=np.diag(of_mean)).from_rest(replace(track, with_rest=None))
    np.testing.assert_allclose(back.from_rest["edge"].t_mm, seen.t_mm, atol=1e-9)
    np.testing.assert_allclose(back.from_rest["edge"].covariance, seen.covariance, rtol=1e-6, atol=1e-18)


def test_a_kill_while_writing_leaves_the_old_results_whole(folder, tmp_path, result):
    target = tmp_path / "results"
    write_results(result, target)
    before = {p.name: p.read_bytes() for p in target.iterdir()}
    code = (
        "import os, sys; from pathlib import Path; from bricktrack_host.results import result_store as r;"
        "done = r.read_result(Path(sys.argv[1]));"
        "r.dump_json = lambda value: os._exit(9);"  # dies after the tables, before the summary
        "r.write_results(done, Path(sys.argv[1]))"
    )
    died = subprocess.run([sys.executable, "-c", code, str(target)], check=False)
    assert died.returncode == 9
    assert {p.name: p.read_bytes() for p in target.iterdir()} == before
    write_results(result, target)
    assert [p.name for p in tmp_path.iterdir()] == ["results"]


def test_results_that_differ_are_written_beside_and_the_same_are_not(tmp_path, result):
    target = tmp_path / "results"
    assert write_results(result, target) is None
    first = {p.name: p.read_bytes() for p in target.iterdir()}
    (target / "interactive.html").write_text("a page made since")
    assert write_results(replace(result, timings_s={"decode": 9.9}), target) is None
    assert earlier_results(target) == []
    assert (target / "interactive.html").read_text() == "a page made since"
    changed = replace(result, problems=(*result.problems, "another calibration"))
    assert write_results(changed, target) == tmp_path / "results_1"
    for name, data in first.items():
        assert name == "timings.json" or (tmp_path / "results_1" / name).read_bytes() == data
    assert read_result(target).problems == changed.problems
    (tmp_path / "results_notes").mkdir()
    (tmp_path / "results_7").mkdir()  # of somebody else, but its number is taken
    assert write_results(result, target) == tmp_path / "results_8"
    assert earlier_results(target) == [tmp_path / "results_1", tmp_path / "results_8"]
    assert results_id(target) == results_id(tmp_path / "results_1") != results_id(tmp_path / "results_8")


def test_a_kill_between_two_renames_gives_the_old_folder_back(tmp_path, result):
    target = tmp_path / "results"
    write_results(result, target)
    target.rename(tmp_path / ".results.previous")  # as a kill leaves it
    changed = replace(result, problems=("another",))
    assert write_results(changed, target) == tmp_path / "results_1"
    assert read_result(tmp_path / "results_1").problems == result.problems


def test_a_full_disk_is_said_and_leaves_no_result(result, tmp_path, monkeypatch):
    def full(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pq, "write_table", full)
    with pytest.raises(StorageError, match="no space left"):
        write_results(result, tmp_path / "results")
    assert not (tmp_path / "results").exists()


def test_a_folder_of_something_else_is_left_alone(result, tmp_path):
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "thesis.tex").write_text("years of work")
    with pytest.raises(StorageError, match="left alone"):
        write_results(result, tmp_path / "results")
    assert (tmp_path / "results" / "thesis.tex").read_text() == "years of work"


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda f: (f / "summary.json").unlink(), "no summary.json"),
        (lambda f: (f / "leds.parquet").unlink(), "missing"),
        (lambda f: (f / "fused.parquet").write_bytes(b"PAR1 not"), "not a readable"),
        (lambda f: (f / "summary.json").write_text('{"schema": "bricktrack.results", "version": 99}'), "up to version 3"),
        (lambda f: (f / "summary.json").write_text('{"schema": "other"}'), "not a bricktrack.results"),
    ],
)  # fmt: skip
def test_damaged_results_are_refused_in_words(result, tmp_path, damage, words):
    write_results(result, tmp_path / "results")
    damage(tmp_path / "results")
    with pytest.raises(RunFormatError, match=words):
        read_result(tmp_path / "results")


# The rest pose.


def still_then_moving(n_still: int, *, sd_mm: float = 0.01, seed: int = 5) -> OpticalTrack:
    rng = np.random.default_rng(seed)
    n = 60
    t_ns = 10**12 + np.arange(n, dtype=np.int64) * 33_327_000
    moving_s = np.clip((t_ns - t_ns[min(n_still, n) - 1]) / 1e9, 0, None)
    t_mm = np.array([1.0, -2.0, 130.0]) + np.outer(3 * np.sin(2 * np.pi * 4 * moving_s), [1, 0.3, 0.2])
    t_mm += rng.normal(0, sd_mm, (n, 3))
    R = Rotation.from_rotvec(np.array([0.1, 0.2, -0.05]) + rng.normal(0, 1e-4, (n, 3))).as_matrix()
    nothing = np.zeros(n, np.int64)
    covariance = np.diag([1e-8] * 3 + [sd_mm**2] * 3) * np.ones((n, 1, 1))
    return OpticalTrack(t_ns, R, t_mm, covariance, nothing, np.zeros((n, 7, 2)), np.zeros((n, 7), np.int64))


def test_rest_is_found_and_ends_where_the_motion_begins():
    rest = tare(still_then_moving(12))
    assert rest.source == "found"
    assert rest.n_frames in (11, 12)  # one may lie beyond five robust deviations
    # Twelve frames of 0.01 mm: the mean is good to 0.003 mm; four times that.
    np.testing.assert_allclose(rest.t_camera_rest_mm, [1, -2, 130], atol=0.012)
    turn = Rotation.from_matrix(rest.R_camera_rest).as_rotvec()
    np.testing.assert_allclose(turn, [0.1, 0.2, -0.05], atol=1.2e-4)


def test_four_frames_of_rest_are_enough_and_three_are_not():
    assert tare(still_then_moving(4)).n_frames == 4
    with pytest.raises(TrackingError, match="never stood still"):
        tare(still_then_moving(3))


def test_one_wild_frame_does_not_move_the_rest_pose():
    track = still_then_moving(30)
    track.t_camera_brick_mm[12] += 0.3  # noise is 0.01; a plain mean of 30 would be off by 0.01
    rest = tare(track, interval_ns=(int(track.t_ns[0]), int(track.t_ns[29])))
    assert rest.n_frames in (28, 29)
    # 0.01 / sqrt(29), three times
    np.testing.assert_allclose(rest.t_camera_rest_mm, [1, -2, 130], atol=0.0056)


def test_slow_start_is_cut_off_rest():
    track = still_then_moving(60)
    creep = np.clip(np.arange(60) - 20, 0, None) * 0.02  # each step well below the limit of a step
    track.t_camera_brick_mm[:, 0] += creep
    rest = tare(track)
    last = int(np.searchsorted(track.t_ns, rest.interval_ns[1]))
    assert 18 <= last <= 25
    assert abs(rest.t_camera_rest_mm[0] - 1) < 0.02


def test_gyroscope_ends_the_rest_before_the_camera_sees_anything(result):
    imu = result.imu
    shaken = imu.gyro_radps.copy()
    onset_ns = example.T0_NS + 400_000_000
    shaken[imu.t_ns > onset_ns] += 0.2
    rest = tare(result.optical, replace(imu, gyro_radps=shaken))
    assert result.rest.interval_ns[1] > onset_ns
    assert onset_ns - 40_000_000 < rest.interval_ns[1] <= onset_ns + 10_000_000


def test_a_brick_that_creeps_is_as_unsure_at_rest_as_it_moved_meanwhile():
    track = still_then_moving(60)
    for creep_mm in (0.0, 0.04):
        track.t_camera_brick_mm[:, 0] += creep_mm * np.linspace(-0.5, 0.5, 60)
        sd_mm = np.sqrt(np.diagonal(tare(track).covariance))[3]
        # Noise of 0.01 mm by quarters of 15 frames, by chance within a factor of two; a ramp's are 0.32 of it apart.
        expected_mm = max(0.01 / np.sqrt(15), 0.32 * creep_mm)
        assert expected_mm / 2 < sd_mm < 2 * expected_mm


def fused_beside(optical: OpticalTrack, aside_mm, *, shows_rest: bool) -> FusedTrack:
    """Return a motion beside the optical one, its error nearly all shared with the rest."""
    covariance = np.tile(np.diag([1e-10] * 3 + [1e-6] * 3), (len(optical.t_ns), 1, 1))
    zero = np.zeros_like(optical.t_camera_brick_mm)
    return FusedTrack(
        optical.t_ns, optical.R_camera_brick, optical.t_camera_brick_mm + aside_mm, zero, zero, covariance,
        optical.flags, 0.9 * covariance if shows_rest else None,
    )  # fmt: skip


def test_a_motion_beside_the_optical_poses_is_counted_from_its_own_rest():
    optical, aside_mm = still_then_moving(30), np.array([0.1, -0.2, 0.3])
    rest, fused = tare(optical), fused_beside(optical, aside_mm, shows_rest=True)
    own = rest_of_fused(rest, fused, optical)
    np.testing.assert_allclose(own.t_camera_rest_mm - rest.t_camera_rest_mm, aside_mm, atol=1e-3)
    seen = own.from_rest(fused)
    assert np.abs(seen.t_mm[:30].mean(axis=0)).max() < 1e-3
    # 0.2 of the pose's own variance, and what the noise leaves of the mean.
    extra = np.diagonal(tare(optical).covariance)[3:].max()
    variance = np.diagonal(seen.covariance, axis1=1, axis2=2)[:30, 3:]
    assert (variance >= 0.199e-6).all() and (variance < 0.2e-6 + 1.5 * extra).all()


@pytest.mark.parametrize("reaches", [True, False])
def test_a_motion_that_does_not_show_the_rest_is_as_unsure_as_both_poses(reaches):
    optical = still_then_moving(30)
    rest, fused = tare(optical), fused_beside(optical, np.zeros(3), shows_rest=not reaches)
    if not reaches:
        fused.t_camera_brick_mm[:28] = np.nan
    own = rest_of_fused(rest, fused, optical)
    np.testing.assert_array_equal(own.t_camera_rest_mm, rest.t_camera_rest_mm)
    expected = rest.covariance + optical.covariance[0]
    np.testing.assert_allclose(own.covariance, expected, rtol=1e-12)


def test_what_a_pose_shares_with_the_rest_drops_out_of_its_displacement():
    # Errors of both drawn together, against the displacement's covariance to first order.
    rng = np.random.default_rng(6)
    root = rng.standard_normal((12, 12)) * np.tile(np.repeat([1e-5, 1e-3], 3), 2)[:, None]
    joint, draws = root @ root.T, rng.standard_normal((4000, 12)) @ root.T
    rest = replace(tare(still_then_moving(30)), covariance=joint[6:, 6:])
    R, t_mm = Rotation.from_rotvec([0.3, 0.1, -0.2]).as_matrix(), np.array([4.0, 7.0, 120.0])
    stated = rest.relative_covariance(
        R[None], t_mm[None], joint[None, :6, :6], with_rest=joint[None, :6, 6:]
    )[0]
    true, found = rest.relative(R, t_mm), []
    for e in draws:
        moved = replace(
            rest,
            R_camera_rest=rest.R_camera_rest @ Rotation.from_rotvec(e[6:9]).as_matrix(),
            t_camera_rest_mm=rest.t_camera_rest_mm + e[9:],
        ).relative(R @ Rotation.from_rotvec(e[:3]).as_matrix(), t_mm + e[3:6])
        turn = Rotation.from_matrix(true.R.T @ moved.R).as_rotvec()
        found.append(np.concatenate([turn, moved.t_mm - true.t_mm]))
    sd = np.sqrt(np.diagonal(stated))
    # Of 4000 draws a correlation is known to 0.016, a variance to 0.022.
    np.testing.assert_allclose(
        np.cov(np.array(found).T) / np.outer(sd, sd), stated / np.outer(sd, sd), atol=0.08
    )


def test_a_given_interval_without_poses_is_refused(result):
    with pytest.raises(TrackingError, match="holds 0 poses"):
        tare(result.optical, interval_ns=(0, 1000))
