"""The simulated motions: exact derivatives, rest at both ends, impacts of the stated kind."""

from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from bricktrack_common.errors import ConfigError
from bricktrack_device.sim.motions import Motion, make_motion
from bricktrack_device.sim.settings import SimSettings

KINDS = ("sines", "sweep", "impacts")


def motion(kind: str, **more: object) -> Motion:
    return make_motion(SimSettings(motion=kind, shake_s=6.0, **more))  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", KINDS)
def test_the_derivatives_are_those_of_the_motion(kind: str) -> None:
    m = motion(kind)
    t = np.random.default_rng(0).uniform(-0.2, 6.2, 4000)
    h = 1e-6
    (before, before_rate, _), (_, rate, second), (after, after_rate, _) = m(t - h), m(t), m(t + h)
    # Central differences: h^2/6 times the third derivative, at most 1e9 mm/s^3 in a 1 ms impact, and rounding.
    np.testing.assert_allclose((after - before) / (2 * h), rate, atol=2e-3)
    # A half-sine's acceleration has a kink at its ends, where a difference over 2 us sees the mean of both sides.
    np.testing.assert_allclose((after_rate - before_rate) / (2 * h), second, rtol=1e-5, atol=400 if kind == "impacts" else 0.1)  # fmt: skip
    close = np.abs((after_rate - before_rate) / (2 * h) - second) < 0.1 + 1e-5 * np.abs(second)
    assert close.all(axis=1).mean() > 0.995


@pytest.mark.parametrize("kind", KINDS)
def test_the_brick_rests_before_and_after_and_starts_smoothly(kind: str) -> None:
    m = motion(kind)
    for parts in m(np.array([-5.0, -1e-9, 0.0, 6.0, 9.0])):
        np.testing.assert_allclose(parts, 0, atol=1e-6)
    _, _, second = m(np.array([1e-4, 6.0 - 1e-4]))
    assert np.abs(second).max() < 1.0  # mm/s^2 and rad/s^2: ten thousandths of what comes later


def test_a_seed_gives_the_same_shake_again_and_another_seed_another() -> None:
    t = np.linspace(0, 6, 50)
    a, b, c = (motion("sines", seed=s)(t)[0] for s in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - c).max() > 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_displacements_and_speeds_are_those_of_a_cracked_brick(kind: str) -> None:
    value, rate, _ = motion(kind)(np.linspace(0, 6, 12_001))
    assert 0.5 < np.abs(value[:, :3]).max() < 6.0
    assert 30 < np.linalg.norm(rate[:, :3], axis=1).max() < 400


def test_impacts_change_the_velocity_by_the_given_amount_within_three_milliseconds() -> None:
    t = np.arange(0, 6, 1e-4)
    _, rate, second = motion("impacts", impact_mps=0.3)(t)
    _, calm_rate, calm_second = motion("sines")(t)
    pulse = np.linalg.norm((second - calm_second)[:, :3], axis=1) * 1e-3
    starts = np.flatnonzero((pulse[1:] > 25) & (pulse[:-1] <= 25))
    assert len(starts) >= 4
    for i in starts:
        kick = np.linalg.norm((rate - calm_rate)[i : i + 30, :3], axis=1).max() * 1e-3
        assert 0.15 < kick <= 0.3  # between 0.6 and 1 times the largest, less what dies away meanwhile
        # a half sine of 1 to 3 ms has a peak of pi/2 times its mean
        width_s = np.pi / 2 * kick / pulse[i : i + 30].max()
        assert 0.0008 < width_s < 0.0033


class TestRecorded:
    def write(self, folder: Path, text: str) -> str:
        path = folder / "table.csv"
        path.write_text(text)
        return str(path)

    def test_a_recorded_motion_is_the_natural_spline_through_its_rows(self, tmp_path: Path) -> None:
        t = np.arange(0, 4.001, 0.02)
        q = np.stack([np.sin(5 * t), 0.2 * t, np.cos(3 * t), 2 * np.sin(2 * t), 0 * t, t**2 / 9], axis=1)
        rows = "\n".join(
            ",".join(repr(float(x)) for x in (7.5 + ti, *qi)) for ti, qi in zip(t, q, strict=True)
        )
        m = motion(
            "csv", motion_csv=self.write(tmp_path, f"t_s,x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n{rows}\n")
        )
        spline = CubicSpline(t, q - q[0], bc_type="natural")
        middle = np.linspace(0.5, 3.5, 333)  # clear of the ramps from and to rest
        scale = np.array([1, 1, 1, *[np.pi / 180] * 3])
        for i, parts in enumerate(m(middle)):
            np.testing.assert_allclose(parts, spline(middle, i) * scale, atol=1e-9)
        for parts in m(np.array([-1.0, 0.0, 4.0, 5.0])):
            np.testing.assert_allclose(parts, 0, atol=1e-9)

    def test_rotations_may_be_left_out(self, tmp_path: Path) -> None:
        rows = "\n".join(f"{i / 10},{i % 3},0,1" for i in range(20))
        m = motion("csv", motion_csv=self.write(tmp_path, f"t_s,x_mm,y_mm,z_mm\n{rows}\n"))
        value, _, _ = m(np.linspace(0, 2, 9))
        assert np.abs(value[:, 0]).max() > 0.5 and not value[:, 3:].any()

    @pytest.mark.parametrize(
        "text", ["", "t_s,x_mm\n0,1\n", "t_s,x_mm,y_mm,z_mm\n0,0,0,0\n1,x,0,0\n",
                 "t_s,x_mm,y_mm,z_mm\n" + "1,0,0,0\n" * 9, "t_s,x_mm,y_mm,z_mm\n" + "0,nan,0,0\n1,0,0,0\n2,0,0,0\n3,0,0,0\n"]
    )  # fmt: skip
    def test_a_table_that_is_none_is_refused_by_its_name(self, tmp_path: Path, text: str) -> None:
        with pytest.raises(ConfigError, match=r"table\.csv: sim\.motion_csv"):
            motion("csv", motion_csv=self.write(tmp_path, text))

    def test_a_missing_table_is_refused_by_its_name(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match=r"none\.csv.*No such file"):
            motion("csv", motion_csv=str(tmp_path / "none.csv"))
