"""``bricktrack status``, ``arm`` and ``disarm``."""

import sys
import time
from typing import Annotated

import msgspec
import typer
from rich.table import Table

from bricktrack_common.errors import BricktrackError
from bricktrack_common.wire_messages import StatusReply
from bricktrack_host.cli._console import err, out, say_error
from bricktrack_host.cli._errors import EXIT_ERROR
from bricktrack_host.cli._units import (
    AddressOption,
    FleetOption,
    TimeoutOption,
    UnitOption,
    ask_units,
    choose_units,
)
from bricktrack_host.transfer.fleet_config import UnitConfig

_STATE_STYLES = {
    "idle": "green",
    "armed": "yellow",
    "recording": "bold red",
    "saving": "cyan",
    "fault": "red",
}
_HEALTH_STYLES = {"warn": "yellow", "fail": "red"}


def status(
    fleet: FleetOption = None,
    unit: UnitOption = None,
    address: AddressOption = None,
    timeout: TimeoutOption = 3.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object for scripts.")] = False,
) -> None:
    """Show how the units are.

    Exits with 1 if a unit does not answer or is in fault.

    For example:

        bricktrack status

        bricktrack status --address tcp://10.0.0.21:41733 --json
    """
    units, _ = choose_units(fleet, unit, address)
    answers = ask_units(units, lambda client: client.status(), timeout_s=timeout)
    if as_json:
        _print_json(units, answers)
    else:
        _print_table(units, answers)
    if any(isinstance(a, BricktrackError) or a.state == "fault" for a in answers):
        raise typer.Exit(EXIT_ERROR)


def _print_json(units: list[UnitConfig], answers: list[StatusReply | BricktrackError]) -> None:
    rows = [
        {"name": unit.name, "address": unit.address, "answers": False, "error": str(answer)}
        if isinstance(answer, BricktrackError)
        else {
            "name": unit.name,
            "address": unit.address,
            "answers": True,
            "status": msgspec.to_builtins(answer),
        }
        for unit, answer in zip(units, answers, strict=True)
    ]
    sys.stdout.write(msgspec.json.format(msgspec.json.encode({"units": rows}), indent=2).decode() + "\n")


def _print_table(units: list[UnitConfig], answers: list[StatusReply | BricktrackError]) -> None:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name, justify in (
        ("unit", "left"), ("state", "left"), ("runs", "right"), ("free", "right"), ("frames", "right"),
        ("edges", "right"), ("line", "left"), ("imus", "left"), ("temp", "right"), ("health", "left"),
        ("note", "left"),
    ):  # fmt: skip
        right = justify == "right"
        table.add_column(name, justify="right" if right else "left", no_wrap=name == "state")
    for unit, answer in zip(units, answers, strict=True):
        if isinstance(answer, BricktrackError):
            table.add_row(unit.name, "[red]no answer[/]", *[""] * 9)
            continue
        style = _STATE_STYLES[answer.state]
        table.add_row(
            _plain(answer.unit),
            f"[{style}]{answer.state}[/]",
            str(answer.runs),
            _free(answer),
            str(answer.frames)
            + ("" if answer.frame_age_ms is None else f" ({answer.frame_age_ms:.0f} ms ago)"),
            str(answer.edges),
            {True: "high", False: "low", None: "?"}[answer.line_is_high],
            " ".join(_plain(f"{i.name} {i.problem or _samples(i.samples, i.gaps)}") for i in answer.imus),
            "" if answer.temperature_degc is None else f"{answer.temperature_degc:.0f} °C",
            _health(answer),
            _plain("; ".join(t for t in (answer.run_id, answer.reason, answer.last_error) if t)),
        )
    out.print(table)
    for answer in answers:
        if isinstance(answer, BricktrackError):
            say_error(str(answer))
            continue
        for item in answer.health:
            if item.level != "ok":
                words = f"{answer.unit}: {item.level}: {item.name}: {item.words}. {item.remedy}"
                err.print(words, style=_HEALTH_STYLES[item.level], markup=False)


