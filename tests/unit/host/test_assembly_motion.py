"""Components against their base: hand-worked poses, chains, loops and honest covariances."""

from dataclasses import replace

import numpy as np
import pytest
from example_report import example_result
from scipy.spatial.transform import Rotation

from bricktrack_host.assemblies.component_motion import AssemblyError, assembly_motion
from bricktrack_host.assemblies.motion import Motion, disagreement
from bricktrack_host.quality import PoseFlag
from bricktrack_host.results.rest_pose import RestPose
from bricktrack_host.tracks import FusedTrack
from bricktrack_host.transfer.assembly_config import AssemblyConfig, Component, View

N = 40


@pytest.fixture(scope="module")
def blank():
    return example_result()


def homogeneous(rotvec_deg, t_mm):
    matrix = np.tile(np.eye(4), (np.atleast_2d(rotvec_deg).shape[0], 1, 1))
    matrix[:, :3, :3] = Rotation.from_rotvec(np.atleast_2d(rotvec_deg), degrees=True).as_matrix()
    matrix[:, :3, 3] = t_mm
    return matrix


def random_motion(rng, n=N):
    """Return how a component moves in brick axes, as 4 x 4 matrices, at rest in the first row."""
    path = np.linspace(0, 1, n)[:, None]
    return homogeneous(path * rng.normal(0, 4, 3), path * rng.normal(0, 3, 3))


def view_result(blank, base_motion, led_motion, *, layout, camera, start=0):
    """Return what a unit reports whose camera rides on one component and whose LEDs on another.

    Written with 4 x 4 matrices from the definition: ``camera`` and ``layout`` are where they stand in the brick
    at rest, and each rides with its component.
    """
    at = np.linalg.inv(base_motion @ camera) @ led_motion @ layout
    n = len(at)
    rest = np.linalg.inv(camera) @ layout
    track = FusedTrack(
        t_ns=np.arange(n) * 5_000_000,
        R_camera_brick=at[:, :3, :3],
        t_camera_brick_mm=at[:, :3, 3],
        omega_brick_radps=np.zeros((n, 3)),
        v_camera_mmps=np.zeros((n, 3)),
        covariance=np.tile(np.diag([1e-8] * 3 + [1e-4] * 3), (n, 1, 1)),
        flags=np.zeros(n, dtype=np.int64),
    )
    rest_pose = RestPose(
        rest[0, :3, :3], rest[0, :3, 3], (0, 1), 10_000, np.full(3, 1e-3), np.full(3, 1e-5),
        np.diag([1e-14] * 3 + [1e-10] * 3), "found",
    )  # fmt: skip
    return replace(blank, fused={"edge": track}, edge_index=np.arange(start, start + n), rest=rest_pose)


def view(unit, camera_on, leds_on, layout):
    return View(
        unit=unit,
        camera_on=camera_on,
        leds_on=leds_on,
        position_brick_layout_mm=tuple(layout[0, :3, 3]),
        rotation_brick_layout=tuple(tuple(row) for row in layout[0, :3, :3]),
    )


def triple(blank, seed=3):
    """Return a TCB with B seen from A, C from B, and, closing the loop, A from C; and the true motions."""
    rng = np.random.default_rng(seed)
    true = {"A": np.tile(np.eye(4), (N, 1, 1)), "B": random_motion(rng), "C": random_motion(rng)}
    views, results = [], {}
    for unit, camera_on, leds_on in (("u1", "A", "B"), ("u2", "B", "C"), ("u3", "C", "A")):
        layout = homogeneous(rng.normal(0, 60, 3), rng.normal(0, 40, 3))
        camera = homogeneous(rng.normal(0, 60, 3), rng.normal(0, 40, 3))
        views.append(view(unit, camera_on, leds_on, layout))
        results[unit] = view_result(blank, true[camera_on], true[leds_on], layout=layout, camera=camera)
    config = AssemblyConfig(
        name="brick-7",
        kind="TCB",
        base="A",
        component=[Component(name=n) for n in "ABC"],
        view=views,
    )
    return config, results, true


def test_a_quarter_turn_about_a_far_point_is_what_paper_and_pencil_say(blank):
    # The LEDs sit 100 mm along x from the brick's origin; the component turns by 90 degrees about z at the origin,
    # as the brick's axes say. The point at the origin stays, the LEDs go from (100, 0, 0) to (0, 100, 0).
    layout = homogeneous([0, 0, 0], [100, 0, 0])
    moved = homogeneous([[0, 0, 0], [0, 0, 90]], [0, 0, 0])
    still = np.tile(np.eye(4), (2, 1, 1))
    result = view_result(blank, still, moved, layout=layout, camera=homogeneous([0, 0, 0], [0, 0, -100]))
    config = AssemblyConfig(
        name="b",
        kind="DCB",
        base="A",
        component=[Component(name="A"), Component(name="B", point_mm=(50.0, 0.0, 0.0))],
        view=[view("u1", "A", "B", layout)],
    )
    [b] = assembly_motion(config, {"u1": result}).components
    np.testing.assert_allclose(b.motion.t_mm[1], [0, 0, 0], atol=1e-12)
    moved_point = b.motion.about(config.component[1].point_mm)
    np.testing.assert_allclose(moved_point.t_mm[1], [-50, 50, 0], atol=1e-12)


