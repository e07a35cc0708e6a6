from types import SimpleNamespace
from typing import Any

from bricktrack_device.capture.lost_sensors import PATIENCE_S, LostSensors


def session(*, has_sensors: bool = True, lost_required: str = "") -> Any:
    return SimpleNamespace(has_sensors=has_sensors, lost_required=lost_required, missing=["camera: gone"])


def test_an_armed_unit_waits_for_a_sensor_that_is_silent_for_a_moment() -> None:
    now = [100.0]
    lost = LostSensors(clock=lambda: now[0])
    for _ in range(3):
        assert lost.words(session(has_sensors=False), auto_arm=False) == ""
        now[0] += 0.9 * PATIENCE_S
        assert lost.words(session(has_sensors=False), auto_arm=False) == ""
        assert lost.words(session(), auto_arm=False) == ""  # it came again: the count begins anew
    assert lost.words(session(has_sensors=False), auto_arm=False) == ""
    now[0] += PATIENCE_S
    assert "no sensor is left: camera: gone" in lost.words(session(has_sensors=False), auto_arm=False)


def test_only_a_unit_that_arms_itself_again_is_disarmed_for_one_required_sensor() -> None:
    now = [0.0]
    for auto_arm, words in ((True, "lost while armed: camera"), (False, "")):
        lost = LostSensors(clock=lambda: now[0])
        assert lost.words(session(lost_required="camera"), auto_arm=auto_arm) == ""
        now[0] += PATIENCE_S
        assert lost.words(session(lost_required="camera"), auto_arm=auto_arm) == words
