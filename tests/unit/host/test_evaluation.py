import json

import numpy as np
import pytest
from page_commands import type_all
from scipy.spatial.transform import Rotation
from small_lab import invented_run
from typer.testing import CliRunner

from bricktrack_common.errors import ConfigError, RunFormatError
from bricktrack_host.cli.main import app
from bricktrack_host.evaluation import filmed, filmed_sweeps
from bricktrack_host.evaluation.bound import cramer_rao_covariance
from bricktrack_host.evaluation.paper_brick import paper_brick
from bricktrack_host.evaluation.recorded import read_positions, score_recording
from bricktrack_host.evaluation.scores import joined, score_sweep
from bricktrack_host.evaluation.simulated_points import IdentityCount, score_points
from bricktrack_host.evaluation.summary import nees_per_dof, pooled
from bricktrack_host.evaluation.sweeps import Sweep, paper_sweeps
from bricktrack_host.evaluation.true_camera import PLANE_A_MM, PLANE_B_MM, TrueCamera
from bricktrack_host.tracking.optical_track import solve_poses
from bricktrack_host.tracks import OpticalTrack

BRICK = paper_brick()
CAMERA = TrueCamera.of_seed(5)


def sweeps():
    return paper_sweeps(BRICK, plane_a_mm=PLANE_A_MM, plane_b_mm=PLANE_B_MM, half_field=CAMERA.half_field)


def track_of(R, t, *, frames_a_step=1):
    n = len(t) * frames_a_step
    nan = np.full((n, 6, 6), np.nan)
    return OpticalTrack(
        t_ns=np.arange(n, dtype=np.int64) * 100_000_000,
        R_camera_brick=np.repeat(R, frames_a_step, axis=0),
        t_camera_brick_mm=np.repeat(t, frames_a_step, axis=0),
        covariance=nan,
        flags=np.zeros(n, dtype=np.int64),
        residual_px=np.full((n, 7, 2), np.nan),
        led_t_ns=np.zeros((n, 7), dtype=np.int64),
    )


def test_the_papers_sweeps_go_where_it_says():
    depth, diagonal, *rotations = sweeps()
    middle = 0.5 * (BRICK.led_positions_mm.min(axis=0) + BRICK.led_positions_mm.max(axis=0))
    z = (depth.t_camera_brick_mm + middle)[:, 2]
    assert z[0] == pytest.approx(101.117) and np.diff(z) == pytest.approx(1.0)
    assert 160.1 < z[-1] <= 161.111
    assert [s.name for s in rotations] == [f"rotation about {a}" for a in "xyz"]
    turned = Rotation.from_matrix(rotations[1].R_camera_brick).as_rotvec(degrees=True)
    np.testing.assert_allclose(turned[:, 1], np.arange(-30, 31), atol=1e-9)
    centres = np.einsum("nij,lj->nli", diagonal.R_camera_brick, BRICK.led_positions_mm)
    assert CAMERA.sees(CAMERA.project(centres + diagonal.t_camera_brick_mm[:, None]), 30.0).all()
    assert diagonal.step[-1] > 60.0


def test_the_bound_of_one_point_straight_ahead_is_that_of_a_pinhole():
    # Without rotation to find: u = f x / z, so x is known to z / f times the noise.
    positions = np.array([[0.0, 0, 0], [30.0, 0, 0], [0, 30.0, 0], [0, 0, 20.0], [-30, -10, 5.0]])
    pinhole = TrueCamera(1600.0, 960.0, 540.0, 0, 0, 0, 0, 0)
    seen = np.ones((1, 5), dtype=bool)
    t = np.array([[0.0, 0.0, 160.0]])
    bound = cramer_rao_covariance(pinhole.project, np.eye(3)[None], t, positions, seen, noise_px=0.1)[0]
    # The information on the shift alone, all else known, summed by hand over the five points.
    z = 160.0 + positions[:, 2]
    by_hand = np.sum((1600.0 / z) ** 2) / 0.1**2
    assert np.linalg.inv(bound)[3, 3] == pytest.approx(by_hand, rel=1e-6)
    # Noise doubled, sd doubled.
    twice = cramer_rao_covariance(pinhole.project, np.eye(3)[None], t, positions, seen, noise_px=0.2)[0]
    np.testing.assert_allclose(twice, 4 * bound, rtol=1e-9)


