"""The simulated world against finite differences of its own poses, taken with SciPy's rotations."""

import multiprocessing
import pickle
from pathlib import Path

import numpy as np
import pytest
from other_world import tell_first_edge_and_place
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from bricktrack_common.arrays import FloatArray
from bricktrack_common.errors import ConfigError
from bricktrack_device.sim.settings import HiddenLed, SimSettings
from bricktrack_device.sim.world import SimWorld, angular_rate_and_acceleration, make_epoch

ARMED_NS = 5_000_000_000_000
SETTINGS = SimSettings(motion="sines", amplitude_deg=15.0, shake_delay_s=1.0, quiet_s=0.5, shake_s=6.0)
FIRST_NS = ARMED_NS + 1_000_000_000
LEVER_ARM_MM = np.array([26.045, 53.000, 14.199])


def armed_world(settings: SimSettings = SETTINGS) -> SimWorld:
    world = SimWorld(settings, make_epoch())
    assert world.schedule(ARMED_NS) == ARMED_NS + round(settings.shake_delay_s * 1e9)
    return world


def test_the_gyroscope_feels_the_turning_of_the_poses() -> None:
    world = armed_world()
    t_ns = FIRST_NS + np.arange(600_000_000, 6_400_000_000, 37_000_000)
    h_ns = 20_000
    before, after = (Rotation.from_matrix(world.pose(t_ns + s)[0]) for s in (-h_ns, h_ns))
    expected = (before.inv() * after).as_rotvec() / (2 * h_ns * 1e-9)
    # h^2/6 of the third derivative, 2 rad/s at 20 Hz: 1e-6; the kit's sensor has the brick's axes.
    np.testing.assert_allclose(world.inertial((t_ns - FIRST_NS) * 1e-9).omega_radps, expected, atol=1e-5)
    np.testing.assert_allclose(world.twist(t_ns)[0], expected, atol=1e-5)


def test_the_accelerometer_feels_its_own_way_through_space_and_gravity() -> None:
    world = armed_world()
    t_ns = FIRST_NS + np.arange(600_000_000, 6_400_000_000, 37_000_000)
    h_ns = 200_000

    def sensor_mm(at_ns: np.ndarray) -> FloatArray:
        R, t_mm = world.pose(at_ns)
        return np.asarray(R @ LEVER_ARM_MM + t_mm)

    a, b, c = (sensor_mm(t_ns + s) for s in (-h_ns, 0, h_ns))
    acceleration = (a - 2 * b + c) / (h_ns * 1e-9) ** 2 * 1e-3
    R, _ = world.pose(t_ns)
    gravity = world.gravity_camera_mps2
    expected = np.einsum("nji,nj->ni", R, acceleration - gravity)
    # h^2/12 of the fourth derivative, 10 m/s^2 at 20 Hz: 5e-4 m/s^2.
    np.testing.assert_allclose(
        world.inertial((t_ns - FIRST_NS) * 1e-9).specific_force_mps2, expected, atol=2e-3
    )
    assert np.linalg.norm(gravity) == pytest.approx(9.80665) and gravity[1] > 9.7  # v points down


def test_with_a_camera_that_moves_each_sensor_feels_its_own_way_through_space() -> None:
    settings = SimSettings(
        motion="sines", amplitude_deg=15.0, quiet_s=0.5, shake_s=6.0, camera_acc_g=0.3, camera_rocking_deg=3.0
    )
    world = armed_world(settings)
    t_s = np.arange(0.6, 6.4, 0.037)
    camera_arm_mm = np.array([18.0, -25.0, -7.0])
    chip = world.camera_inertial(t_s, at_mm=camera_arm_mm)
    # The camera's acceleration is what a chip in its projection centre feels; from it the way, by quadrature.
    fine = np.arange(0.3, 6.7, 2e-4)
    centre = world.camera_inertial(fine, at_mm=np.zeros(3))
    still = Rotation.from_matrix(centre.R_still_imu)
    acceleration = still.apply(centre.specific_force_mps2) + world.gravity_camera_mps2
    way = CubicSpline(fine, acceleration).antiderivative(2)
    step = (still[:-1].inv() * still[1:]).as_rotvec() / 2e-4
    rate = CubicSpline(0.5 * (fine[1:] + fine[:-1]), step)
    turned = RotationSpline(fine, still)
    np.testing.assert_allclose(chip.omega_radps, rate(t_s), atol=2e-3)

    def felt(arm: FloatArray, at_s: FloatArray, *, on_brick: bool) -> FloatArray:
        def place(s: FloatArray) -> FloatArray:
            R, t_mm = world.pose(FIRST_NS + np.rint(s * 1e9).astype(np.int64))
            p = R @ arm + t_mm if on_brick else np.tile(arm, (len(s), 1))
            return np.asarray(turned(s).apply(1e-3 * p) + way(s))

        h = 2e-4
        a = (place(at_s - h) - 2 * place(at_s) + place(at_s + h)) / h**2
        axes = turned(at_s)
        if on_brick:
            axes = axes * Rotation.from_matrix(world.pose(FIRST_NS + np.rint(at_s * 1e9).astype(np.int64))[0])
        return np.asarray(axes.inv().apply(a - world.gravity_camera_mps2))

    # The splines and h^2/12 of the fourth derivative leave some 0.01 m/s^2 of 30.
    np.testing.assert_allclose(chip.specific_force_mps2, felt(camera_arm_mm, t_s, on_brick=False), atol=0.03)
    brick = world.inertial(t_s)
    np.testing.assert_allclose(brick.specific_force_mps2, felt(LEVER_ARM_MM, t_s, on_brick=True), atol=0.03)
    shaking = (t_s > 1.0) & (t_s < 6.0)
    rms = np.sqrt(np.mean((acceleration[(fine > 1.0) & (fine < 6.0)]) ** 2, axis=0)) / 9.80665
    assert (rms > 0.2).all() and (rms < 0.4).all()
    assert 2.0 < np.degrees(turned(t_s[shaking]).magnitude()).mean() < 10.0


