"""A whole check, for people and for programs."""

from collections.abc import Sequence

import msgspec
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bricktrack_common.wire_messages import HealthLevel
from bricktrack_device.health.findings import CheckResult, worst

_SHOWN: dict[HealthLevel, str] = {
    "ok": "[green]ok[/green]",
    "warn": "[yellow]warning[/yellow]",
    "fail": "[red]FAILED[/red]",
}


class CheckLine(msgspec.Struct, frozen=True, kw_only=True):
    """One finding, as `bricktrackd check --json` prints it; ``ok`` is false for level "fail" alone."""

    name: str
    ok: bool
    level: HealthLevel
    detail: str
    remedy: str


class CheckReport(msgspec.Struct, frozen=True, kw_only=True):
    """All findings of one check."""

    unit: str
    simulated: bool
    ok: bool
    level: HealthLevel
    checks: list[CheckLine]


def as_report(unit: str, results: Sequence[CheckResult], *, simulated: bool) -> CheckReport:
    """Return what is printed of a check."""
    return CheckReport(
        unit=unit,
        simulated=simulated,
        ok=all(r.ok for r in results),
        level=worst(r.level for r in results),
        checks=[
            CheckLine(name=r.name, ok=r.ok, level=r.level, detail=r.detail, remedy=r.remedy) for r in results
        ],
    )


def print_table(report: CheckReport, console: Console | None = None) -> None:
    """Print a check for people."""
    simulated = " (simulated)" if report.simulated else ""
    table = Table(title=f"Unit {report.unit}{simulated}", title_justify="left")
    for column in ("", "part", "found"):
        table.add_column(column, overflow="fold")
    for line in report.checks:
        found = escape(line.detail)
        if line.remedy:
            found += f"\n[bold]{escape(line.remedy)}[/bold]"
        table.add_row(_SHOWN[line.level], escape(line.name), found)
    (console or Console()).print(table)