def test_errors_are_those_since_the_first_step_with_a_pose():
    sweep = sweeps()[0]
    R, t = sweep.R_camera_brick.copy(), sweep.t_camera_brick_mm + np.array([5.0, -3.0, 1.0])  # zeroed
    t[10:, 2] += 0.02
    R[20] = R[20] @ Rotation.from_rotvec([0, 0.5, 0], degrees=True).as_matrix()
    t[0] = np.nan
    score = score_sweep(sweep, R, t)
    assert score.n_posed == len(sweep) - 1
    np.testing.assert_allclose(score.error_mm[1:10], 0.0, atol=1e-12)
    np.testing.assert_allclose(score.error_mm[10:], [[0, 0, 0.02]] * (len(sweep) - 10), atol=1e-12)
    np.testing.assert_allclose(score.error_deg[20], [0, 0.5, 0], atol=1e-9)


def test_simulated_sweeps_of_points_come_out_at_the_bound():
    rng = np.random.default_rng(11)
    rays = CAMERA.calibrated(noise_px=0.05, rng=rng)
    scores = [score_points(s, BRICK, CAMERA, rays, noise_px=0.05, rng=rng) for s in sweeps()]
    assert all(s.n_posed == len(s.sweep) for s in scores)
    ratio = np.concatenate([s.error_mm[1:] / s.bound_mm[1:] for s in scores])
    # 325 steps that share five zeros: their root mean square is known to some 20 %.
    assert 0.75 < np.sqrt(np.mean(ratio**2)) < 1.3
    mm, deg = pooled(scores)
    assert (mm < 0.04).all() and deg < 0.05


def test_a_recorded_sweep_is_aligned_but_not_scaled(tmp_path):
    rng = np.random.default_rng(2)
    stage = np.column_stack([np.arange(12.0), rng.uniform(-5, 5, (12, 2))])
    tilt = Rotation.from_rotvec([3.0, -2.0, 5.0], degrees=True).as_matrix()
    R = np.tile(Rotation.from_rotvec([1, 2, 3], degrees=True).as_matrix(), (12, 1, 1))
    track = track_of(R, stage @ tilt.T * 1.01 + [1.0, 2.0, 130.0], frames_a_step=10)
    lines = [f"{k},{k + 0.85},{x:.6f},{y:.6f},{z:.6f}" for k, (x, y, z) in enumerate(stage)]
    table = tmp_path / "stage.csv"
    table.write_text("start_s,end_s,x_mm,y_mm,z_mm\n" + "\n".join(lines) + "\n", encoding="utf-8")
    score = score_recording(track, read_positions(table), name="stage")
    away = np.linalg.norm(stage - stage[0], axis=1)
    # One percent too long everywhere, whichever way the axes lie.
    np.testing.assert_allclose(np.linalg.norm(score.error_mm, axis=1), 0.01 * away, atol=1e-5)
    raw = score_recording(track, read_positions(table), name="stage", align=False)
    assert np.linalg.norm(raw.error_mm, axis=1).max() > 5 * 0.01 * away.max()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("start_s,end_s,x_mm\n0,1,2\n", "columns missing: y_mm, z_mm"),
        ("start_s,end_s,x_mm,y_mm,z_mm\n0,1,2,3,4\n1,2,far,3,4\n", "line 3: x_mm is 'far'"),
        ("start_s,end_s,x_mm,y_mm,z_mm\n0,1,2,3,4\n3,2,2,3,4\n", "line 3: the rest ends at 2 s"),
    ],
)
def test_a_table_that_cannot_be_meant_is_refused(tmp_path, text, message):
    table = tmp_path / "stage.csv"
    table.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        read_positions(table)


