"""One finding of a check: what was looked at, how it is, and what to do about it."""

from collections.abc import Callable, Iterable

import msgspec

from bricktrack_common.errors import BricktrackError
from bricktrack_common.wire_messages import HealthItem, HealthLevel

LEVELS: tuple[HealthLevel, ...] = ("ok", "warn", "fail")
_MAX_WORDS = 1000


class CheckResult(msgspec.Struct, frozen=True, kw_only=True):
    """One line of the check.

    Attributes
    ----------
    name : str
        The part.
    level : "ok", "warn" or "fail"
        "warn": runs can be made, and will be worse than they could be.
    detail : str
        What was found, with values.
    remedy : str
        What to do; empty where nothing is to be done.
    """

    name: str
    level: HealthLevel
    detail: str
    remedy: str = ""

    @property
    def ok(self) -> bool:
        """Whether the unit can work with this."""
        return self.level != "fail"

    def as_item(self) -> HealthItem:
        """Return it as it travels in a status reply."""
        return HealthItem(
            name=self.name[:64],
            level=self.level,
            words=self.detail[:_MAX_WORDS],
            remedy=self.remedy[:_MAX_WORDS],
        )


def good(name: str, detail: str) -> CheckResult:
    """Return a finding that all is well."""
    return CheckResult(name=name, level="ok", detail=detail)


def warning(name: str, detail: str, remedy: str) -> CheckResult:
    """Return a finding that makes runs worse."""
    return CheckResult(name=name, level="warn", detail=detail, remedy=remedy)


def failure(name: str, detail: str, remedy: str) -> CheckResult:
    """Return a finding that stops the unit from working."""
    return CheckResult(name=name, level="fail", detail=detail, remedy=remedy)


def worst(levels: Iterable[HealthLevel]) -> HealthLevel:
    """Return the worst of some levels; "ok" of none.

    Examples
    --------
    >>> worst(["ok", "fail", "warn"])
    'fail'
    """
    return LEVELS[max((LEVELS.index(level) for level in levels), default=0)]


def tried(name: str, remedy: str, check: Callable[[], list[CheckResult]]) -> list[CheckResult]:
    """Return what a check finds; an error that it raises on purpose is a failure, in its own words."""
    try:
        return check()
    except (BricktrackError, OSError) as e:
        return [failure(name, str(e), remedy)]
