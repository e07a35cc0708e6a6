"""The simulated rig: what it writes as the truth, and what it says of itself."""

import json
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bricktrack_common.brick_model import load_brick_model
from bricktrack_common.typed_data import load_toml
from bricktrack_device.config import CameraTable, DeviceConfig
from bricktrack_device.sim.lens import lens_of
from bricktrack_device.sim.settings import HiddenLed, SimSettings
from bricktrack_device.sim.sim_kit import write_sim_kit
from bricktrack_device.sim.sim_rig import SimRig

ARMED_NS = 9_000_000_000_000
SETTINGS = SimSettings(
    shake_s=4.0,
    dropouts=[(2.0, 0.5), (3.5, 0.25)],
    hidden_leds=[HiddenLed(name="m2", start_s=1.0, duration_s=2.0)],
)


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    rig = SimRig(SETTINGS, CameraTable())
    rig.bus_opener("/dev/i2c-3")
    rig.bus_opener("/dev/i2c-4")
    rig.world.schedule(ARMED_NS)
    path = rig.write_truth(tmp_path_factory.mktemp("run"), start_ns=ARMED_NS, end_ns=ARMED_NS + 7_000_000_000)
    rig.close()
    assert path is not None
    with np.load(path, allow_pickle=False) as file:
        return dict(file)


def test_the_truth_is_a_millisecond_grid_over_the_run(truth: dict[str, np.ndarray]) -> None:
    t_ns = truth["t_ns"]
    assert t_ns.dtype == np.int64 and t_ns[0] == ARMED_NS and t_ns[-1] == ARMED_NS + 7_000_000_000
    assert set(np.diff(t_ns)) == {1_000_000}
    assert truth["q_wxyz_camera_brick"].shape == (7001, 4) and truth["t_camera_brick_mm"].shape == (7001, 3)


def test_its_twist_is_the_derivative_of_its_poses(truth: dict[str, np.ndarray]) -> None:
    R = Rotation.from_quat(truth["q_wxyz_camera_brick"], scalar_first=True)
    turning = (R[:-2].inv() * R[2:]).as_rotvec() / 2e-3
    velocity = (truth["t_camera_brick_mm"][2:] - truth["t_camera_brick_mm"][:-2]) / 2e-3
    # Impacts of 1 to 3 ms are not followed by a difference over 2 ms: the ordinary motion is judged.
    off_rate = np.abs(turning - truth["omega_brick_radps"][1:-1]).max(axis=1)
    off_speed = np.abs(velocity - truth["v_camera_mmps"][1:-1]).max(axis=1)
    assert np.percentile(off_rate, 97) < 1e-2 and np.percentile(off_speed, 97) < 1.0
    assert np.abs(np.diff(truth["q_wxyz_camera_brick"], axis=0)).max() < 0.1  # no change of sign


def test_it_says_when_what_was_hidden(truth: dict[str, np.ndarray]) -> None:
    first = ARMED_NS + 1_000_000_000
    assert (truth["dropouts_ns"] - first).tolist() == [
        [2_000_000_000, 2_500_000_000], [3_500_000_000, 3_750_000_000]
    ]  # fmt: skip
    assert (truth["dropouts_partial_ns"] - truth["dropouts_ns"]).tolist() == [[-60_000_000, 60_000_000]] * 2
    assert truth["hidden_led_index"].tolist() == [2]
    assert (truth["hidden_led_ns"] - first).tolist() == [[1_000_000_000, 3_000_000_000]]


def test_it_names_sensors_lens_and_settings(truth: dict[str, np.ndarray]) -> None:
    assert truth["imu_buses"].tolist() == ["/dev/i2c-3", "/dev/i2c-4"]
    assert truth["imu_acc_bias_mps2"].shape == truth["imu_gyro_bias_dps"].shape == (2, 3)
    assert truth["imu_sample_period_s"] == pytest.approx([0.01, 0.01], rel=0.01)
    assert msgspec.convert(json.loads(str(truth["settings_json"])), SimSettings) == SETTINGS
    assert json.loads(str(truth["lens_json"]))["focal_px"] == lens_of(SETTINGS.seed).focal_px


def test_a_run_that_was_never_armed_has_a_truth_of_rest(tmp_path: Path) -> None:
    rig = SimRig(SETTINGS, CameraTable())
    path = rig.write_truth(tmp_path, start_ns=0, end_ns=5_000_000)
    rig.close()
    assert path is not None
    with np.load(path) as file:
        assert (
            len(file["t_ns"]) == 6 and not file["v_camera_mmps"].any() and file["dropouts_ns"].shape == (0, 2)
        )


def test_it_says_that_it_is_simulated() -> None:
    rig = SimRig(SimSettings(), CameraTable())
    assert rig.simulated and "simulated" in rig.describe()["model"]
    rig.close()