def test_rests_outside_the_recording_are_refused(tmp_path):
    table = tmp_path / "stage.csv"
    table.write_text("start_s,end_s,x_mm,y_mm,z_mm\n90,91,0,0,0\n92,93,1,0,0\n", encoding="utf-8")
    sweep = sweeps()[0]
    track = track_of(sweep.R_camera_brick, sweep.t_camera_brick_mm)
    with pytest.raises(ConfigError, match="0 of 2 rests have a pose"):
        score_recording(track, read_positions(table), name="stage")


def test_a_rest_in_which_the_brick_moves_is_refused(tmp_path):
    sweep = sweeps()[0]
    t = np.repeat(sweep.t_camera_brick_mm[:3], 20, axis=0)
    t += np.random.default_rng(1).normal(0, 0.02, t.shape)
    track = track_of(np.tile(np.eye(3), (60, 1, 1)), t)  # 0.1 s a frame: 2 s at each place
    table = tmp_path / "stage.csv"
    head = "start_s,end_s,x_mm,y_mm,z_mm\n0,1.9,0,0,0\n"
    table.write_text(head + "2,3.9,0,0,1\n4,5.9,0,0,2\n", encoding="utf-8")
    assert score_recording(track, read_positions(table), name="stage").rms_mm.max() < 0.03
    table.write_text(head + "2.8,4.7,0,0,1\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"rest 2, from 2.8 to 4.7 s: the brick moves on by 0\.\d+ mm"):
        score_recording(track, read_positions(table), name="stage")


def test_the_command_prints_json_and_writes_its_page(tmp_path, monkeypatch):
    # Two orientations in place of a hundred: the rest is what the command is.
    from bricktrack_host.evaluation import simulated_points

    monkeypatch.setitem(simulated_points.evaluate_points.__kwdefaults__, "n_orientations", 2)
    done = CliRunner().invoke(app, ["evaluate", "--json", "--seed", "3", "-o", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)
    assert said["simulated"] is True and said["identity"]["n"] == 2 and said["seeds"] == [3]
    assert len(said["sweeps"]) == 5 and 0.3 < said["all"]["nees_per_dof"] < 2.0
    page = (tmp_path / "out" / "evaluation.html").read_text(encoding="utf-8")
    assert "Simulated sweeps" in page and "0.2296" in page
    assert (tmp_path / "out" / "evaluation_1.png").stat().st_size > 20_000


def test_the_how_to_pages_command_evaluates_a_recording(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    invented_run(tmp_path / "runs" / "b2_9f31c2_0007_sweep", "b2")
    rests = "0.1,0.4,0,0,0\n0.5,0.9,0,0,0\n"  # the invented brick rests in its first second
    (tmp_path / "stage.csv").write_text("start_s,end_s,x_mm,y_mm,z_mm\n" + rests)
    [said] = type_all("evaluate.md", but=("bricktrack evaluate",)).values()  # simulated: the test above
    assert "stage" in said
    assert (tmp_path / "evaluation" / "evaluation.html").stat().st_size > 10_000


def test_a_run_without_positions_is_refused(tmp_path):
    done = CliRunner().invoke(app, ["evaluate", str(tmp_path)])
    assert done.exit_code == 1
    assert "needs both RUN and --positions" in " ".join(done.output.split())


def test_a_sweep_without_poses_has_no_errors():
    sweep = Sweep("x", np.arange(2.0), "mm", np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)))
    score = score_sweep(sweep, np.full((2, 3, 3), np.nan), np.full((2, 3), np.nan))
    assert score.n_posed == 0 and np.isnan(score.rms_mm).all() and np.isnan(score.rms_deg)


def test_the_filmed_sweeps_move_on_by_one_step_a_frame():
    path, names, spans = filmed_sweeps._path()
    assert names == ["between the planes", "corner to corner", *(f"rotation about {a}" for a in "xyz")]
    depth, diagonal, *turns = (path[s] for s in spans)
    np.testing.assert_allclose(np.diff(depth[:, 2]), 1.0)
    np.testing.assert_allclose(np.linalg.norm(np.diff(diagonal[:, :2], axis=0), axis=1), 1.0)
    for axis, turn in enumerate(turns):
        np.testing.assert_allclose(np.diff(turn[:, 3 + axis]), 1.0)
        # The LEDs' middle stays where it is.
        R = Rotation.from_rotvec(turn[:, 3:], degrees=True).as_matrix()
        middle = R @ filmed_sweeps._MIDDLE_BRICK_MM + turn[:, :3]
        np.testing.assert_allclose(middle, np.tile(filmed_sweeps._MIDDLE_BRICK_MM, (len(turn), 1)), atol=1e-9)
    # Nothing jumps: at most 0.3 m/s from one frame to the next.
    assert np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1).max() < 10.0


