"""Assemblies in a fleet file: what is refused, and with which words."""

import pytest
from small_lab import FLEET

from bricktrack_common.errors import ConfigError
from bricktrack_host.transfer.fleet_config import load_fleet

# A quarter turn about z takes the layout's x axis to the brick's y axis.
TURNED = FLEET + "rotation_brick_layout = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]\n"


def load(tmp_path, text):
    path = tmp_path / "fleet.toml"
    path.write_text(text)
    return load_fleet(path)


def test_a_triply_cracked_brick_is_read(tmp_path):
    [assembly] = load(tmp_path, TURNED).assembly
    assert [c.name for c in assembly.component] == ["A", "B", "C"]
    assert assembly.view[1].pose_brick_layout.apply([1.0, 0.0, 0.0]).tolist() == [-10.0, 21.0, 30.0]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('kind = "TCB"', 'kind = "DCB"', r"assembly\[0\].component: 3 of them; a DCB is in 2"),
        ('base = "A"', 'base = "X"', "no component 'X'"),
        ('unit = "b7-2"', 'unit = "b9"', "no unit 'b9' in the fleet"),
        ('unit = "b7-2"', 'unit = "b7-1"', "'b7-1' stands twice"),
        ('leds_on = "C"', 'leds_on = "B"', "camera and LEDs are both on 'B'"),
        ('leds_on = "C"', 'leds_on = "A"', "no chain of views leads from the base 'A' to C"),
        ("[0.0, 0.0, 1.0]]", "[0.0, 0.0, 2.0]]", "rotation_brick_layout: not a rotation"),
        ("[0.0, 0.0, 1.0]]", "[0.0, 0.0, -1.0]]", "rotation_brick_layout: not a rotation"),
        ("point_mm", "points_mm", "points_mm"),
    ],
)
def test_what_makes_no_sense_is_refused_by_its_key(tmp_path, old, new, words):
    assert old in TURNED
    with pytest.raises(ConfigError, match=words):
        load(tmp_path, TURNED.replace(old, new, 1))
