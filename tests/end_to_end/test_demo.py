"""The whole chain as `make demo` runs it: the real daemon on simulated sensors, its socket, pull, process, truth."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bricktrack_common.run_folder import read_run
from bricktrack_host.results.result_store import read_result
from bricktrack_host.results.true_motion import read_true_motion
from bricktrack_host.results.truth import compare_with_truth

SECONDS = 4.0


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo") / "demo"
    done = subprocess.run(
        [
            Path(sys.executable).with_name("bricktrack"),
            "demo",
            "--folder",
            folder,
            "--duration",
            str(SECONDS),
        ],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    log = folder / "bricktrackd.log"
    assert done.returncode == 0, done.stdout + done.stderr + (log.read_text() if log.exists() else "")
    return folder, done.stdout


@pytest.fixture(scope="module")
def run_folder(demo):
    (run,) = (demo[0] / "runs").iterdir()
    return run


@pytest.mark.slow
def test_the_run_is_whole_and_called_simulated(demo, run_folder):
    run = read_run(run_folder, verify_hashes=True)
    assert run.manifest.simulated
    assert run.manifest.state == "complete"
    assert run.edges_ns.size > 0.9 * 200 * SECONDS  # the wave's 200 Hz
    assert run.edges_ns[0] == run.manifest.trigger.t0_ns
    _, samples = run.imus["brick"]
    assert len(samples.t_ns) > 90 * SECONDS
    # The unit keeps its copy until someone deletes it, and the host's is the same to the last byte.
    on_card = next((demo[0] / "card").rglob("manifest.json"))
    assert on_card.read_bytes() == (run_folder / "manifest.json").read_bytes()


@pytest.mark.slow
def test_errors_are_printed_for_optical_and_fused_and_each_stage_has_its_time(demo):
    output = demo[1]
    for words in (
        "optical, at frames",
        "fused, at frames",
        "fused, between frames",
        "fused, during dropouts",
    ):
        assert words in output
    for words in ("decode and find LEDs", "solve poses", "fuse", "write report", "simulated truth"):
        assert words in output


@pytest.mark.slow
def test_poses_are_near_the_truth(run_folder):
    result = read_result(run_folder / "results")
    comparison = compare_with_truth(result, read_true_motion(run_folder / "truth.npz"))
    rms = {(g.source, g.group): np.array(g.rms) for g in comparison.groups if g.n}
    # The LEDs' shape is known and the camera calibrated: what remains is centroids of some 0.03 px at 13 px/mm, four
    # times that in depth, and the twist within a frame. A factor of five leaves room for dropped frames.
    assert (rms["optical", "at frames"][:3] < [0.05, 0.05, 0.25]).all()
    assert (rms["fused", "at frames"][:3] < [0.10, 0.10, 0.25]).all()
    assert (rms["fused", "at frames"][3:] < 0.5).all()
    # Without the IMU nothing at all is known of a card's 0.4 s; the brick moves by millimetres meanwhile.
    assert (rms["fused", "during dropouts"][:3] < 2.0).all()


@pytest.mark.slow
def test_a_folder_that_is_no_demo_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("ten years of work")
    done = subprocess.run(
        [Path(sys.executable).with_name("bricktrack"), "demo", "--folder", tmp_path],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 1
    assert "holds no earlier demo" in done.stderr
    assert (tmp_path / "thesis.tex").read_text() == "ten years of work"