@pytest.mark.slow
def test_a_film_comes_with_all_that_it_takes_to_solve_it(tmp_path):
    done = []
    filmed.make_film(
        tmp_path, seed=4, seconds=0.4, motion="sines", progress=lambda n, of: done.append((n, of))
    )
    assert done == [(k, 12) for k in range(1, 13)]
    film = filmed.open_film(tmp_path)
    seen = film.observe()
    track = solve_poses(seen, film.rays, film.brick)
    error = np.linalg.norm(track.t_camera_brick_mm - film.t_camera_brick_mm, axis=1)
    assert error.max() < 0.3  # the first frames of a film have neighbours on one side only


def test_a_simulator_that_fails_is_an_error_that_says_why(tmp_path):
    (tmp_path / "motion.csv").write_text("nothing\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"ended with code 1: .*motion_csv"):
        filmed.make_film(tmp_path, seed=1, seconds=0.1, motion_csv=tmp_path / "motion.csv")


def test_what_is_missing_among_identities_is_named():
    counted = IdentityCount(100, 94, 3, 0, 1, {"no pose brings four LEDs onto blobs": 2})
    assert str(counted + IdentityCount(10, 9, 0, 1, 0, {})) == (
        "103 right, 3 right but for an LED left out, 1 wrong, 1 reported ambiguous, "
        "2 without an answer (no pose brings four LEDs onto blobs)"
    )


def test_sweeps_of_two_lenses_are_one_table():
    sweep = sweeps()[0]
    covariance = np.tile(np.diag([1e-4] * 3 + [0.01] * 3), (len(sweep), 1, 1))
    for_lens = [
        score_sweep(
            sweep,
            sweep.R_camera_brick,
            sweep.t_camera_brick_mm + np.outer(np.arange(len(sweep)) > 0, shift),
            covariance=covariance,
        )
        for shift in ([0.1, 0.0, 0.0], [0.0, 0.0, 0.2])
    ]
    both = joined(for_lens)
    assert len(both.sweep) == 2 * len(sweep)
    n = len(sweep)
    np.testing.assert_allclose(
        both.rms_mm**2, [0.01 * (n - 1) / (2 * n), 0, 0.04 * (n - 1) / (2 * n)], atol=1e-12
    )
    # (0.1 mm)^2 over 0.01 mm^2 is one, (0.2 mm)^2 four; the first step of each is right.
    assert nees_per_dof([both]) == pytest.approx((1 + 4) * (n - 1) / (2 * n) / 6)


def test_positions_with_semicolons_are_told_so(tmp_path):
    file = tmp_path / "stage.csv"
    file.write_text("start_s;end_s;x_mm;y_mm;z_mm\n0,5;1,2;0;0;0\n1,9;2,6;1;0;0\n")
    with pytest.raises(RunFormatError, match="parted by semicolons"):
        read_positions(file)
