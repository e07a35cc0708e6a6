import numpy as np
import pytest

from bricktrack_common.brick_model import load_brick_model
from bricktrack_common.errors import ConfigError

LEDS = [(0, 0, 0), (24.6, 3.5, 12.6), (51.6, 12.5, 0), (0, 14.5, 0), (54.5, 49, 0)]


def layout(positions, extra="", axis="[0.0, 0.0, -1.0]"):
    leds = "\n".join(
        f'[[led]]\nname = "m{i}"\nposition_mm = {[float(x) for x in p]}\naxis = {axis}\nradius_mm = 3.0'
        for i, p in enumerate(positions)
    )
    return f"{leds}\n{extra}"


@pytest.fixture
def write(tmp_path):
    def _write(text):
        path = tmp_path / "layout.toml"
        path.write_text(text)
        return path

    return _write


def test_a_layout_is_read(write):
    model = load_brick_model(write(layout(LEDS, "[imu]\nlever_arm_mm = [26.045, 53.0, 14.199]")))
    assert model.led_names == ("m0", "m1", "m2", "m3", "m4")
    assert model.led_positions_mm[1].tolist() == [24.6, 3.5, 12.6]
    assert model.imu_lever_arm_mm.tolist() == [26.045, 53.0, 14.199]
    np.testing.assert_array_equal(model.R_brick_imu, np.eye(3))
    assert model.led_profile is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (layout([(x, y, 0) for x, y, _ in LEDS]), "all 5 LEDs lie in one plane"),
        (layout(LEDS[:4]), "4 LEDs; a pose needs at least 5"),
        (layout([(1, 0, 0), *LEDS[1:]]), r"led\[0\].position_mm: \[1.0, 0.0, 0.0\]; the first LED is the origin"),
        (layout([*LEDS, LEDS[4]]), "'m4' and 'm5' are 0.000 mm apart"),
        (layout(LEDS).replace('"m1"', '"m0"'), "the name 'm0' stands twice"),
        (layout(LEDS, axis="[0.0, 0.0, -2.0]"), r"led\[0\].axis: length 2.0000; expected a unit vector"),
        (layout(LEDS, "[imu]\nlever = [1.0, 2.0, 3.0]"), "imu: (required|unknown) field"),
        (layout(LEDS, "colour = 1"), r"led\[4\]: unknown field 'colour'; is it misspelt"),
        (layout(LEDS).replace("radius_mm = 3.0", "radius_mm = -3.0", 1), r"led\[0\].radius_mm: Expected `float` > 0"),
        (layout(LEDS, "[imu]\nlever_arm_mm=[0.0,0.0,0.0]\nrotation=[[2.0,0.0,0.0],[0.0,1.0,0.0],[0.0,0.0,1.0]]"),
         "imu.rotation: not a rotation matrix"),
        ("led = 5", "led: Expected `array`, got `int`"),
        ("[[led", "not valid TOML"),
    ],
)  # fmt: skip
def test_a_wrong_layout_is_refused_with_file_and_key(write, text, words):
    path = write(text)
    with pytest.raises(ConfigError, match=words) as caught:
        load_brick_model(path)
    assert str(caught.value).startswith(str(path))


def test_a_layout_may_begin_with_the_mark_of_windows_editors(tmp_path):
    path = tmp_path / "layout.toml"
    path.write_bytes(b"\xef\xbb\xbf" + layout(LEDS).replace("\n", "\r\n").encode())
    assert len(load_brick_model(path).led_names) == len(LEDS)


def test_a_missing_layout_names_the_file(tmp_path):
    with pytest.raises(ConfigError, match="nowhere.toml: No such file"):
        load_brick_model(tmp_path / "nowhere.toml")
