"""The plan of one test: its units, and which of their runs belong to it.

A test is found again by its name alone: the name is the label that its runs' ids end with, on the units and
here. So nothing that matters is kept anywhere else, and each step can be done again after it was cut short.
"""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import msgspec

from bricktrack_common.errors import ConfigError
from bricktrack_common.run_manifest import RUN_ID_PATTERN
from bricktrack_common.typed_data import dump_json, load_json
from bricktrack_host.durable_files import replace_durably, storage_errors

PLAN_NAME = "plan.json"
COMBINED_FOLDER = "combined"
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9-]{0,31}$"
"""Of a label that units take."""

_Id = Annotated[str, msgspec.Meta(pattern=RUN_ID_PATTERN)]


class PlannedTest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``tests/NAME/plan.json``.

    Attributes
    ----------
    name : str
        Of the test; the label of its runs.
    units : list of str
        As in the fleet file.
    duration_s : float or None
        What the units shall record, if not their own.
    """

    schema: str = "bricktrack.test-plan"
    version: Annotated[int, msgspec.Meta(ge=1, le=1)] = 1
    name: Annotated[str, msgspec.Meta(pattern=NAME_PATTERN)]
    units: Annotated[list[_Id], msgspec.Meta(min_length=1)]
    duration_s: float | None = None


def folder_of_test(fleet_file: Path, name: str) -> Path:
    """Return where a test is kept: ``tests/NAME`` beside the fleet file.

    Raises
    ------
    ConfigError
        If the name cannot be a run's label.
    """
    if re.fullmatch(NAME_PATTERN, name) is None:
        raise ConfigError(
            f"{name!r} cannot be a test's name, which ends the ids of its runs: letters, digits and hyphens, "
            "32 at most, as 'shake-12'"
        )
    return fleet_file.resolve().parent / "tests" / name


def save_plan(folder: Path, plan: PlannedTest) -> None:
    """Write a new plan; after return it survives a power cut. The same plan may be written again.

    Raises
    ------
    ConfigError
        If there is another plan of this name.
    StorageError
        If it cannot be written.
    """
    path = folder / PLAN_NAME
    if path.exists():
        there = load_plan(folder)
        if there == plan:
            return
        raise ConfigError(
            f"there is a test {plan.name} already, {_in_words(there)}; this one would be {_in_words(plan)}. "
            "Choose another name"
        )
    with storage_errors(path, "Make room"):
        folder.mkdir(parents=True, exist_ok=True)
        replace_durably(path, dump_json(plan))


def _in_words(plan: PlannedTest) -> str:
    units = plan.units if len(plan.units) <= 6 else [*plan.units[:5], f"{len(plan.units) - 5} more"]
    length = "the units' own time" if plan.duration_s is None else f"{plan.duration_s:g} s"
    return f"of {', '.join(units)} for {length}"


def load_plan(folder: Path) -> PlannedTest:
    """Return a test's plan.

    Raises
    ------
    ConfigError
        If there is none.
    RunFormatError
        If it is damaged, or of a newer version.
    """
    path = folder / PLAN_NAME
    if not path.is_file():
        begun = sorted(p.parent.name for p in folder.parent.glob(f"*/{PLAN_NAME}"))
        there = f"Tests begun here: {', '.join(begun[-10:])}. " if begun else ""
        raise ConfigError(
            f"{path}: no such test. {there}A new one begins with 'bricktrack test new {folder.name}'"
        )
    return load_json(path, PlannedTest)


def is_of_test(run_id: str, name: str) -> bool:
    """Tell whether a run belongs to a test: its label, which ends its id, is the test's name.

    Examples
    --------
    >>> is_of_test("b2_9f31c2_0007_shake-12", "shake-12"), is_of_test("b2_9f31c2_0007_my_12", "12")
    (True, False)
    """
    parts = run_id.rsplit("_", 3)
    return len(parts) == 4 and parts[3] == name and parts[2].isdigit()


def unit_of(run_id: str) -> str:
    """Return the unit that a run's id begins with.

    Examples
    --------
    >>> unit_of("brick_2_9f31c2_0007_shake-12")
    'brick_2'
    """
    return run_id.rsplit("_", 3)[0]


def newest(run_ids: Iterable[str]) -> str | None:
    """Return the run that was recorded last, by the unit's own count; `None` of none.

    Examples
    --------
    >>> newest(["b2_9f31c2_0009_a", "b2_9f31c2_0010_a"])
    'b2_9f31c2_0010_a'
    """
    return max(run_ids, key=lambda run_id: int(run_id.rsplit("_", 2)[1]), default=None)
