"""What a host has armed the unit for, kept in memory beside the copies of runs until the first edge comes.

A daemon that is killed while it is armed would come back idle, and the shake would go by. For what is here it
arms again; nobody has to notice.
"""

import logging
from pathlib import Path

import msgspec

from bricktrack_common.errors import RunFormatError
from bricktrack_common.typed_data import dump_json, load_json

logger = logging.getLogger(__name__)


class ArmOrder(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Label and duration of the run that is waited for; `None` is the configured one."""

    label: str
    duration_s: float | None


class StandingOrder:
    """At most one order; nothing here raises, because the unit is armed with it or without.

    Parameters
    ----------
    folder : Path or None
        Where copies of runs are kept, or `None` for nowhere.
    unit : str

    Attributes
    ----------
    left : ArmOrder or None
        What a killed daemon left, and is not armed for yet.
    """

    def __init__(self, folder: Path | None, unit: str) -> None:
        self.left: ArmOrder | None = None
        # No name of a run: it begins with a dot.
        self._path = None if folder is None else folder / f".armed-{unit}.json"

    @property
    def is_kept(self) -> bool:
        """Whether there is one, or a killed daemon left one that nobody has taken up."""
        try:
            return self._path is not None and self._path.exists()
        except OSError:
            return False

    def note(self, order: ArmOrder) -> None:
        """Keep an order, in place of another one."""
        self.left = None
        if self._path is None:
            return
        temporary = self._path.with_suffix(".new")
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(dump_json(order))
            temporary.rename(self._path)
        except OSError as e:
            logger.warning("%s: a daemon that is killed will not arm again: %s", self._path, e.strerror or e)

    def supersede(self, order: ArmOrder) -> ArmOrder:
        """Take back what a killed daemon left, for a newer order, whether or not that can be carried out."""
        self.left = None
        return order

    def forget(self) -> None:
        """Keep none: it is carried out, or taken back."""
        self.left = None
        if self._path is None:
            return
        try:
            self._path.unlink(missing_ok=True)
        except OSError as e:
            logger.warning("%s: cannot be removed: %s", self._path, e.strerror or e)

    def take_up(self) -> None:
        """See what a killed daemon left, and keep it no longer: arming may be what killed it."""
        if self._path is None:
            return
        left = None
        try:
            if self._path.exists():
                left = load_json(self._path, ArmOrder)
        except (RunFormatError, OSError) as e:
            logger.warning("not armed again: %s", e)
        self.forget()
        self.left = left