def _health(answer: StatusReply) -> str:
    """Return the worst level of a unit's health, and of what; empty for a unit that tells none."""
    if not answer.health:
        return ""
    bad = [item for item in answer.health if item.level != "ok"]
    if not bad:
        return "[green]ok[/]"
    level = "fail" if any(item.level == "fail" for item in bad) else "warn"
    names = ", ".join(item.name for item in bad if item.level == level)
    return f"[{_HEALTH_STYLES[level]}]{level}[/]: {_plain(names)}"


def _samples(samples: int, gaps: int) -> str:
    return f"{samples}" + (f" ({gaps} gaps)" if gaps else "")


def _free(answer: StatusReply) -> str:
    text = f"{answer.disk_free_bytes / 1e9:.1f} GB"
    return f"[red]{text}[/]" if answer.disk_free_bytes < answer.disk_needed_bytes else text


def _plain(text: str) -> str:
    """Return text from a unit so that it cannot be taken for markup."""
    return text.replace("[", r"\[")


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
) -> None:
    """Make units ready to record at the next first edge.

    Returns when all are ready; exits with 1 if one is not, and says which. Those that are ready stay so.

    For example:

        bricktrack arm --label shake-07 --wait

        bricktrack arm --address tcp://10.0.0.21:41733
    """
    units, _ = choose_units(fleet, unit, address)
    answers = ask_units(units, lambda c: c.arm(label, duration_s=duration), timeout_s=timeout)
    runs: dict[str, str] = {}
    for one, answer in zip(units, answers, strict=True):
        if isinstance(answer, BricktrackError):
            say_error(f"{one.name}: {answer}")
            continue
        runs[one.name] = answer.run_id
        out.print(f"{one.name}: armed, run {answer.run_id}", markup=False)
        for words in answer.missing:
            err.print(f"{one.name}: without {words}", style="yellow", markup=False)
    if len(runs) < len(units):
        say_error("not all units are armed; 'bricktrack disarm' brings the others back")
        raise typer.Exit(EXIT_ERROR)
    if wait and not _wait_until_saved(units, runs, timeout):
        raise typer.Exit(EXIT_ERROR)


def _wait_until_saved(units: list[UnitConfig], runs: dict[str, str], timeout_s: float) -> bool:
    """Poll until every unit has its run on the card; tell whether all have."""
    waiting = list(units)
    all_good = True
    with err.status("waiting for the first edge") as shown:
        while waiting:
            answers = ask_units(
                waiting, lambda client: (client.status(), client.list_runs()), timeout_s=timeout_s
            )
            left: list[UnitConfig] = []
            for one, answer in zip(waiting, answers, strict=True):
                if isinstance(answer, BricktrackError):  # it may be busy saving: ask again
                    shown.update(f"{one.name}: {_plain(str(answer))}")
                    left.append(one)
                    continue
                now, listed = answer
                saved = next((r for r in listed.runs if r.run_id == runs[one.name]), None)
                if saved is not None:
                    good = saved.state == "complete"
                    out.print(
                        f"{one.name}: {saved.run_id} {saved.state}, {saved.n_bytes / 1e6:.1f} MB",
                        markup=False,
                    )
                    all_good = all_good and good
                elif now.state in ("idle", "fault") or (now.run_id and now.run_id != runs[one.name]):
                    say_error(
                        f"{one.name}: {runs[one.name]} was not recorded. {now.reason or now.last_error}"
                    )
                    all_good = False
                else:
                    shown.update(", ".join(f"{u.name} {now.state}" for u in [one, *left]))
                    left.append(one)
            waiting = left
            if waiting:
                time.sleep(0.5)
    return all_good


def disarm(
    fleet: FleetOption = None,
    unit: UnitOption = None,
    address: AddressOption = None,
    timeout: TimeoutOption = 5.0,
) -> None:
    """Bring units back to idle without a run; also clears a fault.

    For example:

        bricktrack disarm --unit b2
    """
    units, _ = choose_units(fleet, unit, address)
    failed = False
    for one, answer in zip(units, ask_units(units, lambda c: c.disarm(), timeout_s=timeout), strict=True):
        if isinstance(answer, BricktrackError):
            say_error(f"{one.name}: {answer}")
            failed = True
        else:
            out.print(f"{one.name}: idle", markup=False)
    if failed:
        raise typer.Exit(EXIT_ERROR)
