from typing import get_args

import pytest

from bricktrack_common.errors import DeviceError
from bricktrack_common.wire_messages import DaemonState
from bricktrack_device.capture.state_table import TRANSITIONS, Cause, StateMachine

STATES = get_args(DaemonState)
CAUSES = get_args(Cause)


def test_the_way_of_a_run_is_idle_armed_recording_saving_idle() -> None:
    machine = StateMachine()
    states = [machine.state]
    for cause in ("arm", "first-edge", "window-over", "saved"):
        machine.change(cause)
        states.append(machine.state)
    assert states == ["idle", "armed", "recording", "saving", "idle"]


@pytest.mark.parametrize("state", STATES)
def test_every_state_can_be_left_and_reached(state: DaemonState) -> None:
    assert any(before == state for before, _ in TRANSITIONS)
    assert state in TRANSITIONS.values()


def test_a_recording_is_never_left_without_being_saved_but_by_a_failure() -> None:
    ways = {cause: after for (before, cause), after in TRANSITIONS.items() if before == "recording"}
    assert {after for cause, after in ways.items() if cause != "failure"} == {"saving"}


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("cause", CAUSES)
def test_what_the_table_does_not_hold_is_refused_and_changes_nothing(
    state: DaemonState, cause: Cause
) -> None:
    machine = StateMachine()
    machine._state = state
    if (state, cause) in TRANSITIONS:
        change = machine.change(cause, reason="because")
        assert (change.before, change.after) == (
            state,
            TRANSITIONS[state, cause],
        ) and machine.state == change.after
        return
    assert not machine.allows(cause)
    with pytest.raises(DeviceError, match=state):
        machine.change(cause, reason="because")
    assert machine.state == state


def test_a_fault_needs_a_reason_and_forgets_it_when_left() -> None:
    machine = StateMachine()
    with pytest.raises(DeviceError, match="reason"):
        machine.change("failure")
    machine.change("failure", reason="the card is full")
    assert (machine.state, machine.reason) == ("fault", "the card is full")
    machine.change("disarm")
    assert machine.reason == ""
