"""Asks units to do something, and says clearly who did it and who did not."""

from collections.abc import Callable
from typing import TypeVar

from bricktrack_common.errors import BricktrackError, UnitError
from bricktrack_host.cli._console import err, out, print_json, say_error
from bricktrack_host.cli._units import ChosenUnits
from bricktrack_host.transfer.contact import Contact, ask_units
from bricktrack_host.transfer.fleet_config import UnitConfig

T = TypeVar("T")

_MOST_LINES = 24
"""With more units than this, those that did as they were told share one line."""
_MOST_NAMES = 40


def ask_for(
    chosen: ChosenUnits, question: Callable[[Contact], T], *, doing: str
) -> list[T | BricktrackError]:
    """Ask all chosen units at once, with a count of the answers on the terminal meanwhile."""
    n_units = len(chosen.units)
    n_answers = 0
    with err.status(f"{doing} {n_units} unit{'s' if n_units > 1 else ''}") as shown:

        def told(unit: UnitConfig, answer: T | BricktrackError) -> None:
            nonlocal n_answers
            n_answers += 1
            shown.update(f"{doing}: {n_answers} of {n_units} units")

        return ask_units(chosen.units, question, dialer=chosen.dialer, told=told if n_units > 1 else None)


def report_answers(
    units: list[UnitConfig],
    answers: list[T | BricktrackError],
    *,
    done: str,
    words: Callable[[T], str],
    details: Callable[[T], dict[str, object]],
    as_json: bool,
    quiet: bool = False,
) -> bool:
    """Print what each unit answered, the errors last; tell whether all did as they were told.

    Parameters
    ----------
    done : str
        What the units are now, as "armed".
    words : callable
        An answer's line, without the unit's name.
    details : callable
        An answer for scripts.
    quiet : bool
        Print the errors alone.
    """
    failed = [(u, a) for u, a in zip(units, answers, strict=True) if isinstance(a, BricktrackError)]
    good = [(u, a) for u, a in zip(units, answers, strict=True) if not isinstance(a, BricktrackError)]
    if as_json:
        rows = [
            {"name": u.name, "address": u.address, "ok": False, **error_details(a)}
            if isinstance(a, BricktrackError)
            else {"name": u.name, "address": u.address, "ok": True, **details(a)}
            for u, a in zip(units, answers, strict=True)
        ]
        print_json({"ok": not failed, "units": rows})
    elif len(units) <= _MOST_LINES and not quiet:
        for unit, answer in good:
            out.print(f"{unit.name}: {words(answer)}", markup=False, soft_wrap=True)
    if len(units) > 1 and not (as_json or quiet):
        out.print(f"{len(good)} of {len(units)} units {done}", markup=False)
    for unit, problem in failed:
        say_error(f"{unit.name}: {problem}")
    if failed and len(units) > 1:
        say_error(f"not {done}: {some_names([u.name for u, _ in failed])}")
    return not failed


def error_details(error: BricktrackError) -> dict[str, object]:
    """Return an error for scripts; ``code`` is the unit's refusal, or the kind of the error."""
    code = error.code if isinstance(error, UnitError) else type(error).__name__
    return {"error": str(error), "code": code}


def some_names(names: list[str]) -> str:
    """Return names in one line, however many there are."""
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return ", ".join(names[:_MOST_NAMES]) + more
