"""``bricktrack test``: a shake from the look before it to the report after it, a step at a time."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from bricktrack_common.errors import BricktrackError, ConfigError
from bricktrack_common.wire_messages import Armed, StatusReply
from bricktrack_host.campaign.arming_round import (
    ArmingRound,
    Standing,
    close_round,
    load_round,
    run_ids_here,
    runs_here,
    save_round,
)
from bricktrack_host.campaign.readiness import obstacles
from bricktrack_host.campaign.test_plan import (
    COMBINED_FOLDER,
    PlannedTest,
    folder_of_test,
    is_of_test,
    load_plan,
    save_plan,
    unit_of,
)
from bricktrack_host.cli._acknowledged import ask_for, report_answers, some_names
from bricktrack_host.cli._console import err, out, say_error
from bricktrack_host.cli._errors import EXIT_ERROR
from bricktrack_host.cli._processing import (
    JobsOption,
    SchedulerOption,
    SendOption,
    TlsAuthorityOption,
    TlsCertificateOption,
    TlsKeyOption,
    Where,
    process_folders,
)
from bricktrack_host.cli._units import (
    ChosenUnits,
    FleetOption,
    TimeoutOption,
    UnitOption,
    choose_units,
    fleet_path,
)
from bricktrack_host.cli.combine import combine
from bricktrack_host.cli.fleet import wait_until_saved
from bricktrack_host.cli.pull import pull_with_bars
from bricktrack_host.transfer.contact import Contact
from bricktrack_host.transfer.fleet_config import UnitConfig
from bricktrack_host.transfer.pull import PullSettings

app = typer.Typer(
    no_args_is_help=True,
    help="Take a shake from the look before it to the report after it. Each step may be given again: it goes "
    "on where it was cut short.",
)

NameArgument = Annotated[str, typer.Argument(metavar="NAME", help="Of the test, as shake-12.")]


@app.command()
def new(
    name: NameArgument,
    unit: UnitOption = None,
    duration: Annotated[
        float | None,
        typer.Option("--duration", min=0.1, max=600, help="Seconds to record instead of the unit's own."),
    ] = None,
    fleet: FleetOption = None,
    timeout: TimeoutOption = 5.0,
) -> None:
    """Begin a test: note its units, and look whether each is ready.

    Exits with 1 if one is not, and says what to do. Look again with 'bricktrack test check'.

    For example:

        bricktrack test new shake-12

        bricktrack test new shake-12 --unit 'b7-*' --duration 20
    """
    chosen = choose_units(fleet, unit, None, timeout_s=timeout)
    folder = folder_of_test(fleet_path(fleet), name)
    plan = PlannedTest(name=name, units=[u.name for u in chosen.units], duration_s=duration)
    here = runs_here(_runs_folder(chosen), plan, load_round(folder))
    if here:
        raise ConfigError(
            f"the test {name} is recorded already: {len(here)} of its runs are here. Choose another name "
            f"for a new one; 'bricktrack test arm {name} --again' records this one once more"
        )
    save_plan(folder, plan)
    _look(chosen, name)


@app.command()
def check(name: NameArgument, fleet: FleetOption = None, timeout: TimeoutOption = 5.0) -> None:
    """Look again whether each unit is ready.

    For example:

        bricktrack test check shake-12
    """
    _, chosen = _planned(name, fleet, timeout)
    _look(chosen, name)


@app.command()
def arm(
    name: NameArgument,
    wait: Annotated[bool, typer.Option(help="Wait until the runs are recorded and saved.")] = True,
    again: Annotated[
        bool, typer.Option("--again", help="Record once more, also with units that have a run of this test.")
    ] = False,
    fleet: FleetOption = None,
    timeout: TimeoutOption = 5.0,
) -> None:
    """Make all units of a test ready for the first edge, and wait for their runs.

    Units that are armed for this test, or have a run of it, are left as they are. Exits with 1 if one is not
    armed, or its run does not come. Ctrl-C ends the waiting; the units record all the same.

    For example:

        bricktrack test arm shake-12

        bricktrack test arm shake-12 --again
    """
    plan, chosen = _planned(name, fleet, timeout)
    folder = folder_of_test(fleet_path(fleet), name)
    looks = _look_at(chosen)
    going = _round_to_go(folder, plan, chosen, looks, again=again)
    standings = [
        look if isinstance(look, BricktrackError) else going.standing_of(u.name, *look, name)
        for u, look in zip(chosen.units, looks, strict=True)
    ]
    _refuse_another_shake(name, chosen, standings)
    arming = dict(zip((u.name for u in chosen.units), standings, strict=True))

    def make_ready(contact: Contact) -> Armed:
        standing = arming[contact.unit.name]
        if isinstance(standing, BricktrackError):
            raise standing
        if standing.kind != "idle":
            return Armed(run_id=standing.run_id, missing=[])
        return contact.client.arm(name, duration_s=plan.duration_s)

    answers = ask_for(chosen, make_ready, doing="arming")
    has_run = {u for u, s in arming.items() if isinstance(s, Standing) and s.kind == "recorded"}
    all_armed = report_answers(
        chosen.units, answers, done="have their run" if has_run else "armed",
        words=lambda a: f"{'has' if unit_of(a.run_id) in has_run else 'armed,'} run {a.run_id}",
        details=lambda _: {}, as_json=False,
    )  # fmt: skip
    armed = {u.name: a for u, a in zip(chosen.units, answers, strict=True) if isinstance(a, Armed)}
    for unit, answer in armed.items():
        for words in answer.missing:
            err.print(f"{unit}: without {words}", style="yellow", markup=False, soft_wrap=True)
    if has_run:
        words = (
            f"nothing was armed: {name} is recorded. 'bricktrack test arm {name} --again' records once more"
        )
        err.print(words, style="yellow", markup=False, soft_wrap=True)
    if not all_armed:
        if armed and not has_run:
            say_error(
                f"the {len(armed)} that are armed record at the first edge. 'bricktrack test arm {name}' "
                "arms the rest; 'bricktrack disarm' calls it off"
            )
        raise typer.Exit(EXIT_ERROR)
    if not wait:
        close_round(folder, going)
        if not has_run:
            out.print(f"they record at the first edge; then: bricktrack test collect {name}", markup=False)
        return
    try:
        good = wait_until_saved(
            chosen, {unit: answer.run_id for unit, answer in armed.items()}, as_json=False
        )
    except KeyboardInterrupt as e:
        raise KeyboardInterrupt(
            f"Interrupted; the units stay armed. 'bricktrack test arm {name}' waits again."
        ) from e
    close_round(folder, going)
    if not good:
        say_error(
            f"'bricktrack test collect {name}' brings what there is; 'bricktrack test arm {name} --again' "
            "records once more with all"
        )
        raise typer.Exit(EXIT_ERROR)
    out.print(f"all runs are saved; next: bricktrack test collect {name}", markup=False)


@app.command()
def collect(
    name: NameArgument,
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
    send: SendOption = "auto",
    tls_ca: TlsAuthorityOption = None,
    tls_cert: TlsCertificateOption = None,
    tls_key: TlsKeyOption = None,
    fleet: FleetOption = None,
    timeout: TimeoutOption = 5.0,
) -> None:
    """Bring the runs of a test here, verified, and process those that are not yet.

    Exits with 1 if a unit's run is missing or could not be processed; given again it goes on.

    For example:

        bricktrack test collect shake-12
    """
    where = Where(jobs, scheduler, send, (tls_ca, tls_cert, tls_key))
    plan, chosen = _planned(name, fleet, timeout)
    going = load_round(folder_of_test(fleet_path(fleet), name))
    runs_folder = _runs_folder(chosen)
    wanted: list[UnitConfig] = []
    run_ids: list[str] = []
    problems: list[str] = []
    without: dict[str, list[str]] = {}
    had = runs_here(runs_folder, plan, going)
    answers = _look_at(chosen, with_runs_here=False)
    for unit, answer in zip(chosen.units, answers, strict=True):
        if isinstance(answer, BricktrackError):
            if unit.name not in had:
                problems.append(f"{unit.name}: {answer}")
            continue
        standing = going.standing_of(unit.name, *answer, name)
        run_id = going.run_of(unit.name, answer[1], name)
        if run_id is not None:
            wanted.append(unit)
            run_ids.append(run_id)
        if standing.kind == "armed":
            without.setdefault(f"{answer[0].state} for {name}; no run yet", []).append(unit.name)
        elif run_id is None and unit.name not in had:
            has_earlier = any(is_of_test(r, name) for r in answer[1])
            what = f"only an earlier run of {name}" if has_earlier else f"no run of {name}. Was it armed?"
            without.setdefault(what, []).append(unit.name)
    problems += [f"{some_names(units)}: {words}" for words, units in without.items()]
    if wanted:
        pulled = pull_with_bars(replace(chosen, units=wanted), runs_folder, PullSettings(run_ids=run_ids))
        problems += [f"{result.unit}: {e}" for result in pulled for e in result.errors]
    here = runs_here(runs_folder, plan, going)
    todo = [run for run in here.values() if not _is_processed(run)]
    out.print(f"{len(here)} of {len(plan.units)} runs are here, {len(todo)} to process", markup=False)
    failed = process_folders(todo, fleet=fleet_path(fleet), where=where)
    _say_samples(here)
    for problem in problems:
        say_error(problem)
    if problems or failed:
        say_error(f"mend that, then 'bricktrack test collect {name}' goes on; 'report' takes what there is")
        raise typer.Exit(EXIT_ERROR)
    out.print(f"next: bricktrack test report {name}", markup=False)


@app.command()
def report(name: NameArgument, fleet: FleetOption = None) -> None:
    """Compare the units of a test, solve its assemblies, and write its report.

    For example:

        bricktrack test report shake-12
    """
    path = fleet_path(fleet)
    folder = folder_of_test(path, name)
    plan = load_plan(folder)
    chosen = choose_units(fleet, plan.units, None, timeout_s=1.0)
    runs = runs_here(_runs_folder(chosen), plan, load_round(folder))
    usable = [run for run in runs.values() if _is_processed(run)]
    missing = [unit for unit in plan.units if unit not in runs or not _is_processed(runs[unit])]
    if not usable:
        raise ConfigError(f"{name}: no run is processed yet. Give 'bricktrack test collect {name}' first")
    combine(usable, name, fleet, folder / COMBINED_FOLDER)
    if missing:
        say_error(f"without {', '.join(missing)}: not here, or not processed")
        raise typer.Exit(EXIT_ERROR)


def _planned(name: str, fleet: Path | None, timeout_s: float) -> tuple[PlannedTest, ChosenUnits]:
    plan = load_plan(folder_of_test(fleet_path(fleet), name))
    return plan, choose_units(fleet, plan.units, None, timeout_s=timeout_s)


def _runs_folder(chosen: ChosenUnits) -> Path:
    if chosen.fleet is None:
        raise ConfigError("a test needs a fleet file")
    return chosen.fleet.runs_path


Look = tuple[StatusReply, list[str]]
"""What a unit says of itself, and its runs."""


def _look_at(chosen: ChosenUnits, *, with_runs_here: bool = True) -> list[Look | BricktrackError]:
    """Ask all units how they are and which runs they have; those that are here may be deleted there."""
    runs_folder = _runs_folder(chosen)

    def look(contact: Contact) -> Look:
        now = (
            contact.client.status()
        )  # first: a run that is saved in between is seen then, and not armed again
        run_ids = [run.run_id for run in contact.client.list_runs().runs]
        here = run_ids_here(runs_folder, contact.unit.name) if with_runs_here else []
        return now, [*run_ids, *here]

    return ask_for(chosen, look, doing="looking at")


def _round_to_go(
    folder: Path,
    plan: PlannedTest,
    chosen: ChosenUnits,
    looks: list[Look | BricktrackError],
    *,
    again: bool,
) -> ArmingRound:
    """Return the round that units are armed for; a new one is noted down before any of them is."""
    going = load_round(folder)
    before = dict(going.before)
    for unit, look in zip(chosen.units, looks, strict=True):
        is_new = again and not going.is_open
        if isinstance(look, BricktrackError):
            if is_new:
                before[unit.name] = None
        elif is_new or before.get(unit.name, []) is None:
            before[unit.name] = [run_id for run_id in look[1] if is_of_test(run_id, plan.name)]
    now = ArmingRound(before=before, is_open=again or going.is_open)
    if now != going:
        save_round(folder, now)
    return now


def _refuse_another_shake(
    name: str, chosen: ChosenUnits, standings: list[Standing | BricktrackError]
) -> None:
    """Refuse to arm some units for a shake that others have recorded already."""
    kinds = {u.name: s.kind for u, s in zip(chosen.units, standings, strict=True) if isinstance(s, Standing)}
    idle = [unit for unit, kind in kinds.items() if kind == "idle"]
    recorded = [unit for unit, kind in kinds.items() if kind == "recorded"]
    if idle and recorded:
        raise ConfigError(
            f"{some_names(recorded)} recorded {name} already, and {some_names(idle)} did not: armed now, "
            f"they would record another shake. 'bricktrack test collect {name}' takes what there is; "
            f"'bricktrack test arm {name} --again' records once more with all"
        )


def _is_processed(run: Path) -> bool:
    return (run / "results" / "summary.json").is_file()


def _say_samples(runs: dict[str, Path]) -> None:
    """Say whether all units number the laboratory's samples alike; 'report' puts right what can be."""
    from bricktrack_host.results.edge_comparison import compare_runs
    from bricktrack_host.results.result_store import results_of

    processed = {unit: results_of(run) for unit, run in runs.items() if _is_processed(run)}
    compared = compare_runs(processed)
    if compared is None:
        return
    for words in compared.problems():
        err.print(words, style="yellow", markup=False, soft_wrap=True)
    if not compared.problems():
        out.print(f"{len(compared.units)} units number the square wave's samples alike", markup=False)


def _look(chosen: ChosenUnits, name: str) -> None:
    """Say of each unit whether it can record this test, and the remedy where it cannot."""
    answers = ask_for(chosen, lambda c: c.client.status(), doing="looking at")
    table = Table(title=f"{name}: before the shake")
    for header in ("unit", "ready", "because", "remedy"):
        table.add_column(header)
    n_ready = 0
    for unit, answer in zip(chosen.units, answers, strict=True):
        if isinstance(answer, BricktrackError):
            words, _, remedy = str(answer).partition(". ")
            reasons = [(words, remedy)]
        else:
            reasons = obstacles(answer, name)
        n_ready += not reasons
        for words, remedy in reasons:
            table.add_row(unit.name, "[red]no[/]", words.replace("[", r"\["), remedy.replace("[", r"\["))
    if table.row_count:
        out.print(table)
    out.print(f"{n_ready} of {len(chosen.units)} units are ready", markup=False)
    if n_ready < len(chosen.units):
        err.print(f"mend that, then look again: bricktrack test check {name}", markup=False)
        raise typer.Exit(EXIT_ERROR)
    out.print(f"next: bricktrack test arm {name}", markup=False)