def test_a_chain_gives_each_component_in_the_axes_of_the_base(blank):
    config, results, true = triple(blank)
    del results["u3"]
    motion = assembly_motion(config, results)
    assert [c.chain for c in motion.components] == [("u1",), ("u1", "u2")]
    for component in motion.components:
        np.testing.assert_allclose(component.motion.R, true[component.component][:, :3, :3], atol=1e-12)
        np.testing.assert_allclose(component.motion.t_mm, true[component.component][:, :3, 3], atol=1e-10)
    assert "u3: no result in this test" in motion.problems


def test_a_component_seen_from_its_own_side_is_the_same(blank):
    """The camera may ride on the outer component and look back at the base."""
    config, results, true = triple(blank)
    only = {"u3": results["u3"]}
    motion = assembly_motion(config, only)
    [c] = motion.components
    assert c.component == "C"
    np.testing.assert_allclose(c.motion.t_mm, true["C"][:, :3, 3], atol=1e-10)
    assert any("B: not seen" in problem for problem in motion.problems)


def test_a_loop_closes_when_all_mounts_are_right_and_gapes_when_one_is_wrong(blank):
    config, results, _ = triple(blank)
    [loop] = assembly_motion(config, results).loops
    assert loop.rms_mm < 1e-9
    wrong = homogeneous([0, 0, 3], [0, 0, 0]) @ homogeneous(
        Rotation.from_matrix(config.view[0].rotation_brick_layout).as_rotvec(degrees=True),
        config.view[0].position_brick_layout_mm,
    )
    config.view[0] = view("u1", "A", "B", wrong)
    bad = assembly_motion(config, results)
    assert bad.loops[0].normalised > 4
    assert any("gapes" in problem for problem in bad.problems)


def test_a_slipped_unit_is_put_right_by_its_slip(blank):
    config, results, true = triple(blank)
    del results["u3"]
    results["u2"] = replace(results["u2"], edge_index=results["u2"].edge_index - 1)
    c = assembly_motion(config, results, slips={"u2": 1}).components[1]
    np.testing.assert_allclose(c.motion.t_mm, true["C"][:, :3, 3], atol=1e-10)
    off = assembly_motion(config, results).components[1].motion
    assert np.isnan(off.t_mm[0]).all(), "the first sample has one of two views only"
    assert off.flags[0] & PoseFlag.NO_POSE
    assert np.nanmax(np.abs(off.t_mm[1:] - true["C"][:, :3, 3])) > 0.01


def test_covariances_are_those_of_a_thousand_noisy_runs(blank):
    rng = np.random.default_rng(5)

    def noisy(motion, sd):
        n = len(motion)
        step = rng.normal(0, 1, (n, 6)) * sd
        out = motion.copy()
        out[:, :3, :3] = motion[:, :3, :3] @ Rotation.from_rotvec(step[:, :3]).as_matrix()
        out[:, :3, 3] += step[:, 3:]
        return out

    n = 4000
    sd = np.array([1e-3, 2e-3, 3e-3, 0.1, 0.2, 0.3])
    first, second = (
        np.repeat(homogeneous(rng.normal(0, 40, 3), rng.normal(0, 50, 3)), n, axis=0) for _ in range(2)
    )
    layout = homogeneous(rng.normal(0, 60, 3), rng.normal(0, 40, 3))

    def as_motion(matrix):
        covariance = np.tile(np.diag(sd**2), (len(matrix), 1, 1))
        return Motion(matrix[:, :3, :3], matrix[:, :3, 3], covariance, np.zeros(len(matrix), dtype=np.int64))

    pose = View(
        unit="u", camera_on="A", leds_on="B", position_brick_layout_mm=tuple(layout[0, :3, 3]),
        rotation_brick_layout=tuple(map(tuple, layout[0, :3, :3])),
    ).pose_brick_layout  # fmt: skip
    seen = (as_motion(noisy(first, sd)) @ as_motion(noisy(second, sd)).inverse()).in_axes(pose)
    true = (as_motion(first) @ as_motion(second).inverse()).in_axes(pose)
    turn = Rotation.from_matrix(np.swapaxes(seen.R, 1, 2) @ true.R).as_rotvec()
    error = np.concatenate([turn, true.t_mm - seen.t_mm], axis=1)
    normalised = np.einsum("ni,nij,nj->n", error, np.linalg.inv(true.covariance), error)
    # Mean of chi squared with 6 degrees of freedom; its standard error over 4000 is 0.055, and the second order
    # of rotations of some milliradians over 50 mm is far below it.
    assert normalised.mean() == pytest.approx(6, abs=0.25)
    point = [10.0, -20.0, 30.0]
    off = true.about(point).t_mm - seen.about(point).t_mm
    covariance = true.about(point).covariance[:, 3:, 3:]
    assert np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off).mean() == pytest.approx(3, abs=0.2)
    _, _, apart = disagreement(as_motion(noisy(first, sd)), as_motion(noisy(first, sd)))
    assert apart.mean() == pytest.approx(6, abs=0.25)


def test_no_result_at_all_is_said(blank):
    config, _, _ = triple(blank)
    with pytest.raises(AssemblyError, match="brick-7"):
        assembly_motion(config, {})
