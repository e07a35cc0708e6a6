"""``bricktrack status``: how every unit is, once or kept up to date."""

import time
from collections import Counter
from dataclasses import dataclass
from typing import Annotated

import msgspec
import typer
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from bricktrack_common.errors import BricktrackError
from bricktrack_common.wire_messages import HelloReply, ImuStatus, StatusReply
from bricktrack_host.cli._acknowledged import error_details
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
from bricktrack_host.transfer.contact import Contact, ask_units
from bricktrack_host.transfer.fleet_config import UnitConfig
from bricktrack_host.transfer.software import own_software

_STATE_STYLES = {
    "idle": "green",
    "armed": "yellow",
    "recording": "bold red",
    "saving": "cyan",
    "fault": "red",
}
_HEALTH_STYLES = {"warn": "yellow", "fail": "red"}
_COLUMNS = ("unit", "state", "runs", "free", "temp", "imus", "camera", "trigger", "clock", "health", "note")
_RIGHT = ("runs", "free", "temp", "clock")
_DAY_S = 86_400.0
_CLOCK_OFF_S = 2.0
_LINES_AROUND = 4  # the table's head, the sum above it, the line below and the cursor


@dataclass(frozen=True, slots=True)
class UnitAnswer:
    """What a unit said of itself.

    Attributes
    ----------
    clock_ahead_s : float, s
        Its real-time clock less this host's, to half of the time that asking took.
    """

    hello: HelloReply
    status: StatusReply
    clock_ahead_s: float


Answer = UnitAnswer | BricktrackError


def status(
    fleet: FleetOption = None,
    unit: UnitOption = None,
    address: AddressOption = None,
    timeout: TimeoutOption = 3.0,
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Keep the table up to date.")] = False,
    every: Annotated[float, typer.Option("--every", min=0.2, max=3600, help="Seconds between looks.")] = 2.0,
    as_json: JsonOption = False,
) -> None:
    """Show how the units are.

    Exits with 1 if a unit does not answer or is in fault.

    For example:

        bricktrack status

        bricktrack status --watch --unit 'c-*'

        bricktrack status --address tcp://10.0.0.21:41733 --json
    """
    chosen = choose_units(fleet, unit, address, timeout_s=timeout)
    if watch:
        _watch(chosen, every, as_json=as_json)
        return
    answers = _ask(chosen)
    if as_json:
        print_json({"units": _rows_for_scripts(chosen.units, answers)})
    else:
        out.print(_table(chosen.units, answers))
        if len(chosen.units) > 1:
            out.print(_sum(answers))
    for one, answer in zip(chosen.units, answers, strict=True):
        if isinstance(answer, BricktrackError):
            say_error(f"{one.name}: {answer}")
        elif not as_json:
            _say_health(answer.status)
    if any(isinstance(a, BricktrackError) or a.status.state == "fault" for a in answers):
        raise typer.Exit(EXIT_ERROR)


def _ask(chosen: ChosenUnits) -> list[Answer]:
    def look(contact: Contact) -> UnitAnswer:
        before_s = time.time()
        answer = contact.client.status()
        middle_s = (before_s + time.time()) / 2
        return UnitAnswer(contact.hello, answer, answer.clocks.realtime_ns / 1e9 - middle_s)

    return ask_units(chosen.units, look, dialer=chosen.dialer)


def _watch(chosen: ChosenUnits, every_s: float, *, as_json: bool) -> None:
    """Ask again and again until Ctrl-C, which is how it is meant to end."""
    try:
        if as_json:
            while True:
                print_json({"units": _rows_for_scripts(chosen.units, _ask(chosen))}, indent=False)
                time.sleep(every_s)
        with Live(console=out, auto_refresh=False, screen=out.is_terminal) as live:
            while True:
                answers = _ask(chosen)
                live.update(_screen(chosen.units, answers), refresh=True)
                time.sleep(every_s)
    except KeyboardInterrupt:
        raise typer.Exit from None


def _screen(units: list[UnitConfig], answers: list[Answer]) -> Group:
    """Return what fits on the terminal: where not all does, the units that want attention come first."""
    n_rows = max(out.size.height - _LINES_AROUND, 1)
    order = list(range(len(units)))
    below = Text(f"{time.strftime('%H:%M:%S')}   Ctrl-C ends", style="dim")
    if len(units) > n_rows:
        order = sorted(order, key=lambda i: _urgency(answers[i]))[:n_rows]
        below = Text(f"and {len(units) - n_rows} more   ", style="dim") + below
    return Group(_sum(answers), _table([units[i] for i in order], [answers[i] for i in order]), below)


def _urgency(answer: Answer) -> int:
    """Return 0 for what needs a hand most."""
    if isinstance(answer, BricktrackError) or answer.status.state == "fault":
        return 0
    levels = {item.level for item in answer.status.health}
    if "fail" in levels or answer.status.disk_free_bytes < answer.status.disk_needed_bytes:
        return 1
    return 2 if "warn" in levels or answer.status.last_error else 3


