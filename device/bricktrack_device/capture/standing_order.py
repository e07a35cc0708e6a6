"""What a host has armed the unit for, kept in memory beside the copies of runs until the first edge comes.

A daemon that is killed while it is armed would come back idle, and the shake would go by. For what is here it
arms again; nobody has to notice. It does so for no order that is too old, that was given before the unit was
switched on, or that has its run already.
"""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import msgspec

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import RunFormatError
from bricktrack_common.typed_data import dump_json, load_json
from bricktrack_device.boot import kernel_boot_id

logger = logging.getLogger(__name__)

_ARM_IT = "Arm it if a shake is to come"


class ArmOrder(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Label and duration of the run that is waited for; a duration of `None` is the configured one.

    ``t_ns`` is when it was given, on this boot's monotonic clock.
    """

    label: str
    duration_s: float | None
    t_ns: int = msgspec.field(default_factory=monotonic_ns)


class _Kept(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    order: ArmOrder
    run_id: str
    boot_id: str
    version: Literal[1] = 1


class StandingOrder:
    """At most one order; nothing here raises, because the unit is armed with it or without.

    Parameters
    ----------
    folder : Path or None
        Where copies of runs are kept, or `None` for nowhere.
    unit : str
    max_age_s : float
        For an older one that a killed daemon left the unit is not armed again.
    has_run : callable
        Tells whether anything was recorded of a run, by its id.
    boot_id : str or None
        The kernel's; read if not given.

    Attributes
    ----------
    left : ArmOrder or None
        What the unit is to be armed for again, and is not armed for yet.
    why : str
        What it was armed for before and is not now, in words, as its next run is to say; ``""`` if nothing.
    """

    def __init__(
        self,
        folder: Path | None,
        unit: str,
        *,
        max_age_s: float,
        has_run: Callable[[str], bool],
        boot_id: str | None = None,
    ) -> None:
        self.left: ArmOrder | None = None
        self.why = ""
        self._now: ArmOrder | None = None
        self._max_age_s = max_age_s
        self._has_run = has_run
        self._boot_id = boot_id or kernel_boot_id()
        # No name of a run: it begins with a dot.
        self._path = None if folder is None else folder / f".armed-{unit}.json"

    @property
    def stands(self) -> bool:
        """Whether a killed daemon left one that `take_up` would arm the unit for."""
        try:
            return (kept := self._read()) is not None and not self._why_not(kept)
        except (RunFormatError, OSError):
            return False

    def note(self, order: ArmOrder, run_id: str) -> None:
        """Keep an order, in place of another one; ``run_id`` is that of the run that is waited for."""
        self.left, self.why, self._now = None, "", order
        if self._path is None:
            return
        temporary = self._path.with_suffix(".new")
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(dump_json(_Kept(order=order, run_id=run_id, boot_id=self._boot_id)))
            temporary.rename(self._path)
        except OSError as e:
            logger.warning("%s: a daemon that is killed will not arm again: %s", self._path, e.strerror or e)

    def supersede(self, order: ArmOrder) -> ArmOrder:
        """Take back what is left, for a newer order, whether or not that can be carried out."""
        if self.left is not None:
            why = self.why
            self.forget()
            self.why = why
        return order

    def arm_again(self, why: str) -> None:
        """Keep the order, if there is one, to be armed for again: the unit is armed no longer."""
        self.left, self.why = self._now, why

    def forget(self) -> None:
        """Keep none: it is carried out, or taken back."""
        self.left, self.why, self._now = None, "", None
        if self._path is None:
            return
        try:
            self._path.unlink(missing_ok=True)
        except OSError as e:
            logger.warning("%s: cannot be removed: %s", self._path, e.strerror or e)

    def take_up(self) -> str:
        """See what a killed daemon left, and keep it no longer: arming may be what killed it.

        Returns
        -------
        words : str
            Why the unit is not armed for it; ``""`` where it will be, or there is none.
        """
        kept, words = None, ""
        try:
            if (kept := self._read()) is not None:
                words = self._why_not(kept)
        except (RunFormatError, OSError) as e:
            words = str(e)
        self.forget()
        if words:
            of = f" for {kept.order.label!r}" if kept is not None and kept.order.label else ""
            return f"the daemon was killed while it was armed{of}, and is not armed again: {words}"
        if kept is not None:
            self.left = kept.order
            self.why = (
                f"the daemon was killed while it was armed, {_hours(_age_s(kept.order))} after the command"
            )
        return ""

    def _read(self) -> _Kept | None:
        if self._path is None or not self._path.exists():
            return None
        return load_json(self._path, _Kept)

    def _why_not(self, kept: _Kept) -> str:
        """Return in words why the unit should not be armed again, or ``""``."""
        if kept.boot_id != self._boot_id:
            return (
                "the unit was switched off since, and nobody knows for how long. Arm it if a shake is to come"
            )
        if self._has_run(kept.run_id):
            return f"its wave had begun; what there is of it is run {kept.run_id}"
        age_s = _age_s(kept.order)
        if age_s > self._max_age_s:
            limit = f"recording.arm_again_within_s is {self._max_age_s:g}"
            return f"the command came {_hours(age_s)} ago, and {limit}. {_ARM_IT}"
        return ""


def _age_s(order: ArmOrder) -> float:
    return (monotonic_ns() - order.t_ns) / 1e9


def _hours(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 600 else f"{seconds / 3600:.1f} h"