def test_the_velocity_is_that_of_the_origin() -> None:
    world = armed_world()
    t_ns = FIRST_NS + np.arange(600_000_000, 6_400_000_000, 37_000_000)
    h_ns = 20_000
    expected = (world.pose(t_ns + h_ns)[1] - world.pose(t_ns - h_ns)[1]) / (2 * h_ns * 1e-9)
    np.testing.assert_allclose(world.twist(t_ns)[1], expected, atol=0.01)


def test_at_rest_only_gravity_is_felt() -> None:
    world = armed_world()
    R, _ = world.rest_pose
    at_rest = np.array([-1e3, -0.5, 0.2, 7.0])
    np.testing.assert_allclose(
        world.inertial(at_rest).specific_force_mps2,
        np.tile(-R.T @ world.gravity_camera_mps2, (4, 1)),
        atol=1e-6,
    )
    np.testing.assert_allclose(world.inertial(at_rest).omega_radps, 0, atol=1e-9)


def test_rate_and_acceleration_of_large_rotation_vectors_are_scipy_s() -> None:
    rng = np.random.default_rng(0)
    r0, r1, r2 = rng.normal(size=(3, 40, 3))
    r0 *= rng.uniform(0, 3, (40, 1)) / np.linalg.norm(r0, axis=1, keepdims=True)
    h = 1e-4

    def rotation(t: float) -> Rotation:
        return Rotation.from_rotvec(r0 + r1 * t + r2 * t**2 / 2)

    def rate(t: float) -> FloatArray:
        return np.asarray((rotation(t - h).inv() * rotation(t + h)).as_rotvec() / (2 * h))

    omega, alpha = angular_rate_and_acceleration(r0, r1, r2)
    np.testing.assert_allclose(omega, rate(0.0), atol=1e-6)
    np.testing.assert_allclose(alpha, (rate(1e-3) - rate(-1e-3)) / 2e-3, atol=1e-4)


def test_before_arming_the_brick_rests_and_no_edge_comes() -> None:
    world = SimWorld(SETTINGS, make_epoch())
    t_ns = np.array([0, 10**15])
    assert world.first_edge_ns is None and world.edge_times_ns(0, 10).size == 0
    R, t_mm = world.pose(t_ns)
    np.testing.assert_array_equal(R, np.tile(world.rest_pose[0], (2, 1, 1)))
    np.testing.assert_array_equal(t_mm, np.tile(world.rest_pose[1], (2, 1)))
    assert not world.card_cover(t_ns).any() and not world.leds_hidden(t_ns).any()


def test_the_shake_begins_after_the_quiet_time() -> None:
    world = armed_world()
    quiet, shaking = (world.pose(FIRST_NS + np.array([ms * 1_000_000]))[1] for ms in (499, 900))
    np.testing.assert_array_equal(quiet[0], world.rest_pose[1])
    assert np.abs(shaking[0] - world.rest_pose[1]).max() > 0.05


def test_edges_have_the_laboratory_s_period_on_the_unit_s_clock() -> None:
    edges = armed_world(SimSettings(square_wave_hz=250.0, clock_ppm=40.0)).edge_times_ns(0, 5001)
    assert edges[0] == FIRST_NS
    # 5000 periods of 4 ms are 20 s, and 40 ppm of that 800 us.
    assert edges[-1] - edges[0] == pytest.approx(20_000_800_000, abs=2)


@pytest.mark.slow
def test_another_process_lives_in_the_same_world() -> None:
    context = multiprocessing.get_context("spawn")
    epoch = make_epoch()
    world = SimWorld(SETTINGS, epoch)
    world.schedule(ARMED_NS)
    ours, theirs = context.Pipe(duplex=False)
    t_ns = FIRST_NS + 2_345_678_901
    process = context.Process(target=tell_first_edge_and_place, args=(SETTINGS, epoch, t_ns, theirs))
    process.start()
    theirs.close()
    found = ours.recv()  # an end of file where the process ends without an answer
    process.join()
    ours.close()
    assert found == (FIRST_NS, world.pose(np.array([t_ns]))[1].tolist())


def test_settings_pass_between_processes() -> None:
    assert pickle.loads(pickle.dumps(SETTINGS)) == SETTINGS


def test_a_layout_of_ones_own_is_put_in_the_middle_of_the_view(tmp_path: Path) -> None:
    leds = "".join(
        f'[[led]]\nname = "a{i}"\nposition_mm = [{x}, {y}, {z}]\naxis = [0, 0, -1]\nradius_mm = 2.5\n'
        for i, (x, y, z) in enumerate([(0, 0, 0), (-40, 0, 0), (-40, -30, 5), (0, -30, 0), (-20, -15, -8)])
    )
    (tmp_path / "layout.toml").write_text(leds)
    world = SimWorld(SimSettings(layout=str(tmp_path / "layout.toml")), make_epoch())
    R, t_mm = world.rest_pose
    at = world.brick.led_positions_mm @ R.T + t_mm
    assert np.abs(0.5 * (at.max(axis=0) + at.min(axis=0))[:2]).max() < 2.0
    assert 120 < at[:, 2].mean() < 145


def test_hiding_an_led_that_does_not_exist_is_refused() -> None:
    settings = SimSettings(hidden_leds=[HiddenLed(name="m9", start_s=1.0, duration_s=1.0)])
    with pytest.raises(ConfigError, match=r"sim\.hidden_leds: name: no LED 'm9'.*m0, m1"):
        SimWorld(settings, make_epoch())