def _sum(answers: list[Answer]) -> Text:
    """Return one line: how many units are in which state."""
    states = Counter(_state(a) for a in answers)
    line = Text(f"{len(answers)} unit{'' if len(answers) == 1 else 's'}: ")
    parts = [Text(f"{n} {state}", style=_STATE_STYLES.get(state, "red")) for state, n in states.most_common()]
    return line + Text(", ").join(parts)


def _state(answer: Answer) -> str:
    return "no answer" if isinstance(answer, BricktrackError) else answer.status.state


def _rows_for_scripts(units: list[UnitConfig], answers: list[Answer]) -> list[dict[str, object]]:
    return [
        {"name": unit.name, "address": unit.address, "answers": False, **error_details(answer)}
        if isinstance(answer, BricktrackError)
        else {
            "name": unit.name,
            "address": unit.address,
            "answers": True,
            "software": answer.hello.software,
            "simulated": answer.hello.simulated,
            "clock_ahead_s": round(answer.clock_ahead_s, 3),
            "status": msgspec.to_builtins(answer.status),
        }
        for unit, answer in zip(units, answers, strict=True)
    ]


def _table(units: list[UnitConfig], answers: list[Answer]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    rows = [_cells(unit.name, answer) for unit, answer in zip(units, answers, strict=True)]
    used = [c for c in _COLUMNS if any(cells[c] for cells in rows)]
    for name in used:
        table.add_column(
            name, justify="right" if name in _RIGHT else "left", no_wrap=name in ("unit", "state")
        )
    for cells in rows:
        table.add_row(*(cells[c] for c in used))
    return table


def _cells(name: str, answer: Answer) -> dict[str, str]:
    """Return a unit's cells by column, as markup; empty where there is nothing to say."""
    if isinstance(answer, BricktrackError):
        return dict.fromkeys(_COLUMNS, "") | {"unit": plain(name), "state": "[red]no answer[/]"}
    now = answer.status
    return {
        "unit": plain(now.unit),
        "state": f"[{_STATE_STYLES[now.state]}]{now.state}[/]",
        "runs": f"{now.runs}" + (f" ({now.runs_unconfirmed} to pull)" if now.runs_unconfirmed else ""),
        "free": _free(now),
        "temp": "" if now.temperature_degc is None else f"{now.temperature_degc:.0f} °C",
        "imus": " ".join(_imu(i) for i in now.imus),
        "camera": _camera(now),
        "trigger": _trigger(now),
        "clock": _clock(answer.clock_ahead_s),
        "health": _health(now),
        "note": plain("; ".join(t for t in _notes(answer) if t)),
    }


def _notes(answer: UnitAnswer) -> tuple[str, ...]:
    now = answer.status
    return (
        now.run_id,
        now.reason,
        now.last_error,
        "arms itself" if now.auto_arm else "",
        f"has {answer.hello.software}" if answer.hello.software != own_software() else "",
    )


def _imu(imu: ImuStatus) -> str:
    """Return a sensor's calibration, 0 to 3 for system, gyroscope, accelerometer and magnetometer."""
    if imu.problem:
        return f"[red]{plain(imu.name)}: {plain(imu.problem)}[/]"
    bits = imu.calibration
    levels = "" if bits is None else " " + "/".join(str(bits >> shift & 3) for shift in (6, 4, 2, 0))
    return plain(imu.name) + levels + (f" [yellow]{imu.gaps} gaps[/]" if imu.gaps else "")


def _camera(now: StatusReply) -> str:
    words = [] if now.camera is None else [f"{plain(now.camera.mode)} {now.camera.exposure_us / 1000:g} ms"]
    if now.frame_age_ms is not None:
        words.append(f"{now.frames} frames, {now.frame_age_ms:.0f} ms ago")
    return ", ".join(words)


def _trigger(now: StatusReply) -> str:
    if now.edges:
        return f"{now.edges} edges"
    return {None: "", True: "[yellow]high[/]", False: "low"}[now.line_is_high]


def _clock(ahead_s: float) -> str:
    """Return how far a unit's calendar clock is off; runs do not depend on it, log lines do."""
    if abs(ahead_s) < _CLOCK_OFF_S:
        return "ok"
    return "[yellow]no date[/]" if abs(ahead_s) > _DAY_S else f"[yellow]{ahead_s:+.0f} s[/]"


def _health(now: StatusReply) -> str:
    """Return the worst level of a unit's health, and of what; empty for a unit that tells none."""
    if not now.health:
        return ""
    bad = [item for item in now.health if item.level != "ok"]
    if not bad:
        return "[green]ok[/]"
    level = "fail" if any(item.level == "fail" for item in bad) else "warn"
    names = ", ".join(item.name for item in bad if item.level == level)
    return f"[{_HEALTH_STYLES[level]}]{level}[/]: {plain(names)}"


def _say_health(now: StatusReply) -> None:
    for item in now.health:
        if item.level != "ok":
            words = f"{now.unit}: {item.level}: {item.name}: {item.words}. {item.remedy}"
            err.print(words, style=_HEALTH_STYLES[item.level], markup=False)


def _free(now: StatusReply) -> str:
    text = f"{now.disk_free_bytes / 1e9:.1f} GB"
    return f"[red]{text}[/]" if now.disk_free_bytes < now.disk_needed_bytes else text
