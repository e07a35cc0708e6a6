"""``bricktrack delete``: runs removed from the units' cards, after a question."""

import sys
import time
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Annotated

import typer

from bricktrack_common.errors import BricktrackError, ConfigError, UnitError
from bricktrack_common.wire_messages import RunSummary
from bricktrack_host.cli._acknowledged import ask_for, error_details, some_names
from bricktrack_host.cli._console import err, out, print_json, say_error
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

_TOO_MANY_WAIT_S = 1.0


@dataclass(frozen=True, slots=True)
class _Doomed:
    """The runs that shall go from one unit, or why it could not be asked."""

    unit: UnitConfig
    runs: list[RunSummary]
    error: BricktrackError | None = None


def delete(
    runs: Annotated[
        list[str] | None,
        typer.Argument(metavar="RUN", help="Ids or patterns as '*_shake-07'.", show_default=False),
    ] = None,
    confirmed: Annotated[
        bool, typer.Option("--confirmed", help="All runs that a host has confirmed.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Also runs that no host has confirmed: they are lost for good.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    fleet: FleetOption = None,
    unit: UnitOption = None,
    address: AddressOption = None,
    timeout: TimeoutOption = 5.0,
    as_json: JsonOption = False,
) -> None:
    """Delete runs from the units' cards.

    A run goes only once a host holds it, verified, unless --force says otherwise.

    Says what would go and asks before it does anything. Exits with 1 if a run was not deleted.

    For example:

        bricktrack delete --confirmed

        bricktrack delete '*_shake-07' --unit 'c-*' --yes

        bricktrack delete b2_9f31c2_0007_test --force
    """
    if bool(runs) == confirmed:
        raise ConfigError("say which runs: their ids or patterns, or --confirmed for all that a host has")
    chosen = choose_units(fleet, unit, address, timeout_s=timeout)
    doomed = _select(chosen, runs or ["*"], only_confirmed=confirmed)
    errors: list[tuple[str, BricktrackError]] = [(d.unit.name, d.error) for d in doomed if d.error]
    n_runs = sum(len(d.runs) for d in doomed)
    if n_runs and not (yes or _is_agreed(doomed, force=force)):
        err.print("Nothing was deleted.")
        raise typer.Exit(EXIT_ERROR)
    gone, problems = _delete(chosen, doomed, force=force)
    errors += problems
    missing = [r for r in runs or [] if not any(fnmatchcase(s.run_id, r) for d in doomed for s in d.runs)]
    if missing and not errors:
        errors.append(
            ("", ConfigError(f"no unit has a run {some_names(missing)}; 'bricktrack status' counts them"))
        )
    if as_json:
        print_json(
            {
                "ok": not errors,
                "deleted": [{"unit": u, "run_id": r.run_id, "n_bytes": r.n_bytes} for u, r in gone],
                "errors": [{"of": name, **error_details(e)} for name, e in errors],
            }
        )
    elif n_runs or not errors:
        out.print(f"{len(gone)} of {n_runs} runs deleted, {sum(r.n_bytes for _, r in gone) / 1e6:.1f} MB")
    for name, error in errors:
        say_error(f"{name}: {error}" if name else str(error))
    if errors:
        raise typer.Exit(EXIT_ERROR)


def _select(chosen: ChosenUnits, patterns: list[str], *, only_confirmed: bool) -> list[_Doomed]:
    answers = ask_for(chosen, lambda c: c.client.list_runs(), doing="listing")
    return [
        _Doomed(one, [], answer)
        if isinstance(answer, BricktrackError)
        else _Doomed(
            one,
            [
                r
                for r in answer.runs
                if (r.confirmed or not only_confirmed) and any(fnmatchcase(r.run_id, p) for p in patterns)
            ],
        )
        for one, answer in zip(chosen.units, answers, strict=True)
    ]


def _is_agreed(doomed: list[_Doomed], *, force: bool) -> bool:
    """Say what would go, and ask."""
    runs = [r for d in doomed for r in d.runs]
    n_units = sum(1 for d in doomed if d.runs)
    unheld = [r.run_id for r in runs if not r.confirmed]
    err.print(
        f"{len(runs)} runs of {n_units} units, {sum(r.n_bytes for r in runs) / 1e6:.1f} MB: "
        f"{some_names([r.run_id for r in runs])}",
        markup=False,
        soft_wrap=True,
    )
    if unheld and force:
        err.print(
            f"{len(unheld)} of them no host has: {some_names(unheld)}",
            style="bold red",
            markup=False,
            soft_wrap=True,
        )
    elif unheld:
        err.print(f"{len(unheld)} of them no host has; they stay", style="yellow", markup=False)
    if not sys.stdin.isatty():
        raise ConfigError("nobody is here to be asked whether to delete; give --yes")
    return typer.confirm("Delete them for good?", err=True)


def _delete(
    chosen: ChosenUnits, doomed: list[_Doomed], *, force: bool
) -> tuple[list[tuple[str, RunSummary]], list[tuple[str, BricktrackError]]]:
    """Delete run by run; return what went, and what did not and why."""
    of_unit = {d.unit.name: d.runs for d in doomed if d.runs}
    gone: list[tuple[str, RunSummary]] = []
    problems: list[tuple[str, BricktrackError]] = []

    def delete_all(contact: Contact) -> None:
        name = contact.unit.name
        for run in of_unit[name]:
            try:
                _delete_one(contact, run, force=force)
            except BricktrackError as e:
                problems.append((name, e))
            else:
                gone.append((name, run))

    units = [u for u in chosen.units if u.name in of_unit]
    answers = ask_units(units, delete_all, dialer=chosen.dialer)
    problems += [(u.name, a) for u, a in zip(units, answers, strict=True) if isinstance(a, BricktrackError)]
    return gone, problems


def _delete_one(contact: Contact, run: RunSummary, *, force: bool) -> None:
    """Delete a run; a unit that is asked too often is given time."""
    try:
        contact.client.delete_run(run.run_id, force=force)
    except UnitError as e:
        if e.code != "too-many":
            raise
        time.sleep(_TOO_MANY_WAIT_S)
        contact.client.delete_run(run.run_id, force=force)
