"""``bricktrack arm`` and ``disarm``."""

import re
import time
from typing import Annotated

import typer

from bricktrack_common.errors import BricktrackError, ConfigError
from bricktrack_common.wire_messages import LABEL_PATTERN, Armed, RunSummary, StatusReply
from bricktrack_host.cli._acknowledged import ask_for, error_details, report_answers
from bricktrack_host.cli._console import err, out, plain, print_json, say_error
from bricktrack_host.cli._errors import EXIT_ERROR
from bricktrack_host.cli._units import (
    AddressOption,
    ChosenUnits,
    FleetOption,
    JsonOption,
    TimeoutOption,
    UnitOption,
    choose_units,
)
from bricktrack_host.transfer.contact import ask_units
from bricktrack_host.transfer.fleet_config import UnitConfig

_POLL_S = 0.5
_GIVE_UP_S = 60.0
"""A unit that saves may be slow to answer; one that is silent for longer is gone."""


def arm(
    label: Annotated[str, typer.Option("--label", "-l", help="Goes into the run's id.")] = "",
    duration: Annotated[
        float | None,
        typer.Option("--duration", min=0.1, max=600, help="Seconds to record instead of the unit's own."),
    ] = None,
    wait: Annotated[bool, typer.Option("--wait", help="Wait until the runs are recorded and saved.")] = False,
    fleet: FleetOption = None,
    unit: UnitOption = None,
    address: AddressOption = None,
    timeout: TimeoutOption = 5.0,
    as_json: JsonOption = False,
) -> None:
    """Make units ready to record at the next first edge.

    Returns when all are ready; exits with 1 if one is not, and says which. Those that are ready stay so.

    For example:

        bricktrack arm --label shake-07 --wait

        bricktrack arm --unit 'c-*' --duration 20

        bricktrack arm --address tcp://10.0.0.21:41733
    """
    if re.fullmatch(LABEL_PATTERN, label) is None:
        raise ConfigError(
            f"--label {label!r}: expected letters, digits, '-' and '_', 32 at most, as 'shake-07'"
        )
    chosen = choose_units(fleet, unit, address, timeout_s=timeout)
    answers = ask_for(chosen, lambda c: c.client.arm(label, duration_s=duration), doing="arming")
    all_armed = report_answers(
        chosen.units,
        answers,
        done="armed",
        words=lambda armed: f"armed, run {armed.run_id}",
        details=lambda armed: {"run_id": armed.run_id, "missing": armed.missing},
        as_json=as_json and not wait,
    )
    runs: dict[str, str] = {}
    for one, answer in zip(chosen.units, answers, strict=True):
        if isinstance(answer, Armed):
            runs[one.name] = answer.run_id
            for words in answer.missing:
                err.print(f"{one.name}: without {words}", style="yellow", markup=False, soft_wrap=True)
    if not all_armed:
        if runs:
            say_error("those that are armed stay so; 'bricktrack disarm' brings them back")
        raise typer.Exit(EXIT_ERROR)
    if wait and not wait_until_saved(chosen, runs, as_json=as_json):
        raise typer.Exit(EXIT_ERROR)


def wait_until_saved(chosen: ChosenUnits, runs: dict[str, str], *, as_json: bool) -> bool:
    """Poll until every unit has its run on the card, or cannot have it; tell whether all have."""
    waiting = list(chosen.units)
    heard_s = {u.name: time.monotonic() for u in waiting}
    outcomes: dict[str, dict[str, object]] = {}
    with err.status("waiting for the first edge") as shown:
        while waiting:
            left: list[UnitConfig] = []
            states: dict[str, int] = {}
            answers = ask_units(
                waiting, lambda c: (c.client.status(), c.client.list_runs()), dialer=chosen.dialer
            )
            for one, answer in zip(waiting, answers, strict=True):
                run_id, now_s = runs[one.name], time.monotonic()
                if isinstance(answer, BricktrackError):
                    if now_s - heard_s[one.name] < _GIVE_UP_S:
                        left.append(one)
                        states["silent"] = states.get("silent", 0) + 1
                        continue
                    outcomes[one.name] = {"ok": False, **error_details(answer)}
                    say_error(f"{one.name}: {run_id}: silent for {_GIVE_UP_S:g} s. {answer}")
                    continue
                heard_s[one.name] = now_s
                now, listed = answer
                saved = next((r for r in listed.runs if r.run_id == run_id), None)
                if saved is not None:
                    outcomes[one.name] = _saved(one.name, saved, as_json=as_json)
                elif words := _why_it_will_not_come(now, run_id):
                    outcomes[one.name] = {"ok": False, "error": words, "code": "not-recorded"}
                    say_error(f"{one.name}: {run_id} was not recorded: {words}")
                else:
                    left.append(one)
                    states[now.state] = states.get(now.state, 0) + 1
            waiting = left
            if waiting:
                shown.update(plain("waiting for runs: " + ", ".join(f"{n} {s}" for s, n in states.items())))
                time.sleep(_POLL_S)
    good = all(o["ok"] for o in outcomes.values())
    if as_json:
        rows = [
            {"name": u.name, "address": u.address, "run_id": runs[u.name], **outcomes[u.name]}
            for u in chosen.units
        ]
        print_json({"ok": good, "units": rows})
    return good


def _saved(name: str, run: RunSummary, *, as_json: bool) -> dict[str, object]:
    if not as_json:
        out.print(f"{name}: {run.run_id} {run.state}, {run.n_bytes / 1e6:.1f} MB", markup=False)
    return {"ok": run.state == "complete", "state": run.state, "n_bytes": run.n_bytes}


def _why_it_will_not_come(now: StatusReply, run_id: str) -> str:
    """Return in words why a unit does not have this run and will not; ``""`` while it may."""
    if now.run_id == run_id:
        return ""
    if now.run_id:
        # What is wrong with that run, or was since it was armed, says nothing of this one.
        return f"the unit is {now.state} for {now.run_id} now. Look at its log"
    if now.state == "fault":
        return now.reason or now.last_error or "the unit is in fault"
    if now.state == "idle":
        return now.last_error or "the unit is idle: it was disarmed, or restarted"
    return ""


def disarm(
    fleet: FleetOption = None,
    unit: UnitOption = None,
    address: AddressOption = None,
    timeout: TimeoutOption = 5.0,
    as_json: JsonOption = False,
) -> None:
    """Bring units back to idle without a run; also clears a fault, and ends arming by itself.

    For example:

        bricktrack disarm

        bricktrack disarm --unit b2 --json
    """
    chosen = choose_units(fleet, unit, address, timeout_s=timeout)
    answers = ask_for(chosen, lambda c: c.client.disarm(), doing="disarming")
    if not report_answers(
        chosen.units, answers, done="idle", words=lambda _: "idle", details=lambda _: {}, as_json=as_json
    ):
        raise typer.Exit(EXIT_ERROR)
