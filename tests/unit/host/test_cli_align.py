"""`bricktrack align` on files, and what it says of clocks that are known (simulated shakes)."""

import json
from dataclasses import replace

import numpy as np
import pytest
from brick_shakes import LEVER_ARM_MM, simulate_shake
from scipy.spatial.transform import Rotation
from slipped_stamps import slip
from typer.testing import CliRunner

from bricktrack_common.errors import RunFormatError
from bricktrack_host.cli.main import app
from bricktrack_host.fusion.alignment_report import report_alignment
from bricktrack_host.recordings.pose_csv import read_poses_csv
from bricktrack_host.reporting.alignment_plot import save_alignment_plot

OFFSET_S = 1.2345


def fields(values):
    return ",".join("" if isinstance(v, float) and np.isnan(v) else repr(v) for v in values)


@pytest.fixture(scope="module")
def shake():
    return simulate_shake(5, duration_s=6.0, offset_s=OFFSET_S, acc_lag_s=-0.0034, dropouts=((3.0, 3.4),))


@pytest.fixture(scope="module")
def files(shake, tmp_path_factory):
    folder = tmp_path_factory.mktemp("align")
    o = shake.optical
    q = np.full((len(o.t_ns), 4), np.nan)
    seen = np.isfinite(o.t_camera_brick_mm[:, 0])
    q[seen] = Rotation.from_matrix(o.R_camera_brick[seen]).as_quat()[:, [3, 0, 1, 2]]
    lines = ["t_ns,x_mm,y_mm,z_mm,q_w,q_x,q_y,q_z"]
    lines += [
        f"{t},{fields([*p.tolist(), *a.tolist()])}"
        for t, p, a in zip(o.t_ns, o.t_camera_brick_mm, q, strict=True)
    ]
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")
    lines = ["t_ns,ax_mps2,ay_mps2,az_mps2,gx_radps,gy_radps,gz_radps"]
    lines += [
        f"{t},{fields([*a.tolist(), *g.tolist()])}"
        for t, a, g in zip(shake.imu.t_ns, shake.imu.acc_mps2, shake.imu.gyro_radps, strict=True)
    ]
    (folder / "imu.csv").write_text("\n".join(lines) + "\n")
    return folder


def run(*args):
    return CliRunner().invoke(app, ["align", *map(str, args)])


def test_clocks_a_second_apart_are_found_from_files_and_drawn(files):
    picture = files / "clocks.png"
    result = run(
        "--poses", files / "poses.csv", "--imu", files / "imu.csv", "--within", 2, "--json", "--plot", picture
    )
    assert result.exit_code == 0, result.output
    (row,) = json.loads(result.stdout)["recordings"]
    assert row["offset_ms"] == pytest.approx(1e3 * OFFSET_S, abs=0.3)
    assert abs(row["offset_ms"] - 1e3 * OFFSET_S) < 4 * row["offset_sd_ms"]
    assert row["trusted"] and row["stamps_agree"]
    assert row["acc_lag_ms"] is None  # without a layout the IMU's place is not known
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_stamps_that_promise_another_offset_are_contradicted(files):
    result = run("--poses", files / "poses.csv", "--imu", files / "imu.csv", "--within", 2, "--stamps-sd", 5)
    assert result.exit_code == 1
    assert "motion and stamps disagree" in result.output


def test_an_offset_out_of_reach_is_not_guessed(files):
    result = run("--poses", files / "poses.csv", "--imu", files / "imu.csv", "--within", 0.3, "--json")
    assert result.exit_code == 1
    (row,) = json.loads(result.stdout)["recordings"]
    assert not row["trusted"] and row["source"] == "stamps" and row["stamps_agree"] is None