def test_every_setting_can_be_given_in_the_configuration(tmp_path: Path) -> None:
    path = tmp_path / "unit.toml"
    path.write_text(
        'backend = "sim"\n[sim]\nseed = 3\nmotion = "sweep"\nimpact_mps = 0.2\ndropouts = [[4.0, 0.5]]\n'
        '[[sim.hidden_leds]]\nname = "m1"\nstart_s = 1.0\nduration_s = 2.0\n'
        '[sim.imu]\nsample_hz = 1000.0\nclock_ppm = -30.0\non_camera = ["/dev/i2c-4"]\n'
        "[sim.faults]\nimu_nack_every = 50\nimu_bus_down = [[3.0, 0.2]]\nlate_edges = [[7, 300.0]]\n"
    )
    sim = load_toml(path, DeviceConfig).sim
    assert sim.imu.on_camera == ["/dev/i2c-4"] and sim.faults.late_edges == [(7, 300.0)]
    assert sim.hidden_leds[0].name == "m1" and sim.dropouts == [(4.0, 0.5)]


class TestKit:
    @pytest.fixture(scope="class")
    @classmethod
    def kit(cls, tmp_path_factory: pytest.TempPathFactory) -> Path:
        folder = tmp_path_factory.mktemp("kit")
        written = write_sim_kit(folder, SETTINGS)
        assert sorted(p.name for p in written) == ["calib_A.png", "calib_B.png", "layout.toml", "rig.toml"]
        return folder

    def test_the_layout_is_the_paper_s_and_loads(self, kit: Path) -> None:
        brick = load_brick_model(kit / "layout.toml")
        assert brick.led_names == ("m0", "m1", "m2", "m3", "m4", "m5", "m6")
        assert brick.imu_lever_arm_mm is not None and brick.imu_lever_arm_mm.tolist() == [
            26.045,
            53.0,
            14.199,
        ]
        assert brick.led_profile is not None and brick.led_profile.collar_mm == 0.7
        assert "simulated" in brick.led_profile.source
        assert brick.led_positions_mm[2].tolist() == [51.62, 12.5, 0.0]

    @pytest.mark.parametrize(("plane", "z_mm"), [("A", 101.117), ("B", 161.111)])
    def test_dots_lie_where_opencv_projects_them(self, kit: Path, plane: str, z_mm: float) -> None:
        grey = cv2.imread(str(kit / f"calib_{plane}.png"), cv2.IMREAD_UNCHANGED)
        assert grey.shape == (1080, 1920) and grey.dtype == np.uint8
        lens = lens_of(SETTINGS.seed)
        K = np.array([[lens.focal_px, 0, lens.cx_px], [0, lens.focal_px, lens.cy_px], [0, 0, 1.0]])
        distortion = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
        x, y = np.meshgrid(np.arange(-11.5, 12) * 4.0, np.arange(-5.5, 6) * 4.0)
        angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
        errors = []
        for cx, cy in zip(x.ravel(), y.ravel(), strict=True):
            rim = np.stack([cx + np.cos(angle), cy + np.sin(angle), np.full(60, z_mm)], axis=-1)
            uv, _ = cv2.projectPoints(rim, np.zeros(3), np.zeros(3), K, distortion)
            m = cv2.moments(uv[:, 0].astype(np.float32))
            expected = np.array([m["m10"], m["m01"]]) / m["m00"]
            u0, v0 = np.rint(expected).astype(int) - 24
            window = np.maximum(grey[v0 : v0 + 49, u0 : u0 + 49].astype(np.float64) - 30, 0)
            v, u = np.mgrid[v0 : v0 + 49, u0 : u0 + 49]
            inside = np.hypot(u - expected[0], v - expected[1]) < 23
            window = window * inside
            errors.append(np.array([(u * window).sum(), (v * window).sum()]) / window.sum() - expected)
        # Noise of 0.6 % over a dot of 200 to 800 px is 0.01 px; uneven light shifts all a little.
        assert np.sqrt(np.mean(np.square(errors))) < 0.02 and np.abs(np.mean(errors, axis=0)).max() < 0.01

    def test_the_target_fills_the_picture(self, kit: Path) -> None:
        for plane in "AB":
            grey = cv2.imread(str(kit / f"calib_{plane}.png"), cv2.IMREAD_UNCHANGED)
            blocks = (grey > 100).reshape(9, 120, 16, 120).any(axis=(1, 3))
            assert blocks.all()

    def test_the_rig_file_says_what_the_pictures_show(self, kit: Path) -> None:
        text = (kit / "rig.toml").read_text()
        for line in ("simulated = true", "plane_a_mm = 101.117", "pitch_mm = 4.0", 'images = ["calib_A.png"'):
            assert line in text
