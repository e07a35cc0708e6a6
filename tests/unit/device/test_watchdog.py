"""The watchdog is fed while work goes on, and not when only a new start helps."""

import logging
from dataclasses import dataclass

import pytest

from bricktrack_common.wire_messages import DaemonState
from bricktrack_device import watchdog as watchdog_module
from bricktrack_device.watchdog import Watchdog


@dataclass
class Recorder:
    state: DaemonState = "idle"
    beat_age_s: float = 0.1
    restart_reason: str = ""


@dataclass
class Server:
    beat_age_s: float = 0.1


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    messages: list[str] = []
    monkeypatch.setattr(watchdog_module, "notify", messages.append)
    return messages


@pytest.mark.parametrize("state", ["idle", "armed", "recording", "saving", "fault"])
def test_a_unit_at_work_feeds_it_in_every_state(told: list[str], state: DaemonState) -> None:
    assert Watchdog(Recorder(state=state), Server()).feed()
    assert told == [f"WATCHDOG=1\nSTATUS={state}"]


@pytest.mark.parametrize(
    ("recorder", "server", "words"),
    [
        (Recorder(beat_age_s=9), Server(), "recorder's thread"),
        (Recorder(beat_age_s=float("inf")), Server(), "recorder's thread"),
        (Recorder(state="saving", beat_age_s=61), Server(), "recorder's thread"),
        (Recorder(), Server(beat_age_s=9), "server's thread"),
        (Recorder(restart_reason="camera: it did not stop"), Server(), "camera: it did not stop"),
    ],
)
def test_a_hanging_thread_or_a_lost_camera_starves_it_and_is_told_once(
    told: list[str], caplog: pytest.LogCaptureFixture, recorder: Recorder, server: Server, words: str
) -> None:
    watchdog = Watchdog(recorder, server)
    with caplog.at_level(logging.ERROR):
        assert not watchdog.feed() and not watchdog.feed()
    assert len(told) == 1 and told[0].startswith("STATUS=") and words in told[0]
    assert [words in r.message for r in caplog.records] == [True]


@pytest.mark.parametrize("state", ["recording", "saving"])
def test_a_run_is_not_given_up_for_a_server_that_hangs(told: list[str], state: DaemonState) -> None:
    assert Watchdog(Recorder(state=state), Server(beat_age_s=1000)).feed()


def test_a_slow_card_is_waited_for_and_work_that_goes_on_again_feeds_again(told: list[str]) -> None:
    recorder = Recorder(state="saving", beat_age_s=30)
    watchdog = Watchdog(recorder, Server())
    assert watchdog.feed()
    recorder.state = "idle"
    assert not watchdog.feed()
    recorder.beat_age_s = 0.1
    assert watchdog.feed()
    assert told[-1] == "WATCHDOG=1\nSTATUS=idle"