def test_with_the_lever_arm_the_lag_of_the_accelerometer_is_found(shake, tmp_path):
    report = report_alignment(
        shake.optical,
        shake.imu,
        lever_arm_mm=LEVER_ARM_MM,
        prior_sd_ns=2e9,
        max_offset_s=2.0,
        with_mount=True,
    )
    found = report.figures()
    assert found["acc_lag_ms"] == pytest.approx(-3.4, abs=0.4)
    assert abs(found["smoothed_offset_ms"] - 1e3 * OFFSET_S) < 4 * found["smoothed_offset_sd_ms"]
    assert np.allclose(found["lever_arm_mm"], LEVER_ARM_MM, atol=1.0)
    # The gyro at the offset found is what the camera saw, frame by frame: 0.1 deg of noise an axis.
    off = np.abs(report.optical_radps - report.gyro_radps)
    assert np.nanmedian(off) < np.radians(0.1 * np.sqrt(2) * 30)
    save_alignment_plot(report, tmp_path / "clocks.svg", title="simulated")
    assert "<svg" in (tmp_path / "clocks.svg").read_text()


def test_frame_stamps_that_step_are_told(shake):
    t_ns = shake.optical.t_ns.copy()
    t_ns[len(t_ns) // 2 :] += 5_000_000
    report = report_alignment(
        replace(shake.optical, t_ns=t_ns), shake.imu, prior_sd_ns=2e9, max_offset_s=2.0, frame_stamps_ns=t_ns
    )
    found = report.figures()
    assert found["stamps_agree"] is False
    assert "frame stamps step by" in found["stamps_problems"][0]
    steady = report_alignment(shake.optical, shake.imu, prior_sd_ns=2e9, max_offset_s=2.0).figures()
    assert steady["stamps_agree"] is True and steady["stamps_problems"] == []


def test_frame_stamps_that_slip_are_located_and_the_figures_are_of_mended_ones(shake):
    report = report_alignment(slip(shake.optical, 70, -1), shake.imu, prior_sd_ns=2e9, max_offset_s=2.0)
    found = report.figures()
    assert found["stamps_agree"] is False
    (one,) = found["stamps_slip"]
    assert one["late_periods"] == -1 and one["first"] <= 70 <= one["last"]
    assert found["offset_ms"] == pytest.approx(1e3 * OFFSET_S, abs=0.5)
    assert "1 period (33.33 ms) too early" in found["stamps_problems"][0]
    # What a run was mended of before agrees, and is said.
    again = report_alignment(
        report.slips.mended(slip(shake.optical, 70, -1)), shake.imu, prior_sd_ns=2e9, max_offset_s=2.0
    )
    assert again.stamps_agree is True
    assert again.figures()["frames_restamped"] == np.count_nonzero(report.slips.is_mended)


def test_the_command_says_where_stamps_slip(shake, files, tmp_path):
    rows = (files / "poses.csv").read_text().splitlines()
    head, *rows = rows
    stamps = [int(row.split(",")[0]) for row in rows]
    # The picture of row 70 is lost, and the stamps close up.
    kept = [row.split(",", 1)[1] for k, row in enumerate(rows) if k != 70]
    lines = [f"{t},{row}" for t, row in zip(stamps[:-1], kept, strict=True)]
    (tmp_path / "poses.csv").write_text("\n".join([head, *lines]) + "\n")
    result = run("--poses", tmp_path / "poses.csv", "--imu", files / "imu.csv", "--within", 2)
    assert result.exit_code == 1
    said = " ".join(result.output.split())
    assert "the frame stamps slip; what stands above is of mended ones" in said
    assert "too early; 1 picture lost and not counted" in said
    assert said.count("- frame stamps slip") == 1


def test_what_is_missing_or_contradictory_is_named(files, tmp_path):
    assert "nothing to align" in run().output
    assert "give one or the other" in run("somewhere", "--poses", files / "poses.csv").output
    assert "ends in .png" in run(
        "--poses", files / "poses.csv", "--imu", files / "imu.csv", "--plot", "clocks.gif"
    ).output.replace("\n", " ")
    with pytest.raises(RunFormatError, match="no column q_w"):
        read_poses_csv(files / "imu.csv", sd_deg=0.1, sd_mm=0.1)
    long = tmp_path / "long.csv"
    long.write_text("t_ns,q_w,q_x,q_y,q_z,x_mm,y_mm,z_mm\n1,1,0,0,0,0,0,0\n2,2,0,0,0,0,0,0\n")
    with pytest.raises(RunFormatError, match=r"line 3: the quaternion has length 2\.0000"):
        read_poses_csv(long, sd_deg=0.1, sd_mm=0.1)
