"""Which runs of a test count when it is recorded once more: those of the newest round of arming.

What the units had before is written down before any of them is armed. So a host that dies at any moment and
is given the same command neither arms a unit that has recorded already, nor takes an earlier run for a new
one.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from bricktrack_common.run_manifest import MANIFEST_NAME
from bricktrack_common.typed_data import dump_json, load_json
from bricktrack_common.wire_messages import StatusReply
from bricktrack_host.campaign.test_plan import PlannedTest, is_of_test, newest, unit_of
from bricktrack_host.durable_files import replace_durably, storage_errors

ROUND_NAME = "arming.json"


@dataclass(frozen=True, slots=True)
class Standing:
    """How far a unit is in a round: it has its run, or is at it, or has yet to be armed."""

    kind: Literal["recorded", "armed", "idle"]
    run_id: str = ""


class ArmingRound(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``tests/NAME/arming.json``; there is none while a test was armed once only.

    Attributes
    ----------
    before : dict of str to (list of str or None)
        Runs of this test that each unit had before; `None` where it did not answer and nobody knows.
    is_open : bool
        Whether units may still lack their run: 'arm --again' then goes on with this round.
    """

    schema: str = "bricktrack.arming-round"
    version: Annotated[int, msgspec.Meta(ge=1, le=1)] = 1
    before: dict[str, list[str] | None] = {}
    is_open: bool = False

    def run_of(self, unit: str, run_ids: Iterable[str], name: str) -> str | None:
        """Return the newest of a unit's runs that is of this test and this round; `None` without one.

        That is so too of a unit of which nobody knows what runs it had before the round.

        Examples
        --------
        >>> once_more = ArmingRound(before={"b2": ["b2_9f31c2_0007_s"]})
        >>> once_more.run_of("b2", ["b2_9f31c2_0007_s"], "s") is None
        True
        >>> once_more.run_of("b3", ["b3_11aa22_0001_s"], "s")
        'b3_11aa22_0001_s'
        """
        before = self.before.get(unit, [])
        if before is None:
            return None
        return newest(run_id for run_id in run_ids if is_of_test(run_id, name) and run_id not in before)

    def standing_of(self, unit: str, now: StatusReply, run_ids: Iterable[str], name: str) -> Standing:
        """Return how far a unit is, by what it says of itself and the runs that it has."""
        if now.state in ("armed", "recording", "saving") and is_of_test(now.run_id, name):
            return Standing("armed", now.run_id)
        recorded = self.run_of(unit, run_ids, name)
        return Standing("idle") if recorded is None else Standing("recorded", recorded)


def load_round(folder: Path) -> ArmingRound:
    """Return the newest round of a test's folder; the first one has nothing before it.

    Raises
    ------
    RunFormatError
        If its file is damaged, or of a newer version.
    """
    path = folder / ROUND_NAME
    return load_json(path, ArmingRound) if path.is_file() else ArmingRound()


def save_round(folder: Path, going: ArmingRound) -> None:
    """Write a round in place of the one before; after return it survives a power cut.

    Raises
    ------
    StorageError
        If it cannot be written.
    """
    path = folder / ROUND_NAME
    with storage_errors(path, "Make room"):
        replace_durably(path, dump_json(going))


def close_round(folder: Path, going: ArmingRound) -> None:
    """Note that a round is over: whoever arms again means another one."""
    if going.is_open:
        save_round(folder, msgspec.structs.replace(going, is_open=False))


def run_ids_here(runs_folder: Path, unit: str) -> list[str]:
    """Return the ids of a unit's whole runs that are on this machine."""
    return [
        path.name
        for path in runs_folder.glob(f"{unit}_*")
        if path.name.count("_") >= 3 and unit_of(path.name) == unit and (path / MANIFEST_NAME).is_file()
    ]


def runs_here(runs_folder: Path, plan: PlannedTest, going: ArmingRound) -> dict[str, Path]:
    """Return the whole run of this round of each unit of a test that is on this machine."""
    found = {u: going.run_of(u, run_ids_here(runs_folder, u), plan.name) for u in plan.units}
    return {unit: runs_folder / run_id for unit, run_id in found.items() if run_id is not None}
